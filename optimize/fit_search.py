"""The best constants for test data: least squares from several starts, and how columns weigh beside each
other.

Standard deviations of a file weigh its rows. Columns weigh beside each other by the standard deviations of
the files if all have some; else by the scatter of their own residuals about the law, the most likely weights
if it is scatter; and where the law does not follow the data, so that residuals are a pattern and not scatter,
by their full scale.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp import Progress
from optimize.drivers import levenberg_marquardt
from optimize.fit_model import Problem
from optimize.fit_parameters import Freedom

LEAST_SCATTER = 1e-6
"""share of a column's full scale that its scatter is at least"""
FULL_SCALE = 0.01
"""share of the largest value of a column that is its scatter where nothing better is known"""
MOST_ROUNDS, SETTLED = 20, 0.01
"""rounds of weighing columns anew; change of a scatter that ends them"""
DISTINCT = 0.02
"""share of the range of a number by which optima that are told apart differ at least"""
MUCH_WORSE = 2.0
"""sums of squares that are this many times the least are not looked at again"""


@dataclasses.dataclass(frozen=True)
class Best:
    """Where the sum of squares is least."""

    x: np.ndarray
    """(n,)"""
    scatter: np.ndarray
    """(names,) standard deviation of each column's residuals, internal units, or over those of the file"""
    squares: float
    """sum of squares of residuals over their standard deviations"""
    weighed_by: str
    """how columns weigh beside each other, in words"""
    starts: int = 1
    """how many were tried"""
    agreeing: int = 1
    """how many of them ended there"""
    others: tuple[tuple[np.ndarray, float], ...] = ()
    """other optima that starts ended at: x, and the sum of squares with the same weights"""


class Search:
    """Residuals and their least squares for one problem, compiled once."""

    def __init__(self, problem: Problem, freedom: Freedom) -> None:
        self.problem, self.freedom = problem, freedom
        self._values, self._slopes = jax.jit(self._residuals), jax.jit(jax.jacfwd(self._residuals))

    def _residuals(self, x: Any, rest: Any) -> Any:
        deviations, measured = rest
        return (self.problem.predicted(self.freedom.scene_at(x)) - measured) / deviations

    def _rest(self, scatter: np.ndarray) -> tuple[Any, Any]:
        deviations = scatter[self.problem.group] * self.problem.weights
        return jnp.asarray(deviations), jnp.asarray(self.problem.measured)

    def residuals(self, x: np.ndarray, scatter: np.ndarray) -> np.ndarray:
        """Predicted less measured, over the standard deviation, (n,)."""
        return np.asarray(self._values(jnp.asarray(x), self._rest(scatter)))

    def predicted(self, x: np.ndarray) -> np.ndarray:
        """What is compared, predicted, (n,), internal units."""
        ones = np.ones(len(self.problem.names))
        return self.problem.measured + self.residuals(x, ones) * self.problem.weights

    def slopes(self, x: np.ndarray, scatter: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals by x, (n, n_parameters)."""
        return np.asarray(self._slopes(jnp.asarray(x), self._rest(scatter)))

    def order(self, run: int) -> np.ndarray:
        """Positions of a run's residuals, sorted by what they are drawn against."""
        number, column = self.problem.runs[run][0], self.problem.column(run)
        kept = ~np.isnan(column.values)
        return np.argsort(self.problem.experiments[number].along.values[kept], kind="stable")

    def minimise(
        self, x: np.ndarray, scatter: np.ndarray, held: int | None = None
    ) -> tuple[np.ndarray, float]:
        """x of least squares from a start, with one parameter held, and the sum of squares."""
        free = np.arange(x.size) != (-1 if held is None else held)
        rest = self._rest(scatter)

        def whole(part: np.ndarray) -> np.ndarray:
            filled = np.array(x, dtype=float)
            filled[free] = part
            return filled

        if not free.any():
            return x, float(np.sum(self.residuals(x, scatter) ** 2))
        found, squares = levenberg_marquardt(
            lambda part: self._values(whole(part), rest),
            lambda part: np.asarray(self._slopes(whole(part), rest))[:, free],
            np.asarray(x)[free],
        )
        return whole(found), squares

    def scatter(self, x: np.ndarray) -> np.ndarray:
        """Scatter of each column about the prediction, (names,), as in `Best`."""
        unweighed = self.residuals(x, np.ones(len(self.problem.names))) ** 2
        free = 1.0 - min(x.size / self.problem.measured.size, 0.9)
        found = [np.mean(unweighed[self.problem.group == k]) / free for k in range(len(self.problem.names))]
        return np.maximum(np.sqrt(found), LEAST_SCATTER * self.full_scale())

    def full_scale(self) -> np.ndarray:
        """Largest value of each column, (names,), in the unit of `Best.scatter`."""
        over = np.abs(self.problem.measured) / self._mean_weights()[self.problem.group]
        return np.array(
            [max(np.max(over[self.problem.group == k]), 1e-12) for k in range(len(self.problem.names))]
        )

    def _mean_weights(self) -> np.ndarray:
        weights, group = self.problem.weights, self.problem.group
        return np.array([np.mean(weights[group == k]) for k in range(len(self.problem.names))])

    def best(self, starts: int, seed: int, tell: Callable[[Progress], Any]) -> Best:
        """The least of several starts, the first of which is the scene itself."""
        random = np.random.default_rng(seed)
        guesses = [self.freedom.start(), *(self.freedom.another_start(random) for _ in range(starts - 1))]
        stated = bool(np.all(self.problem.weighed))
        first = np.ones(len(self.problem.names)) if stated else FULL_SCALE * self.full_scale()
        ends = []
        for number, guess in enumerate(guesses):
            tell(Progress("fitting", number / starts, f"start {number + 1} of {starts}"))
            ends.append(self.minimise(guess, first))
        found = self._weighed(ends, first, stated)
        agreeing = sum(_alike(found.x, self.minimise(end[0], found.scatter)[0]) for end in ends)
        return dataclasses.replace(found, starts=starts, agreeing=agreeing)

    def _weighed(self, ends: list[tuple[np.ndarray, float]], first: np.ndarray, stated: bool) -> Best:
        """The least of what starts ended at, with the columns' final weights; and the others."""
        x, squares = min(ends, key=lambda end: end[1])
        if stated:
            return self._among(Best(x, first, squares, "the standard deviations of the files"), ends)
        if np.unique(self.problem.group).size > 1:
            settled = self._among(self._settled(x), ends)
            if not patterned(self, settled.x, settled.scatter):
                return settled
        return self._among(Best(x, first, squares, "their full scale"), ends)

    def _settled(self, x: np.ndarray) -> Best:
        """The optimum near x with columns weighed by their own scatter about it."""
        scatter, squares = self.scatter(x), 0.0
        for _ in range(MOST_ROUNDS):
            x, squares = self.minimise(x, scatter)
            before, scatter = scatter, self.scatter(x)
            if np.max(np.abs(scatter / before - 1.0)) < SETTLED:
                break
        return Best(x, before, squares, "the scatter of each column")

    def _among(self, best: Best, ends: list[tuple[np.ndarray, float]]) -> Best:
        """The least of all ends with the weights of one of them, and the others that differ."""
        optima = [(best.x, best.squares)]
        for end, squares in ends:
            if squares > MUCH_WORSE * min(ends, key=lambda end: end[1])[1]:
                continue
            found = self.minimise(end, best.scatter)
            if not any(_alike(found[0], other) for other, _ in optima):
                optima.append(found)
        (x, squares), *others = sorted(optima, key=lambda found: found[1])
        return dataclasses.replace(best, x=x, squares=squares, others=tuple(others))


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two vectors are of one optimum; at the end of a range all x are one."""
    shares = np.asarray(jax.nn.sigmoid(jnp.asarray([a, b])))
    return bool(np.max(np.abs(shares[0] - shares[1])) < DISTINCT)


def moved(search: Search, x: np.ndarray) -> np.ndarray:
    """(names,) True for columns that the fitted numbers move at all."""
    slopes = search.slopes(x, search.full_scale())
    group = search.problem.group
    return np.array([np.max(np.abs(slopes[group == k])) > 1e-9 for k in range(len(search.problem.names))])


def patterned(search: Search, x: np.ndarray, scatter: np.ndarray) -> list[int]:
    """Runs (positions in `Problem.runs`) whose residuals are a pattern and not scatter."""
    residuals, movable = search.residuals(x, scatter), moved(search, x)
    found = []
    for number, (_, begin, end) in enumerate(search.problem.runs):
        column = int(search.problem.group[begin])
        part = residuals[begin:end] * scatter[column] / search.full_scale()[column]
        order = search.order(number)
        if movable[column] and np.sqrt(np.mean(part**2)) > FOLLOWED and is_pattern(part[order]):
            found.append(number)
    return found


FOLLOWED = 1e-4
"""root mean square of residuals over full scale below which a law follows, whatever their pattern"""
UNLIKELY = -3.5
"""standard scores of the number of runs of one sign, below which residuals are a pattern"""


def is_pattern(residuals: np.ndarray) -> bool:
    """True if residuals in order keep their sign for longer than scatter would (Wald and Wolfowitz's runs
    test)."""
    positive = residuals > 0.0
    n, n1 = residuals.size, int(positive.sum())
    n2 = n - n1
    if n < 8:
        return False
    if min(n1, n2) == 0:
        return True
    runs = 1 + int(np.sum(positive[1:] != positive[:-1]))
    mean = 1.0 + 2.0 * n1 * n2 / n
    variance = (mean - 1.0) * (mean - 2.0) / (n - 1.0)
    return bool(variance > 0.0 and (runs - mean) / np.sqrt(variance) < UNLIKELY)
