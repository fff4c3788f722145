"""A jaw's profile from a file: points (z, y) along the face, fitted by the spline of `Spline`.

The height is linear in the slopes, so that the fit is linear least squares.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxclamp.core.failures import BadKey
from jaxclamp.physics.jaws import Spline
from jaxclamp.scenes.wording import did_you_mean, shortened

KEY = "profile_csv"
"""of a jaw's table: stands for half_width_mm, slopes and profile_residual_mm"""
MM = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1e3}
"""mm in one of each unit of a header"""
CLOSE_ENOUGH = 0.002
"""mm: slopes are added until no point is farther from the spline than this"""
MOST_SLOPES = 16
MOST_POINTS = 100_000


def fitted(table: dict[str, Any], path: str) -> dict[str, Any]:
    """The table of a jaw with numbers in place of its `profile_csv`; as it is, if it has none.

    path: of the table, for errors. Raises BadKey.
    """
    if KEY not in table:
        return table
    where = f"{path}.{KEY}"
    twice = [key for key in ("half_width_mm", "slopes", "profile_residual_mm") if key in table]
    if twice:
        raise BadKey(f"{where}: it stands for {', '.join(twice)}, which is there, too")
    if table.get("shape") != "spline":
        raise BadKey(f'{where}: expected shape = "spline" with it')
    if not isinstance(table[KEY], str):
        raise BadKey(f"{where}: expected the path of a CSV file with columns z_mm and y_mm")
    z, y = points(table[KEY], where)
    slopes, residual = fit(z, y)
    numbers = {"half_width_mm": float(np.max(z)), "slopes": slopes.tolist(), "profile_residual_mm": residual}
    return {key: value for key, value in table.items() if key != KEY} | numbers


def points(file: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the middle and heights of the points in a file, mm, (n,) each.

    Its header names z and y with their units, such as z_mm and y_um. Raises BadKey.
    """
    said = f"{where}: {shortened(Path(file).name)}"
    try:
        with Path(file).open(newline="", encoding="utf-8-sig") as stream:
            lines = list(enumerate(csv.reader(stream), 1))
    except UnicodeDecodeError as error:
        raise BadKey(f"{said}: expected UTF-8 text, found another byte at {error.start}") from None
    except (OSError, ValueError, csv.Error) as error:
        raise BadKey(f"{said}: {getattr(error, 'strerror', None) or error}") from None
    rows = [(line, row) for line, row in lines if row and not row[0].lstrip().startswith("#")]
    if not rows:
        raise BadKey(f"{said}: it is empty; expected columns z_mm and y_mm")
    names = [name.strip() for name in rows[0][1]]
    columns = [_column(names, axis, f"{said}, line {rows[0][0]}") for axis in ("z", "y")]
    if len(rows) - 1 > MOST_POINTS:
        raise BadKey(f"{said}: {len(rows) - 1} points; expected at most {MOST_POINTS}")
    found = np.array(
        [
            [factor * _number(row, i, f"{said}, line {line}", names[i]) for i, factor in columns]
            for line, row in rows[1:]
        ]
    ).reshape(-1, 2)
    z, y = np.abs(found[:, 0]), found[:, 1]
    if len(np.unique(z)) < 5:
        raise BadKey(f"{said}: {len(np.unique(z))} distances from the middle; expected 5 or more")
    return z, y


def _column(names: list[str], axis: str, said: str) -> tuple[int, float]:
    """The place of a coordinate's column, and mm in one of its unit."""
    for i, name in enumerate(names):
        base, _, unit = name.partition("_")
        if base == axis and unit in MM:
            return i, MM[unit]
    known = [f"{axis}_{unit}" for unit in MM]
    near = next((did_you_mean(name, known) for name in names if name.startswith(axis)), "")
    raise BadKey(f"{said}: no column {known[0]}; {near or 'expected one of ' + ', '.join(known)}")


def _number(row: list[str], place: int, said: str, name: str) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadKey(f"{said}, column {name}: expected a number, found {shortened(text) or 'nothing'}")
    return value


def fit(z: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Slopes of the spline nearest to points (n,), mm, and how far the farthest of them is off, mm.

    z: distances from the middle, up to the profile's end; y: heights above any level. As few slopes as bring
    all points within `CLOSE_ENOUGH`, or else the number that comes nearest.
    """
    most = min(MOST_SLOPES, (len(np.unique(z)) - 1) // 2)
    found = []
    for count in range(2, most + 1):
        basis = np.stack([_heights(z, unit) for unit in np.eye(count)], axis=1)
        basis = np.column_stack([basis, np.ones_like(z)])
        solution = np.linalg.lstsq(basis, y, rcond=None)[0]
        off = float(np.max(np.abs(basis @ solution - y)))
        found.append((off, solution[:-1]))
        if off <= CLOSE_ENOUGH:
            break
    off, slopes = min(found, key=lambda pair: (max(pair[0], CLOSE_ENOUGH), len(pair[1])))
    return slopes, off


def _heights(z: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Heights of the spline that ends at the farthest point, mm."""
    jaw = Spline(
        shape="spline",
        half_width=jnp.asarray(float(np.max(z))),
        slopes=jnp.asarray(slopes),
        edge_radius=jnp.asarray(1.0),
    )
    return np.asarray(jaw.height(z)[0])
