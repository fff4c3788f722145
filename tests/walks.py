"""Scenes for tests, and the engine's own way to their load-free and physiological states."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

import jaxclamp as jc
from jaxclamp.physics.materials import HGO, Material, NeoHookean
from jaxclamp.potential.model import Model, build_model
from jaxclamp.scenes.scene import Layer, MeshSettings, Scene
from jaxclamp.solve.newton import Equilibrium
from jaxclamp.solve.stages import Clamping
from tube import Sector


def mesh(
    element: str, circumferential: int, axial: int, radial: tuple[int, ...], **others: Any
) -> MeshSettings:
    """Mesh settings by position; evenly spaced round the artery unless said."""
    counts = {"element": element, "circumferential": circumferential, "axial": axial, "radial": radial}
    return MeshSettings(**{"circumferential_grading": 0.0} | counts | others)


def material(sector: Sector, bulk: float) -> Material:
    """The engine's law for a layer of the semi-analytic tube."""
    if sector.law == "neo":
        return NeoHookean(c=sector.c, bulk=bulk)
    return HGO(
        c=sector.c,
        k1=sector.k1,
        k2=sector.k2,
        fibre_angle=np.deg2rad(sector.fibre_angle),
        bulk=bulk,
        fibre_energy=sector.law,
    )


def tube_scene(
    sectors: tuple[Sector, ...], pressure: float, stretch: float, settings: MeshSettings, bulk: float = 1e4
) -> Scene:
    """A short piece of the tube of `sectors` (its length does not matter)."""
    layers = tuple(
        Layer(
            name=f"layer {i}",
            inner_radius=sector.inner_radius,
            thickness=sector.thickness,
            opening_angle=np.deg2rad(sector.opening_angle),
            material=material(sector, bulk),
        )
        for i, sector in enumerate(sectors)
    )
    scene = jc.load_scene("human-lad")
    artery = dataclasses.replace(
        scene.artery, length=4.0, axial_stretch=stretch, pressure=pressure, layers=layers
    )
    return dataclasses.replace(scene, artery=artery, mesh=settings)


def inflate(scene: Scene, like: Model | None = None) -> tuple[Model, Equilibrium, Equilibrium]:
    """Model, load-free and physiological state, without reading anything off them."""
    model = build_model(scene, like)
    clamping = Unread(model, lambda event: None)
    load_free = clamping.load_free()
    return model, load_free, clamping.in_body(load_free)


class Unread(Clamping):
    """A clamping that reads no figures off its states: they cost compilation on every new mesh."""

    def keep(self, *_: Any) -> None:
        pass
