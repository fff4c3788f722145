"""How far the figures of a result are uncertain because numbers of its scene are: the model, not the mesh.

To first order, figure = f(p) has the variance g' C g, from the derivatives g of the figure by the numbers p
and their covariance C. The derivatives are central differences of predictions, which are linear solves with
the factors at hand. `sampled` draws scenes instead, and solves each.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxclamp.core.failures import BadAddress, EquilibriumError, Failure, NotConverged, SceneError, Singular
from jaxclamp.scenes.address import describe, get, replace
from jaxclamp.scenes.files import read_text, require_possible
from jaxclamp.scenes.scene import Scene
from jaxclamp.scenes.schema import shown
from jaxclamp.scenes.toml import parsed
from jaxclamp.solve.clamping import clamp
from jaxclamp.solve.results import Result
from jaxclamp.solve.warm import predicted
from jaxclamp.trust.estimates import figures

STEP = 1e-2
"""of a difference, in standard deviations"""
KEYS = ("source", "parameters", "correlation")
"""what a file may set"""


@dataclasses.dataclass(frozen=True)
class Covariance:
    """Numbers of a scene that are uncertain."""

    keys: tuple[str, ...]
    """as in scene files, (n,)"""
    paths: tuple[str, ...]
    """addresses in the scene, (n,)"""
    values: np.ndarray
    """of the scene, internal units, (n,)"""
    matrix: np.ndarray
    """their covariance, internal units, (n, n)"""
    source: str
    """where it comes from, as its file says"""

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations, internal units, (n,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def wide(self) -> list[str]:
        """Those whose standard deviation is more than half of the number: first order is not enough."""
        far = self.sd > 0.5 * np.abs(self.values)
        return [key for key, is_far in zip(self.keys, far, strict=True) if is_far]

    def moved(self, scene: Scene, by: np.ndarray) -> Scene:
        """The scene with its uncertain numbers moved by (n,), internal units."""
        for path, value, step in zip(self.paths, self.values, by, strict=True):
            scene = replace(scene, path, float(value + step))
        return scene


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Figures of a result with their standard deviations."""

    covariance: Covariance
    """of what they are uncertain"""
    values: dict[str, float]
    """by figure: KEY, KEY.LAYER for layers"""
    sd: dict[str, float]
    """to first order"""
    parts: dict[str, dict[str, float]]
    """by figure and number: what one standard deviation of that number alone moves it by"""
    sampled: dict[str, float] | None = None
    """standard deviations of solved samples; None without any"""
    samples: int = 0
    """that had an equilibrium"""

    def to_dict(self, errors: dict[str, dict[str, float | None]] | None = None) -> dict[str, Any]:
        """As in uncertainty.json; errors: those of the mesh, of the result."""
        return {
            "keys": list(self.covariance.keys),
            "source": self.covariance.source,
            "wide": self.covariance.wide,
            "samples": self.samples,
            "figures": {
                key: {
                    "value": value,
                    "sd": self.sd[key],
                    "sd_sampled": None if self.sampled is None else self.sampled[key],
                    "numerical_error": None if errors is None else errors.get(key, {}).get("error"),
                    "parts": self.parts[key],
                }
                for key, value in self.values.items()
            },
        }


# ---------------------------------------------------------------------------------- files


def load_covariance(path: str | Path, scene: Scene) -> Covariance:
    """What a TOML file, or a fit.json, says of the numbers of a scene. Raises SceneError."""
    text, source = read_text(Path(path), "covariance")
    try:
        if Path(path).suffix == ".json":
            return _of_a_fit(json.loads(text), scene)
        return _of_a_table(parsed(text), scene)
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None
    except (Failure, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{source}: expected a table of parameters, or fit.json ({error})") from None


def _of_a_table(table: dict[str, Any], scene: Scene) -> Covariance:
    for key in table:
        if key not in KEYS:
            raise SceneError(f"unknown key {shown(key)}: expected {', '.join(KEYS)}")
    source = table.get("source", "")
    if not isinstance(source, str):
        raise SceneError(f"source = {shown(source)}: expected a text")
    items = table.get("parameters")
    if not isinstance(items, list) or not items:
        raise SceneError("parameters: expected [[parameters]] tables with key, and sd or relative_sd")
    sds, keys = [], []
    for i, item in enumerate(items):
        sd = {k: item[k] for k in ("sd", "relative_sd") if isinstance(item, dict) and k in item}
        if len(sd) != 1 or not isinstance(item.get("key"), str) or len(item) != 2:
            raise SceneError(f"parameters[{i}]: expected key, and either sd or relative_sd")
        (kind, value), *_ = sd.items()
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise SceneError(f"parameters[{i}].{kind} = {shown(value)}: expected a positive number")
        keys.append(item["key"])
        place = _place(scene, item["key"])
        sds.append(value * (place.factor if kind == "sd" else abs(float(place.value))))
    shares = np.asarray(table.get("correlation", np.eye(len(keys))), float)
    if (
        shares.shape != (len(keys),) * 2
        or not np.allclose(shares, shares.T)
        or not np.allclose(np.diag(shares), 1)
    ):
        raise SceneError(
            f"correlation: expected {len(keys)} rows of {len(keys)}, symmetric, with 1 in the diagonal"
        )
    return _covariance(scene, keys, shares * np.outer(sds, sds), source)


def _of_a_fit(content: dict[str, Any], scene: Scene) -> Covariance:
    if content.get("ties"):
        raise SceneError(
            "the fit has ties, which a covariance does not carry: write a TOML file of parameters"
        )
    keys = list(content["parameters"])
    factors = [_place(scene, key).factor for key in keys]
    matrix = np.asarray(content["covariance"], float) * np.outer(factors, factors)
    files = ", ".join(map(str, content.get("files", ())))
    return _covariance(scene, keys, matrix, f"a fit of {files}" if files else "a fit")


def _place(scene: Scene, key: str) -> Any:
    """The address of a single number. Raises SceneError."""
    try:
        place = describe(scene, key)
    except BadAddress as error:
        raise SceneError(str(error)) from None
    if np.ndim(place.value):
        raise SceneError(f"{key}: it is a list of numbers; expected one, such as {key}[0]")
    return place


def _covariance(scene: Scene, keys: list[str], matrix: np.ndarray, source: str) -> Covariance:
    """With the numbers of the scene. Raises SceneError for what is no covariance."""
    if len(set(keys)) < len(keys):
        raise SceneError("a parameter is named twice")
    if matrix.shape != (len(keys),) * 2 or not np.all(np.isfinite(matrix)):
        raise SceneError(f"expected a covariance of {len(keys)} by {len(keys)} numbers")
    least = float(np.linalg.eigvalsh(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix))))[0])
    if not least > -1e-9:
        raise SceneError("the covariance is not positive: no numbers vary together like that")
    paths = [_place(scene, key).path for key in keys]
    values = np.array([float(get(scene, path)) for path in paths])
    return Covariance(tuple(keys), tuple(paths), values, matrix, source)


# ---------------------------------------------------------------------------------- propagation


def uncertainty(result: Result, covariance: Covariance) -> Uncertainty:
    """Standard deviations of the main figures to first order: two linear solves for each number.

    Raises EquilibriumError if the stop was not reached, or a neighbouring scene cannot be told.
    """
    result.require(to_stop=True)
    values, sd = figures(result), covariance.sd
    slopes = np.zeros((len(values), sd.size))
    for i, step in enumerate(np.diag(STEP * sd)):
        ahead, behind = (_near(result, covariance, sign * step) for sign in (1.0, -1.0))
        slopes[:, i] = [(ahead[key] - behind[key]) / (2.0 * STEP * sd[i]) for key in values]
    variances = np.einsum("fi,ij,fj->f", slopes, covariance.matrix, slopes)
    spread = np.sqrt(np.maximum(variances, 0.0))
    parts = [dict(zip(covariance.keys, map(float, row * sd), strict=True)) for row in slopes]
    return Uncertainty(
        covariance,
        values,
        dict(zip(values, map(float, spread), strict=True)),
        dict(zip(values, parts, strict=True)),
    )


def _near(result: Result, covariance: Covariance, by: np.ndarray) -> dict[str, float]:
    try:
        return figures(predicted(result, covariance.moved(result.scene, by)))
    except Singular as error:
        said = "a smaller standard deviation"
        failure = NotConverged(str(error))
        raise EquilibriumError("uncertainty", "a neighbouring scene", failure, said) from None


def sampled(
    found: Uncertainty,
    result: Result,
    samples: int,
    seed: int = 0,
    tell: Callable[[float, str], Any] = lambda fraction, said: None,
) -> Uncertainty:
    """The same with standard deviations of scenes that are drawn (Latin hypercube, normal) and solved.

    Scenes that are impossible, or have no equilibrium, are left out; `samples` says how many are not.
    """
    from scipy.stats import norm, qmc

    c = found.covariance
    root = np.linalg.cholesky(c.matrix + 1e-14 * np.diag(np.diag(c.matrix)))
    unit = qmc.LatinHypercube(d=c.sd.size, rng=np.random.default_rng(seed)).random(samples)
    rows = []
    for i, draw in enumerate(norm.ppf(unit)):
        tell(i / samples, f"sample {i + 1} of {samples}")
        try:
            scene = c.moved(result.scene, root @ draw)
            require_possible(scene)
            rows.append(figures(clamp(scene, guess=result)))
        except (SceneError, EquilibriumError):
            continue
    enough = len(rows) > 1
    spread = (
        {key: float(np.std([row[key] for row in rows], ddof=1)) for key in found.values} if enough else None
    )
    return dataclasses.replace(found, sampled=spread, samples=len(rows))
