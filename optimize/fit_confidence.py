"""How sure fitted numbers are: covariance, intervals by profile likelihood, and what the data do not tell."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import stats

from optimize.fit_search import Best, Search, moved

LEVEL = 0.95
"""of confidence intervals"""
FARTHEST = 7.0
"""|x| of a number that is as good as at the end of its range: a share of 0.001 from it"""
CLOSE = 0.02
"""how well the end of an interval is found: share of the rise of the sum of squares' root"""
MOST_TRIALS = 12
"""least squares for one end of an interval"""
LONGEST = 2.0
"""step of x along a profile where the quadratic one says nothing"""
MOST_RIVALS = 3
"""other optima whose profiles are followed, the lowest first"""
FACTOR = 5.0
"""a positive number is identified if its interval's ends differ by less than this factor"""
SHARE = 0.5
"""an angle or a share is identified if its interval is less than this share of its range"""


@dataclasses.dataclass(frozen=True)
class Interval:
    """Confidence in one number."""

    standard_error: float
    """of the quadratic approximation, unit of the scene file; infinite if there is none"""
    lower: float
    """unit of the scene file"""
    upper: float
    """unit of the scene file"""
    bounded: tuple[bool, bool]
    """False where the data set no end, and the interval ends with the range that was allowed"""
    identified: bool
    """True if the data tell the number"""


@dataclasses.dataclass(frozen=True)
class Confidence:
    """Confidence in all numbers."""

    intervals: tuple[Interval, ...]
    """one for each"""
    covariance: np.ndarray
    """(n, n), units of the scene file; not numbers where the data tell nothing"""
    correlation: np.ndarray
    """(n, n)"""
    weak: tuple[str, ...]
    """what the data cannot tell, in words"""
    strong: tuple[str, ...]
    """combinations that they tell although not each of their numbers, in words"""
    independent: float
    """how many residuals count: all of scatter, few of a pattern"""
    rivals: tuple[np.ndarray, ...] = ()
    """x of other optima that fit about as well; intervals span them"""


class Better(Exception):
    """A profile came across a smaller sum of squares; `x` is where."""

    def __init__(self, x: np.ndarray) -> None:
        super().__init__(x)
        self.x = x


def confidence(search: Search, best: Best, patterns: list[int]) -> Confidence:
    """Confidence about an optimum; raises `Better` if there is a lower one beside it."""
    x = np.clip(best.x, -FARTHEST, FARTHEST)
    slopes = search.slopes(x, best.scatter)
    residuals = search.residuals(x, best.scatter)
    counted, independent = _independent(search, residuals, patterns)
    independent = max(independent, x.size + 1.0)
    movable = np.max(np.abs(slopes), axis=1) > 0.0
    variance = max(float(np.sum(residuals[movable] ** 2)), 1e-20) / max(counted - x.size, 1)
    variance *= max(counted / independent, 1.0)
    spread = stats.t.ppf(0.5 + 0.5 * LEVEL, independent - x.size)
    covariance = _covariance(slopes, variance)
    rise = variance * spread**2
    near = (other for other, squares in best.others if squares <= best.squares + rise)
    rivals = tuple(np.clip(other, -FARTHEST, FARTHEST) for other in itertools.islice(near, MOST_RIVALS))
    optima = [(x, covariance)]
    optima += [(other, _covariance(search.slopes(other, best.scatter), variance)) for other in rivals]
    intervals = tuple(_interval(search, best, number, optima, rise, spread) for number in range(x.size))
    units = np.array([p.slope(v) for p, v in zip(search.freedom.parameters, x, strict=True)])
    in_units = covariance * np.outer(units, units)
    sizes = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    weak, strong = _directions(search, x, slopes / np.sqrt(variance), spread, intervals)
    return Confidence(
        intervals, in_units, covariance / np.outer(sizes, sizes), weak, strong, float(independent), rivals
    )


def _independent(search: Search, residuals: np.ndarray, patterns: list[int]) -> tuple[int, float]:
    """How many residuals the fitted numbers move, and how many of them count as independent.

    Scatter changes its sign every other time. Of a pattern, two values count for each run of one sign.
    """
    counted, independent, movable = 0, 0.0, moved(search, search.freedom.start())
    for number, (_, begin, end) in enumerate(search.problem.runs):
        if not movable[search.problem.group[begin]]:
            continue
        part = residuals[begin:end][search.order(number)]
        runs = 1 + int(np.sum((part[1:] > 0.0) != (part[:-1] > 0.0)))
        counted += part.size
        independent += min(2.0 * runs, part.size) if number in patterns else part.size
    return counted, independent


LEAST_KNOWN = 1e-14
"""share of the information's largest eigenvalue that the least counts as: what is not told varies widely"""


def _covariance(slopes: np.ndarray, variance: float) -> np.ndarray:
    """Of x, in the quadratic approximation."""
    information, vectors = np.linalg.eigh(slopes.T @ slopes)
    floor = max(LEAST_KNOWN * float(information[-1]), 1e-300)
    found: np.ndarray = (vectors * (variance / np.maximum(information, floor))) @ vectors.T
    return found


Optimum = tuple[np.ndarray, np.ndarray]
"""x, and its covariance in the quadratic approximation"""


def _interval(
    search: Search, best: Best, number: int, optima: list[Optimum], rise: float, spread: float
) -> Interval:
    """From the lowest to the highest end of the profiles about all optima that fit about as well."""
    parameter, (x, covariance) = search.freedom.parameters[number], optima[0]
    lower, upper = (
        [_end(search, best, number, sign, optimum, rise, spread) for optimum in optima]
        for sign in (-1.0, 1.0)
    )
    bounded = None not in lower, None not in upper
    low = float(parameter.value(min(e for e in lower if e is not None))) if bounded[0] else parameter.lower
    high = float(parameter.value(max(e for e in upper if e is not None))) if bounded[1] else parameter.upper
    error = float(np.sqrt(max(covariance[number, number], 0.0))) * parameter.slope(x[number])
    narrow = (
        high < FACTOR * low
        if parameter.relative
        else high - low < SHARE * (parameter.upper - parameter.lower)
    )
    return Interval(error, low, high, bounded, bool(narrow))


def _end(
    search: Search, best: Best, number: int, sign: float, optimum: Optimum, rise: float, spread: float
) -> float | None:
    """x where the least sum of squares with x held is `rise` above the least of all; None if it never is.

    The square root of the rise is nearly a straight line in x, exactly one for a linear model.
    """
    x, covariance = optimum
    variance = covariance[number, number]
    along = covariance[:, number] / variance if variance > 0.0 else np.zeros(x.size)
    along = np.clip(np.where(np.isfinite(along), along, 0.0), -3.0, 3.0)
    along[number] = 1.0
    reach = spread * float(np.sqrt(max(variance, 0.0)))
    at = min(reach, LONGEST) if reach > 0.0 else LONGEST
    inside: tuple[float, float] = (0.0, 0.0)
    outside: tuple[float, float] | None = None
    near = x
    for _ in range(MOST_TRIALS):
        beyond = abs(x[number] + sign * at) > FARTHEST and outside is None
        if beyond:
            at = max(FARTHEST - sign * x[number], 0.0)
        plain = np.where(np.arange(x.size) == number, x[number] + sign * at, near)
        starts = (plain, np.clip(near + (plain - near)[number] * along, -2 * FARTHEST, 2 * FARTHEST))
        start = min(starts, key=lambda start: float(np.sum(search.residuals(start, best.scatter) ** 2)))
        found, squares = search.minimise(start, best.scatter, number)
        if squares < best.squares - 0.1 * rise:
            raise Better(found)
        height = float(np.sqrt(max(squares - best.squares, 0.0) / rise))
        if abs(height - 1.0) < CLOSE:
            break
        if height < 1.0:
            if beyond:
                return None
            inside, near = (at, height), found
        else:
            outside = (at, height)
        if outside is None:
            at = at * min(max(1.05 / max(height, 1e-3), 1.2), 3.0)
        else:
            share = (1.0 - inside[1]) / (outside[1] - inside[1])
            at = inside[0] + (outside[0] - inside[0]) * min(max(share, 0.1), 0.9)
    else:
        if outside is None:
            return None
    return float(x[number] + sign * at)


# ------------------------------------------------------------------------------------- in words

UNTOLD, TOLD = 0.7, 0.2
"""natural size (logarithm of a factor) of a combination's confidence, above which it is untold, below which
told"""
TAKES_PART = 0.2
"""share of the largest item of a combination that an item has to have to be named"""


def _directions(
    search: Search, x: np.ndarray, slopes: np.ndarray, spread: float, intervals: tuple[Interval, ...]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Eigenvectors of the information matrix in natural sizes, in words: untold ones, told ones."""
    freedom = search.freedom
    sizes = np.array([p.natural(v) for p, v in zip(freedom.parameters, x, strict=True)])
    natural = slopes / np.where(np.abs(sizes) > 1e-12, sizes, 1e-12)
    information, vectors = np.linalg.eigh(natural.T @ natural)
    weak, strong = [], []
    for value, vector in zip(information, vectors.T, strict=True):
        uncertain = spread / np.sqrt(max(value, 1e-300))
        parts = np.flatnonzero(np.abs(vector) >= TAKES_PART * np.max(np.abs(vector)))
        names = [freedom.name(int(i)) for i in parts]
        if uncertain > UNTOLD:
            weak.append(_untold(search, parts, vector, names))
        elif uncertain < TOLD and len(parts) > 1 and any(not intervals[i].identified for i in parts):
            strong.append(_told(search, parts, vector, uncertain))
    return tuple(weak), tuple(strong)


def _untold(search: Search, parts: np.ndarray, vector: np.ndarray, names: list[str]) -> str:
    if len(parts) == 1:
        return f"the data do not tell {names[0]}"
    largest = parts[np.argmax(np.abs(vector[parts]))]
    scale = (
        np.log(2.0) / vector[largest]
        if search.freedom.parameters[largest].relative
        else 0.5 / vector[largest]
    )
    moves = []
    for i, name in zip(parts, names, strict=True):
        parameter, change = search.freedom.parameters[i], scale * vector[i]
        if parameter.relative:
            moves.append(f"{name} times {np.exp(change):.2g}")
        else:
            moves.append(f"{name} {change * parameter.step:+.2g}{' deg' if parameter.unit == 'deg' else ''}")
    return f"the data tell {_listed(names)} only together: {_listed(moves)} fits about as well"


def _told(search: Search, parts: np.ndarray, vector: np.ndarray, uncertain: float) -> str:
    relative = [i for i in parts if search.freedom.parameters[i].relative]
    largest = parts[np.argmax(np.abs(vector[parts]))]
    scale = vector[largest]
    if len(relative) < len(parts):
        names = [search.freedom.name(int(i)) for i in parts]
        return f"the data tell one combination of {_listed(names)} well"
    powers = " ".join(f"({search.freedom.name(int(i))})^{vector[i] / scale:.2g}" for i in parts)
    return f"the data tell {powers} to {np.expm1(uncertain / abs(scale)):.1%}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
