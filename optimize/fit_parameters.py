"""Which numbers of a scene a fit may change: addresses, ties, and a vector without bounds for them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp import Scene, SceneError, replace
from jaxclamp.scenes.address import Place, describe, get

SPANS = {"kPa": (1e-4, 1e5), "": (1e-3, 1e3)}
"""least and greatest value of positive constants, by unit, inside the range of their field"""
SIZES = 10.0
"""a length stays within this factor of the scene's own"""
EDGE = 1e-3
"""share of the range by which a start keeps away from its ends, where the vector is infinite"""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number that is fitted."""

    path: str
    """address in the scene, without unit"""
    key: str
    """the same with its unit, as in scene files"""
    unit: str
    """of the scene file"""
    factor: float
    """internal units in one unit of the scene file"""
    lower: float
    """least value, unit of the scene file"""
    upper: float
    """greatest value"""
    start: float
    """the scene's own"""
    relative: bool
    """True for what is positive and known by its factor; False for angles and shares"""

    def value(self, x: Array | float) -> Array:
        """The number, unit of the scene file, for any x: between its bounds, evenly in x in the middle."""
        share = jax.nn.sigmoid(jnp.asarray(x))
        low, high = self._ends()
        inside = low + (high - low) * share
        return jnp.exp(inside) if self.relative else inside

    def x(self, value: float) -> float:
        """The x of a number; of one at a bound or beyond, that of one a little inside."""
        low, high = self._ends()
        inside = math.log(max(value, 1e-300)) if self.relative else value
        share = min(max((inside - low) / (high - low), EDGE), 1.0 - EDGE)
        return math.log(share / (1.0 - share))

    def _ends(self) -> tuple[float, float]:
        return (math.log(self.lower), math.log(self.upper)) if self.relative else (self.lower, self.upper)

    def slope(self, x: float) -> float:
        """d(value)/dx, unit of the scene file."""
        return float(jax.grad(lambda x: self.value(x))(jnp.asarray(x, float)))

    def natural(self, x: float) -> float:
        """d(natural size)/dx; the natural size is the logarithm of what is relative, else value / `step`."""
        return self.slope(x) / (float(self.value(x)) if self.relative else self.step)

    @property
    def step(self) -> float:
        """A difference that matters as much as a factor of e does: a sixth of the range, 15 degrees of 90."""
        return (self.upper - self.lower) / 6.0


@dataclasses.dataclass(frozen=True)
class Tie:
    """A number of the scene that follows another: left = factor * right, in internal units."""

    left: str
    """address without unit"""
    right: str
    """address without unit"""
    factor: float
    """no unit"""


@dataclasses.dataclass(frozen=True)
class Freedom:
    """What a fit may change."""

    scene: Scene
    """the start"""
    parameters: tuple[Parameter, ...]
    """in order of the vector x"""
    ties: tuple[Tie, ...] = ()
    """numbers that follow"""

    def values(self, x: np.ndarray | Array) -> list[Array]:
        """The numbers, units of scene files."""
        return [p.value(x[i]) for i, p in enumerate(self.parameters)]

    def scene_at(self, x: Array) -> Scene:
        """The scene with the numbers that a vector x (n,) stands for; a JAX function."""
        scene = self.scene
        for parameter, value in zip(self.parameters, self.values(x), strict=True):
            scene = replace(scene, parameter.path, value * parameter.factor)
        for tie in self.ties:
            scene = replace(scene, tie.left, tie.factor * jnp.asarray(get(scene, tie.right)))
        return scene

    def start(self) -> np.ndarray:
        """The vector of the scene's own numbers."""
        return np.array([p.x(p.start) for p in self.parameters])

    def another_start(self, random: np.random.Generator) -> np.ndarray:
        """A vector at random: a factor of up to 30 either way, angles and shares anywhere."""
        found = []
        for p in self.parameters:
            spread = random.uniform(-1.0, 1.0)
            middle = 0.5 * (p.lower + p.upper) + 0.45 * spread * (p.upper - p.lower)
            factor = 30.0 if p.unit != "mm" else 1.1
            found.append(p.x(p.start * factor**spread if p.relative else middle))
        return np.array(found)

    def name(self, number: int) -> str:
        """A parameter as people call it, such as "k1 of the media"."""
        parts = re.fullmatch(r"artery\.layers\[(\d+)\]\.(?:material\.)?(.+)", self.parameters[number].path)
        if parts is None:
            return self.parameters[number].path.rpartition(".")[2].replace("_", " ")
        return f"{parts[2].replace('_', ' ')} of {self.scene.artery.layers[int(parts[1])].name}"


def freedom(
    scene: Scene, free: Sequence[str] = (), fixed: Sequence[str] = (), ties: Sequence[str] = ()
) -> Freedom:
    """What may change: `free`, or all constants of every layer but the bulk modulus, without `fixed` and
    ties.

    Addresses are those of scenes, or begin with a layer's name: "artery.layers[0].material.c_kPa" is
    "media.c". A tie reads "adventitia.c = media.c / 10". Raises SceneError.
    """
    tied = [_tie(scene, text) for text in ties]
    held = {_place(scene, address).path for address in fixed} | {tie.left for tie in tied}
    chosen = [_place(scene, address) for address in free] if free else constants(scene)
    both = next((p for p in chosen if p.path in held), None) if free else None
    if both is not None:
        raise SceneError(f"--free {both.key}: expected a number that is neither fixed nor tied")
    unique = {place.path: place for place in chosen if place.path not in held}
    if not unique:
        raise SceneError("expected at least one number to fit, found all of them fixed or tied")
    return Freedom(scene, tuple(_parameter(place) for place in unique.values()), tuple(tied))


def constants(scene: Scene) -> list[Place]:
    """The constants of every layer's law but the bulk modulus."""
    names = [
        f"artery.layers[{i}].material.{field.name}"
        for i, layer in enumerate(scene.artery.layers)
        for field in dataclasses.fields(cast(Any, layer.material))
        if "range" in field.metadata and field.name != "bulk"
    ]
    return [describe(scene, name) for name in names]


def _place(scene: Scene, address: str) -> Place:
    """A number by its address, or by the name of a layer and that of a constant."""
    address = address.strip()
    for i, layer in enumerate(scene.artery.layers):
        if address.startswith(f"{layer.name}."):
            rest = address[len(layer.name) + 1 :]
            own = rest.startswith(("inner_radius", "thickness", "opening_angle", "material."))
            address = f"artery.layers[{i}].{'' if own else 'material.'}{rest}"
            break
    place = describe(scene, address)
    if np.ndim(place.value) != 0:
        raise SceneError(f"{place.key}: expected a single number, found a list")
    return place


_TIE = re.compile(r"([^=*/]+)=([^=*/]+)(?:([*/])([^=*/]+))?")


def _tie(scene: Scene, text: str) -> Tie:
    """Read "left = right", with "* number", "/ number" or "number *". Raises SceneError."""
    match = _TIE.fullmatch(text.strip())
    if match is None:
        raise SceneError(f"--tie {text!r}: expected a tie such as adventitia.c = media.c / 10")
    first, mark, last = match[2].strip(), match[3], (match[4] or "1").strip()
    if mark == "*" and _number(last) is None:
        first, last = last, first
    factor = _number(last)
    left, right = _place(scene, match[1]), _place(scene, first)
    if left.range.unit != right.range.unit:
        raise SceneError(f"--tie {text!r}: expected numbers of one unit, found {left.key} and {right.key}")
    if left.path == right.path:
        raise SceneError(f"--tie {text!r}: expected two different numbers")
    if not factor:
        raise SceneError(f"--tie {text!r}: expected a number other than 0 as the factor")
    factor = 1.0 / factor if mark == "/" else factor
    return Tie(left.path, right.path, factor)


def _number(text: str) -> float | None:
    try:
        found = float(text)
    except ValueError:
        return None
    return found if math.isfinite(found) else None


def _parameter(place: Place) -> Parameter:
    limits, unit = place.range, place.range.unit
    start = float(np.asarray(place.value)) / place.factor
    relative = limits.lower >= 0.0 and (unit in ("kPa", "mm") or (unit == "" and limits.upper > 100.0))
    if not relative:
        return Parameter(
            place.path, place.key, unit, place.factor, limits.lower, limits.upper, start, relative
        )
    least, most = (start / SIZES, start * SIZES) if unit == "mm" else SPANS[unit]
    lower, upper = max(least, limits.lower), min(most, limits.upper)
    return Parameter(place.path, place.key, unit, place.factor, lower, upper, start, relative)
