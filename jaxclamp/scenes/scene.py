"""What a clamping is: artery, clamp, stop, and the numerical choices. Plain frozen data.

Every float can be differentiated; every string, integer and tuple of them is a static choice.
Units inside are mm, kPa, mN and radians. Build scenes with `jaxclamp.load_scene` (validated) and
change them with `replace`, which also works on traced values.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from jax import Array

from jaxclamp.core.records import quantity, record, static
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material


@record
class Layer:
    """One layer of the wall, stress-free as an opened-up circular sector of its own."""

    name: str = static()
    inner_radius: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """inner radius of the open sector"""
    thickness: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """thickness of the open sector"""
    opening_angle: Array = quantity("deg", -350.0, 350.0)
    """360 deg minus the sector's angle: 0 for a closed ring, negative for an overlapping one"""
    material: Material


@record
class Artery:
    """A layered tube, its stretch in the body and its blood pressure."""

    length: Array = quantity("mm", 0.0, 1e4, open_lower=True)
    """load-free length; the clamp sits in the middle"""
    axial_stretch: Array = quantity("", 0.2, 5.0)
    """length in the body over load-free length"""
    pressure: Array = quantity("kPa", 0.0, 1e4)
    """blood pressure, a follower load on the lumen"""
    layers: tuple[Layer, ...]
    """from inside to outside"""


@record
class Clamp:
    """Two jaws alike, closing symmetrically across the artery."""

    jaw: Jaw


@record
class OcclusionStop:
    """Close until 1 - lumen height / physiological lumen diameter, at mid-length, is reached."""

    kind: str = static("occlusion")
    occlusion: Array = quantity("", 1e-4, 0.999)


@record
class TravelStop:
    """Move each jaw by a given distance from its first contact."""

    kind: str = static("travel")
    travel: Array = quantity("mm", 0.0, 1e3)


@record
class ForceStop:
    """Close until the force on one jaw (whole artery) is reached."""

    kind: str = static("force")
    force: Array = quantity("N", 1e-6, 1e4)


Stop = OcclusionStop | TravelStop | ForceStop


@record
class MeshSettings:
    """Hexahedra of the modelled eighth of the artery."""

    circumferential: int = static()
    """elements over the quarter circumference"""
    axial: int = static()
    """elements over the half length"""
    radial: tuple[int, ...] = static()
    """elements through each layer"""
    axial_grading: Array = quantity("", 0.0, 12.0, default=2.5)
    """elements grow by exp(grading) from the clamp to the end; 0 is uniform"""
    circumferential_grading: Array = quantity("", 0.0, 6.0, default=0.0)
    """elements grow by exp(grading) from the fold to the compression axis; 0 is uniform"""
    element: str = static("q1p0", choices=("q1p0", "q2p1"))
    """q1p0: 8 nodes, mean dilatation; q2p1: 27 nodes, linear discontinuous pressure"""
    contact_points: int = static(4)
    """contact quadrature points per facet and direction (more between inner walls where nodes need it)"""


@record
class SolverSettings:
    """How equilibrium is found. The answer does not depend on it beyond the tolerance."""

    tolerance: float = static(1e-9)
    """largest residual over the norm of the support reactions"""
    continuation: str = static("lumen", choices=("lumen", "travel"))
    """close in steps of lumen height, or of jaw travel"""
    linear_solver: str = static("auto", choices=("auto", "pardiso", "rslab", "splu"))
    """sparse direct back end; auto takes the first that is installed"""


@record
class Scene:
    """One clamping: everything that `jaxclamp.clamp` needs."""

    title: str = static("")
    artery: Artery
    clamp: Clamp
    stop: Stop
    contact: Contact
    mesh: MeshSettings
    solver: SolverSettings


_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+\])*)")


def _parse(path: str) -> list[str | int]:
    steps: list[str | int] = []
    for part in path.split("."):
        match = _STEP.fullmatch(part)
        if match is None:
            raise KeyError(f"'{path}' is not a path like 'artery.layers[0].material.c'")
        steps.append(match.group(1))
        steps += [int(i) for i in re.findall(r"\d+", match.group(2))]
    return steps


def replace(scene: Any, path: str, value: Any) -> Any:
    """A copy of `scene` with the value at `path` (such as "artery.layers[0].material.c") replaced.

    Works on traced values. Raises KeyError if the path does not exist.
    """
    return _replace(scene, _parse(path), value, path)


def _replace(node: Any, steps: list[str | int], value: Any, path: str) -> Any:
    if not steps:
        return value
    step, rest = steps[0], steps[1:]
    if isinstance(step, int):
        if not isinstance(node, tuple) or step >= len(node):
            raise KeyError(f"'{path}' does not exist: there is no item [{step}]")
        return (*node[:step], _replace(node[step], rest, value, path), *node[step + 1 :])
    names = [f.name for f in dataclasses.fields(node)] if dataclasses.is_dataclass(node) else []
    if step not in names:
        raise KeyError(f"'{path}' does not exist: '{step}' is not one of {', '.join(names) or 'no fields'}")
    return dataclasses.replace(node, **{step: _replace(getattr(node, step), rest, value, path)})
