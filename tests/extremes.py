"""The box of extreme scenes, one scene per point of it, and a judge of what the engine makes of it.

A point is a dict of values by axis; an axis that is left out keeps the value of the scene
"human-lad". All scenes share one mesh shape, so that they share the compiled programs.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

import jaxclamp as jc
from jaxclamp.show.description import warnings
from tube import Incompressible, Sector, extra_stress

Point = Mapping[str, float]

COUNTS = {"circumferential": 6, "axial": 8, "radial": [2, 2]}
"""elements over the quarter circumference, the half length, and through media and adventitia"""
LUMEN_RADIUS = 1.73
"""load-free, mm: kept where opening angle or wall are changed, as near to human-lad's as two digits say"""
MEDIA_SHARE = 2.0 / 3.0
"""of the wall's thickness, where that is changed"""
STRENGTH = 2000.0
"""kPa: ultimate stress of a human adventitia round the circumference and along it (Teng 2009)"""
LARGEST_STRETCH = 2.0
"""of the lumen's circumference by pressure: arteries inflate 1.1-fold to 1.9-fold (mouse aorta, 140 mmHg)"""
SECONDS = 90.0
"""a clamping on this mesh that takes longer hangs, as far as its user is concerned"""


@dataclasses.dataclass(frozen=True)
class Axis:
    """One quantity of the box."""

    unit: str
    range: tuple[float, float]
    sensible: tuple[float, float]
    """the part of the range that an artery, a clamp or a careful modeller can have"""
    why: str
    """where the sensible part comes from"""
    log: bool = False

    def at(self, share: float, sensible: bool = False) -> float:
        """The value at a share (0 to 1) of the range, or of its sensible part."""
        low, high = self.sensible if sensible else self.range
        if self.log:
            return float(low * (high / low) ** share) if share < 1.0 else high
        return low + share * (high - low)

    def share(self, value: float) -> float:
        """Where in the range a value lies, 0 to 1."""
        low, high = self.range
        return math.log(value / low) / math.log(high / low) if self.log else (value - low) / (high - low)


AXES = {
    "bulk": Axis(
        "kPa",
        (1e1, 1e8),
        (1e3, 2e6),
        "from a volume change of about 1 % at 100 mmHg to that of water",
        log=True,
    ),
    "k2": Axis("", (0.0, 500.0), (0.0, 190.0), "human carotid 69 +- 59 (Sommer & Holzapfel 2012), plus 2 SD"),
    "fibre_angle": Axis("deg", (0.0, 90.0), (0.0, 90.0), "all: layers were measured from 7 to 67 deg"),
    "opening_angle": Axis(
        "deg", (-120.0, 300.0), (0.0, 250.0), "femoral arteries 96 to 193 deg (Jadidi et al.), with a margin"
    ),
    "wall": Axis(
        "of the load-free lumen radius",
        (0.02, 1.0),
        (0.08, 0.8),
        "mouse aorta about 0.1 (in the body), rabbit carotid 0.55, old human LAD 0.6",
        log=True,
    ),
    "stiffness_ratio": Axis(
        "adventitia over media",
        (1e-3, 1e3),
        (1e-2, 1e1),
        "human LAD 0.1 (2002), aorta 0.27 (Peirlinck et al. 2024), with a decade to either side and more",
        log=True,
    ),
    "stretch": Axis("", (0.8, 2.0), (1.0, 1.6), "human LAD 1.04, femoral 1.29, mouse aorta 1.46, rabbit 1.5"),
    "pressure": Axis("kPa", (0.0, 80.0), (0.0, 33.0), "no blood to 250 mmHg"),
    "jaw_radius": Axis("mm", (0.1, 100.0), (0.5, 10.0), "micro-clamps to aortic clamps", log=True),
    "contact_stiffness": Axis(
        "kPa/mm",
        (1e1, 1e7),
        (1e3, 1e6),
        "softer contact is no rigid jaw: it gives way by a tenth of the wall and more",
        log=True,
    ),
    "smoothing": Axis(
        "of the wall's thickness",
        (1e-6, 1.0),
        (1e-4, 1e-1),
        "above the wall's roughness, below its thickness",
        log=True,
    ),
    "grading": Axis(
        "",
        (0.0, 6.0),
        (0.0, 6.0),
        "all: the cells of human-lad are at most 25 to 100 times longer than thick",
    ),
    "occlusion": Axis("", (0.1, 0.99), (0.1, 0.99), "all: what the clamp is for"),
}


def draw(shares: Mapping[str, float], sensible: bool = False) -> dict[str, float]:
    """The point at shares (0 to 1) of some axes' ranges, or of their sensible parts."""
    return {name: AXES[name].at(share, sensible) for name, share in shares.items()}


def random_points(count: int, seed: int, sensible: bool = False) -> list[dict[str, float]]:
    """Points anywhere in the box or in its sensible part (and `is_sensible`)."""
    rng = np.random.default_rng(seed)
    points: list[dict[str, float]] = []
    while len(points) < count:
        point = draw(dict(zip(AXES, rng.random(len(AXES)), strict=True)), sensible)
        if not sensible or is_sensible(point):
            points.append(point)
    return points


def random_corners(count: int, seed: int, sensible: bool = False) -> list[dict[str, float]]:
    """Corners of the box, or of its sensible part (and `is_sensible`), without repetition."""
    rng = np.random.default_rng(seed)
    points: dict[tuple[int, ...], dict[str, float]] = {}
    while len(points) < count:
        ends = tuple(int(end) for end in rng.integers(0, 2, len(AXES)))
        point = draw(dict(zip(AXES, map(float, ends), strict=True)), sensible)
        if not sensible or is_sensible(point):
            points[ends] = point
    return list(points.values())


# --- from a point to a scene -----------------------------------------------------------------------


def closing_middle(inner: float, thickness: float, share: float) -> float:
    """Middle radius of the open sector that closes to an inner radius and keeps its middle line, mm.

    share: the sector's angle over the full circle. (share M)**2 = r_i**2 + share (M H - H**2 / 4).
    """
    H = thickness
    return (H + math.sqrt(H**2 * (1.0 - share) + 4.0 * inner**2)) / (2.0 * share)


def overrides(point: Point) -> list[str]:
    """What a point changes of human-lad, as keys and values of its scene file."""
    values = {f"mesh.{key}": value for key, value in COUNTS.items()}
    layers = [f"artery.layers[{i}]" for i in (0, 1)]
    base = jc.load_scene("human-lad")
    wall = sum(float(layer.thickness) for layer in base.artery.layers)
    if "wall" in point or "opening_angle" in point:
        wall = point["wall"] * LUMEN_RADIUS if "wall" in point else wall
        inner = LUMEN_RADIUS
        for path, layer, part in zip(layers, base.artery.layers, (MEDIA_SHARE, 1 - MEDIA_SHARE), strict=True):
            angle = point.get("opening_angle", math.degrees(float(layer.opening_angle)))
            H, share = part * wall, 1.0 - angle / 360.0
            M = closing_middle(inner, H, share)
            values |= {
                f"{path}.inner_radius_mm": M - H / 2.0,
                f"{path}.thickness_mm": H,
                f"{path}.opening_angle_deg": angle,
            }
            inner = math.sqrt(inner**2 + 2.0 * share * M * H)
    for axis, key in (("bulk", "bulk_kPa"), ("k2", "k2"), ("fibre_angle", "fibre_angle_deg")):
        if axis in point:
            values |= {f"{path}.material.{key}": point[axis] for path in layers}
    if "stiffness_ratio" in point:
        media, adventitia = (layer.material for layer in base.artery.layers)
        c = point["stiffness_ratio"] * media.c
        values |= {
            f"{layers[1]}.material.c_kPa": c,
            f"{layers[1]}.material.k1_kPa": adventitia.k1 * c / adventitia.c,
        }
    if "smoothing" in point:
        values["contact.smoothing_mm"] = point["smoothing"] * wall
    for axis, key in (
        ("stretch", "artery.axial_stretch"),
        ("pressure", "artery.pressure_kPa"),
        ("jaw_radius", "clamp.jaw.radius_mm"),
        ("contact_stiffness", "contact.stiffness_kPa_per_mm"),
        ("grading", "mesh.axial_grading"),
        ("occlusion", "stop.occlusion"),
    ):
        if axis in point:
            values[key] = point[axis]
    return [f"{key}={value}" for key, value in values.items()]


def scene_of(point: Point) -> jc.Scene:
    """The scene of a point. Raises SceneError where the scene's own checks refuse it."""
    return jc.load_scene("human-lad", overrides(point))


def is_sensible(point: Point) -> bool:
    """True if every value is sensible, the mesh resolves the jaw, and the artery survives its loads.

    The second is that `jaxclamp show` does not warn. The third is the answer of the semi-analytic
    tube: there is an equilibrium, it widens the lumen no more than arteries widen, and no stress is
    beyond the strength of the wall.
    """
    if any(
        not axis.sensible[0] <= point.get(name, axis.sensible[0]) <= axis.sensible[1]
        for name, axis in AXES.items()
    ):
        return False
    try:
        scene = scene_of(point)
    except jc.SceneError:
        return False
    if warnings(scene):
        return False
    sectors = [
        Sector(
            inner_radius=float(layer.inner_radius),
            thickness=float(layer.thickness),
            opening_angle=math.degrees(float(layer.opening_angle)),
            c=layer.material.c,
            k1=layer.material.k1,
            k2=layer.material.k2,
            fibre_angle=math.degrees(layer.material.fibre_angle),
        )
        for layer in scene.artery.layers
    ]
    return survives(tuple(sectors), float(scene.artery.pressure), float(scene.artery.axial_stretch))


def survives(sectors: tuple[Sector, ...], pressure: float, stretch: float) -> bool:
    """True if the tube carries the pressure within `LARGEST_STRETCH` and `STRENGTH`."""
    tube = object.__new__(Incompressible)
    tube.layers, tube.pressure, tube.stretch = sectors, pressure, stretch
    radii = LUMEN_RADIUS * np.linspace(0.3, LARGEST_STRETCH, 120)
    with np.errstate(over="ignore", invalid="ignore"):
        carried = np.array([tube.carried(r) for r in radii])
        enough = np.flatnonzero(carried >= pressure)
        if enough.size == 0 or enough[0] == 0:
            return False
        radius = radii[enough[0]]
        for number, layer in enumerate(sectors):
            R = np.array([layer.inner_radius, layer.outer_radius])
            hoop = layer.k * tube.radius(radius, number, R) / R
            theta, axial, radial = extra_stress(layer, hoop, stretch)
            if not np.all(np.maximum(theta, axial) - radial <= STRENGTH):
                return False
    return True


# --- the judge -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of a scene: "solved", "refused" (with a reason) or "wrong" (with what is wrong)."""

    kind: str
    reason: str
    seconds: float
    notes: str = ""
    """of a solved scene: lost stability"""
    result: jc.Result | None = dataclasses.field(default=None, repr=False, compare=False)


def judge(point: Point) -> Outcome:
    """Clamp the scene of a point and say what came of it."""
    start = time.perf_counter()
    try:
        result = jc.clamp(scene_of(point))
    except (jc.SceneError, jc.EquilibriumError) as error:
        seconds, said = time.perf_counter() - start, str(error)
        flaw = flaw_of_refusal(said) or late(seconds)
        return Outcome("wrong" if flaw else "refused", flaw or said, seconds)
    except Exception as error:
        return Outcome("wrong", f"{type(error).__name__}: {error}", time.perf_counter() - start)
    seconds = time.perf_counter() - start
    flaw = flaw_of(result) or late(seconds)
    notes = [
        note
        for note, seen in (
            ("snapped", result.solver["snapped"]),
            ("unstable without its stop", bool(result.solver["negative_pivots"])),
        )
        if seen
    ]
    return Outcome("wrong" if flaw else "solved", flaw or "", seconds, ", ".join(notes), result)


def late(seconds: float) -> str:
    return f"took {seconds:.0f} s" if seconds > SECONDS else ""


def flaw_of_refusal(said: str) -> str:
    """What is wrong with a refusal: it has to be one sentence of words and finite numbers."""
    words = said.lower().replace("(", " ").replace(",", " ").split()
    if "\n" in said or not 20 <= len(said) <= 500 or "nan" in words or "inf" in words:
        return f"an unclear refusal: {said!r}"
    return ""


ROUNDING = 1e-11
"""mN per kPa of bulk modulus: what rounding leaves of a pressure over a square millimetre"""
LARGEST_SINKING = 0.5
"""penetration, and overlap of the inner walls, over the thickness of the wall in the body"""


def flaw_of(result: jc.Result) -> str:
    """What is wrong with a converged clamping, "" if nothing."""
    scene = result.scene
    try:
        json.dumps(result.to_dict(), allow_nan=False)
    except ValueError:
        return "a number that is not finite"
    base = result.history[0]
    wall = base["outer_radius_mm"] - base["lumen_height_mm"] / 2.0
    bulk = max(float(layer.material.bulk) for layer in scene.artery.layers)
    checks: dict[str, bool] = {
        "not at its stop": abs(result.final["occlusion"] - float(scene.stop.occlusion)) < 1e-6,  # type: ignore[union-attr]
        "no jaw force": result.final["clamp_force_N"] > 0.0,
        "work balance": result.solver["snapped"] or (result.solver["work_balance_error"] or 0.0) < 5e-2,
    }
    for record, kept in zip(result.history, result.closing, strict=True):
        forces = max(float(kept.equilibrium.lin.reactions), 1e-6)
        limit, unbalanced = 1e-7 * forces + ROUNDING * bulk, forces * record["force_balance_error"]
        checks |= {
            name: checks.get(name, True) and bool(holds)
            for name, holds in {
                "residual": record["residual_mN"] <= limit,
                "force balance": record["force_balance_error"] < 1e-6 or unbalanced < ROUNDING * bulk + 1e-8,
                "J": record["J_min"] > 0.0,
                "penetration": record["max_penetration_mm"] < LARGEST_SINKING * wall,
                "overlap": record["lumen_overlap_mm"] < LARGEST_SINKING * wall,
            }.items()
        }
    return ", ".join(name for name, holds in checks.items() if not holds)


def described(point: Point) -> str:
    """A point on one line."""
    return ", ".join(f"{name} {value:.4g}" for name, value in point.items()) or "human-lad"


def row(point: Point, outcome: Outcome) -> dict[str, Any]:
    """A line of the table of a survey."""
    cells = {name: point.get(name, "") for name in AXES}
    return cells | {
        "sensible": is_sensible(point),
        "outcome": outcome.kind,
        "notes": outcome.notes,
        "reason": outcome.reason,
        "seconds": round(outcome.seconds, 2),
    }
