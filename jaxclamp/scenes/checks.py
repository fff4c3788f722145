"""What makes a scene impossible although each of its values is sensible on its own.

The checks read the floats of a scene that was just read from a file; `schema.BadKey` says what
is wrong with which key.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxclamp.core.failures import BadKey
from jaxclamp.core.records import UNIT_FACTOR
from jaxclamp.physics.jaws import Face, Measured, Spline
from jaxclamp.physics.relief import Teeth
from jaxclamp.scenes import schema
from jaxclamp.scenes.scene import Artery, Layer, Scene
from jaxclamp.scenes.schema import refuse

MOST_CELLS = 200_000
"""elements of a mesh"""
COUNTS = {"circumferential": (2, 400), "axial": (2, 400), "contact_points": (1, 20)}
"""least and most of each count"""
RADIAL_COUNTS = (1, 100)
"""least and most elements through a layer"""
TOLERANCES = (1e-13, 1e-2)
"""least and greatest tolerance of equilibrium"""

CLOSING_STRETCHES = (0.5, 2.0)
"""circumferential stretch with which a layer may close round the one inside"""
TRAVELS = (0.0, 3.0)
"""a stop's lengths over the widest outer radius: the jaws have met well before"""

THICKNESSES = (1e-3, 10.0)
"""a layer's thickness over its inner radius"""
LENGTHS = (0.1, 1e4)
"""the artery's length over the widest outer radius"""
JAW_SIZES = (1e-3, 1e4)
"""a jaw's lengths over the widest outer radius"""
HINGE = 1.2
"""least distance of a hinge over the widest outer radius: beside the artery, which widens in the body"""
LEAST_REACH = 0.02
"""least reach of a jaw over the widest outer radius"""
MOST_ROWS = 9
"""ridges of a jaw"""
LEAST_POINTS = 4
"""contact points over the pitch of teeth, with fewer of which teeth are not what is computed"""
SMOOTHINGS = (1e-6, 1.0)
"""the smoothing of contact over the thickness of the wall"""


def check(scene: Scene) -> None:
    """Raise BadKey for the first thing that is impossible."""
    check_laws(scene.artery)
    checks = (
        check_clamp,
        check_names,
        check_proportions,
        check_closing,
        check_jaws,
        check_mesh,
        check_stop,
        check_solver,
        check_injury,
    )
    for one in checks:
        one(scene)


def check_laws(artery: Artery) -> None:
    """Every law has its moduli."""
    for i, layer in enumerate(artery.layers):
        if lacking_moduli(type(layer.material)):
            law = layer.material.law
            raise refuse(f"artery.layers[{i}].material.law", law, "a law with the quantities c and bulk")


def lacking_moduli(law: type) -> list[str]:
    """Which of `c` and `bulk` a law does not have; contact, tolerances and notes are made of them."""
    quantities = {field.name for field in schema.fields_by_key(law).values() if "range" in field.metadata}
    return [name for name in ("c", "bulk") if name not in quantities]


def check_names(scene: Scene) -> None:
    """Every layer has a name of its own."""
    names: list[str] = []
    for i, layer in enumerate(scene.artery.layers):
        path = f"artery.layers[{i}].name"
        if not layer.name.strip():
            raise refuse(path, layer.name, "a name that is not empty")
        if layer.name in names:
            raise refuse(path, layer.name, "a name that no other layer has")
        names.append(layer.name)


def check_proportions(scene: Scene) -> None:
    """Lengths are in proportion to each other."""
    layers = scene.artery.layers
    for i, layer in enumerate(layers):
        path = f"artery.layers[{i}]"
        inner = f"{path}.inner_radius_mm", layer.inner_radius
        _check_ratio(f"{path}.thickness_mm", layer.thickness, THICKNESSES, inner)
    _check_ratio("artery.length_mm", scene.artery.length, LENGTHS, _widest(scene))
    for name, jaw in scene.clamp.kinds.items():
        for key, field in schema.fields_by_key(type(jaw)).items():
            limits = field.metadata.get("range")  # a length that may be 0, such as a depth, may be small
            if limits and limits.unit == "mm" and limits.open_lower and not field.metadata["many"]:
                _check_ratio(f"clamp.{name}.{key}", getattr(jaw, field.name), JAW_SIZES, _widest(scene))
    wall = "the thickness of the wall", sum(float(layer.thickness) for layer in layers)
    _check_ratio("contact.smoothing_mm", scene.contact.smoothing, SMOOTHINGS, wall)


def _widest(scene: Scene) -> tuple[str, float]:
    """Largest outer radius of the open sectors, mm, with its name."""
    radii = [float(layer.inner_radius + layer.thickness) for layer in scene.artery.layers]
    return "the widest layer's outer radius", max(radii)


def check_closing(scene: Scene) -> None:
    """Every layer's open sector closes to a ring, round the one inside."""
    inner_squared: float | None = None
    for i, layer in enumerate(scene.artery.layers):
        inner_squared, stretch = closed(layer, inner_squared, f"artery.layers[{i}].opening_angle_deg")
        least, most = CLOSING_STRETCHES
        if not least <= stretch <= most:
            raise refuse(
                f"artery.layers[{i}].inner_radius_mm",
                float(layer.inner_radius),
                f"a sector that closes round the layer inside: round the circumference {layer.name!r} "
                f"would be stretched {stretch:.3g}-fold, not {least:g} to {most:g}",
            )


def closed(layer: Layer, inner_squared: float | None, path: str) -> tuple[float, float]:
    """Square of the closed outer radius (mm2) and mean circumferential stretch of one layer.

    The map of `fem.tube.closed_radii`: r**2 = r_i**2 + (R**2 - R_i**2) / k, where the innermost
    layer (`inner_squared` None) keeps the length of its middle surface.
    """
    degrees = float(layer.opening_angle) / UNIT_FACTOR["deg"]
    share = 1.0 - degrees / 360.0
    inner, thickness = float(layer.inner_radius), float(layer.thickness)
    middle, outer = inner + 0.5 * thickness, inner + thickness
    if inner_squared is None:
        inner_squared = (middle * share) ** 2 - (middle**2 - inner**2) * share
    if share <= 0.0 or inner_squared <= 0.0:
        raise refuse(
            path,
            round(degrees, 9),
            f"an angle with which {layer.name!r} can close: its sector is too short to make a ring "
            f"of {thickness:g} mm thickness",
        )
    outer_squared = inner_squared + (outer**2 - inner**2) * share
    middle_squared = inner_squared + (middle**2 - inner**2) * share
    return outer_squared, middle_squared**0.5 / (share * middle)


def check_mesh(scene: Scene) -> None:
    """The counts are sensible, together too, and there is one for each layer."""
    mesh, layers = scene.mesh, scene.artery.layers
    for key, (least, most) in COUNTS.items():
        _check_between(f"mesh.{key}", getattr(mesh, key), least, most, "a whole number")
    if len(mesh.radial) != len(layers):
        names = ", ".join(layer.name for layer in layers)
        raise refuse(
            "mesh.radial", list(mesh.radial), f"one count for each of {len(layers)} layers ({names})"
        )
    for i, count in enumerate(mesh.radial):
        _check_between(f"mesh.radial[{i}]", count, *RADIAL_COUNTS, "a whole number")
    through = sum(mesh.radial)
    cells = mesh.circumferential * mesh.axial * through
    if cells > MOST_CELLS:
        said = f"mesh has {mesh.circumferential} x {mesh.axial} x {through} = {cells} elements"
        raise BadKey(f"{said}: expected at most {MOST_CELLS}")


def check_stop(scene: Scene) -> None:
    """A stop's lengths, such as the jaws' travel, do not go far beyond the artery."""
    for key, field in schema.fields_by_key(type(scene.stop)).items():
        if "range" in field.metadata and field.metadata["range"].unit == "mm":
            _check_ratio(f"stop.{key}", getattr(scene.stop, field.name), TRAVELS, _widest(scene))


def check_clamp(scene: Scene) -> None:
    """There is one jaw for both, or an upper and a lower one; and the jaws get across the artery."""
    clamp = scene.clamp
    found = [name for name in ("jaw", "upper", "lower") if getattr(clamp, name) is not None]
    if found not in (["jaw"], ["upper", "lower"]):
        raise refuse(
            "clamp", f"with {' and '.join(found) or 'no jaw'}", "either jaw, or both upper and lower"
        )
    if clamp.closing is not None:
        radius = _widest(scene)[1]
        least, distance = HINGE * radius, float(clamp.closing.hinge_distance)
        if distance < least:
            raise refuse(
                "clamp.closing.hinge_distance_mm",
                distance,
                f"at least {least:.3g} mm, a hinge beside the artery of {radius:.3g} mm outer radius",
            )
    if clamp.reach is not None and float(clamp.reach) < LEAST_REACH * _widest(scene)[1]:
        raise refuse(
            "clamp.reach_mm",
            float(clamp.reach),
            f"at least {LEAST_REACH * _widest(scene)[1]:.3g} mm, so that the jaws reach the artery",
        )
    if not set(_asked_for(scene)) <= set(clamp.planes):
        holds = ", ".join(f"{axis} = 0" for axis in clamp.planes) or "none"
        raise refuse("mesh.symmetry", scene.mesh.symmetry, f"auto, or planes that the clamp has ({holds})")


def _asked_for(scene: Scene) -> str:
    return {"auto": "", "none": ""}.get(scene.mesh.symmetry, scene.mesh.symmetry)


def check_jaws(scene: Scene) -> None:
    """The middle of a jaw is its lowest point, as travel and first contact assume; its teeth can be made."""
    for name, jaw in scene.clamp.kinds.items():
        if isinstance(jaw, Spline):
            height = np.asarray(jaw.height(np.linspace(0.0, float(jaw.half_width), 200))[0])
            if np.min(height) < -1e-9 * float(jaw.half_width):
                raise refuse(
                    f"clamp.{name}.slopes",
                    np.asarray(jaw.slopes).tolist(),
                    "slopes that keep the middle the lowest point of the jaw; "
                    f"here it lies {-np.min(height):.3g} mm above the lowest",
                )
        if isinstance(jaw, Measured) and not float(jaw.edge_radius) < 0.5 * float(jaw.width):
            most = 0.5 * float(jaw.width)
            raise refuse(
                f"clamp.{name}.edge_radius_mm",
                float(jaw.edge_radius),
                f"less than half the width, {most:.3g} mm",
            )
        teeth = getattr(jaw, "teeth", None)
        if isinstance(jaw, Face) and teeth is not None:
            check_teeth(jaw, teeth, f"clamp.{name}.teeth", scene)


def check_teeth(jaw: Face, teeth: Teeth, path: str, scene: Scene) -> None:
    """Teeth are no deeper than the jaw's edge and than they are wide, and contact can see them."""
    depth, pitch = float(teeth.depth), float(teeth.pitch)
    edge = 1.0 / float(np.max(np.asarray(jaw.smooth_curvatures())))
    if depth > edge:
        raise refuse(
            f"{path}.depth_mm", depth, f"at most {edge:.3g} mm, the least radius of the face and its edges"
        )
    if depth > pitch:
        raise refuse(f"{path}.depth_mm", depth, f"at most the pitch, {pitch:.3g} mm")
    if teeth.tip_radius is not None:
        if teeth.profile != "wedge":
            raise refuse(f"{path}.tip_radius_mm", float(teeth.tip_radius), 'profile = "wedge" with it')
        if depth > 0.0 and not float(teeth.tip_radius) < float(teeth.sine_radius()):
            raise refuse(
                f"{path}.tip_radius_mm",
                float(teeth.tip_radius),
                f"less than the {float(teeth.sine_radius()):.3g} mm of a sine of this pitch and depth",
            )
    if teeth.profile == "rows" and not 1 <= teeth.rows <= MOST_ROWS:
        raise refuse(f"{path}.rows", teeth.rows, f"a whole number from 1 to {MOST_ROWS}")
    if depth > 0.0 and (apart := points_apart(scene, teeth)) > pitch / LEAST_POINTS:
        raise refuse(
            f"{path}.pitch_mm",
            pitch,
            f"at least {LEAST_POINTS * apart:.3g} mm, so that {LEAST_POINTS} contact points see a tooth "
            "(or more elements, or mesh.contact_points)",
        )


def points_apart(scene: Scene, teeth: Teeth) -> float:
    """Mean distance of contact points under the jaws in the directions in which teeth change, about, mm."""
    mesh, artery = scene.mesh, scene.artery
    g, order = float(mesh.axial_grading), 1 + (mesh.element == "q2p1")
    first = 1.0 / mesh.axial if g < 1e-6 else np.expm1(g / mesh.axial) / np.expm1(g)
    along = 0.5 * float(artery.length * artery.axial_stretch) * first
    across = 0.5 * np.pi * _widest(scene)[1] / mesh.circumferential
    sizes = {"along": [along], "across": [across], "both": [along, across]}[teeth.direction]
    return max(sizes) / max(mesh.contact_points, order)


def check_solver(scene: Scene) -> None:
    """The tolerance is within what float64 can do."""
    _check_between("solver.tolerance", scene.solver.tolerance, *TOLERANCES, "a number")


def check_injury(scene: Scene) -> None:
    """Thresholds of stresses name a layer, others none, and all have a source."""
    names = [layer.name for layer in scene.artery.layers]
    for i, given in enumerate(scene.injury):
        path = f"injury[{i}].layer"
        if given.of_a_layer and given.layer not in names:
            raise refuse(path, given.layer, f"a layer for {given.measure}: one of {', '.join(names)}", names)
        if not given.of_a_layer and given.layer:
            raise refuse(path, given.layer, f"no layer: {given.measure} is under the jaws")
        if not given.source.strip():
            raise refuse(f"injury[{i}].source", given.source, "where the threshold comes from")


def _check_ratio(path: str, value: Any, ratios: tuple[float, float], beside: tuple[str, Any]) -> None:
    """A length in proportion to another, `beside`; both mm."""
    name, other = beside[0], float(beside[1])
    least, most = (ratio * other for ratio in ratios)
    if not least <= value <= most:
        raise refuse(path, float(value), f"a number from {least:g} to {most:g} beside {name} = {other:g} mm")


def _check_between(path: str, value: Any, least: float, most: float, what: str) -> None:
    if not least <= value <= most:
        raise refuse(path, value, f"{what} from {least:g} to {most:g}")
