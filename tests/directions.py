"""Directions in the space of scenes, for differences."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np

import jaxclamp as jc


def tight(scene: jc.Scene) -> jc.Scene:
    """Converged as far as float64 allows, so that differences are not noise."""
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, tolerance=1e-12))


def moved(scene: jc.Scene, direction: jc.Scene, h: float) -> jc.Scene:
    return jax.tree_util.tree_map(lambda a, d: np.asarray(a) + h * np.asarray(d), scene, direction)


def drawn(scene: jc.Scene, paths: tuple[str, ...], seed: int) -> jc.Scene:
    """A random direction in the given parts of a scene, in proportion to the values; zero elsewhere."""
    rng = np.random.default_rng(seed)
    direction = jax.tree_util.tree_map(lambda a: np.zeros(np.shape(a)), scene)
    for path in paths:
        part = functools.reduce(step, path.split("."), scene)
        random = jax.tree_util.tree_map(
            lambda a: rng.uniform(-1.0, 1.0, np.shape(a)) * np.maximum(np.abs(a), 1e-3), part
        )
        direction = jc.replace(direction, path, random)
    return direction


def step(node, name: str):
    head, _, index = name.partition("[")
    return getattr(node, head)[int(index[:-1])] if index else getattr(node, head)


def dot(a: jc.Scene, b: jc.Scene) -> float:
    pairs = zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True)
    return float(sum(np.vdot(np.asarray(x), np.asarray(y)) for x, y in pairs))
