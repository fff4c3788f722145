"""Sparse symmetric direct solvers behind one protocol: factor, solve, inertia.

The pattern (upper triangle, compressed rows) is analysed once; values change. Every solve is
checked against the matrix and refined if needed; a back end that does not load, cannot factor or
solves wrongly hands over to the next one, and SciPy's SuperLU is always there.
"""

from __future__ import annotations

import importlib.util
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from jaxclamp.core.failures import Singular
from jaxclamp.fem.pattern import Pattern

RELATIVE_RESIDUAL = 1e-8
"""A solution with a larger ||K x - b|| / ||b|| is refused, unless it is as good as float64 can tell:"""
ROUNDING, LEAST_ACCURACY = 100.0 * np.finfo(float).eps, 1e-4
"""||K x - b|| may be the first times max |K| ||x||, up to the second times ||b||: an artery that little but
itself holds sideways answers a small force with a large x, and its rounding alone is more than that limit"""


class BackEnd(Protocol):
    """One way to factor a symmetric matrix with a fixed pattern."""

    def factor(self, values: np.ndarray) -> int | None:
        """Factor; returns the number of negative eigenvalues, None if unknown. May raise Singular."""

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Solve for right-hand sides (n, n_rhs)."""


class _Pardiso:
    """MKL PARDISO, L D L' with Bunch-Kaufman pivots (py-mkl-pardiso)."""

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern
        self._solver: Any = None

    def factor(self, values: np.ndarray) -> int | None:
        import pymklpardiso

        try:
            if self._solver is None:
                n = self._pattern.n
                matrix = sp.csr_matrix((values, self._pattern.indices, self._pattern.indptr), shape=(n, n))
                self._solver = pymklpardiso.PardisoSolver(
                    matrix, pymklpardiso.MTYPE_REAL_SYM_INDEF, iparms=_PARDISO_SETTINGS
                )
            else:
                self._solver.refactor(values)
        except RuntimeError as error:
            raise Singular(str(error)) from error
        if self._solver.get_iparm_value(13) > 0:
            raise Singular("the tangent is singular to working precision")
        return int(self._solver.get_iparm_value(22))

    def solve(self, b: np.ndarray) -> np.ndarray:
        return np.asarray(self._solver.solve(b))


# indices and meanings: oneMKL reference, pardiso iparm. No default start (0), METIS (1), no
# refinement by PARDISO (7: ours is checked), pivot perturbation 1e-13 (9), scaling and matching
# off (10, 12): the tangent is near definite, and the analysis must not depend on values.
_PARDISO_SETTINGS = {0: 1, 1: 2, 7: 0, 9: 13, 10: 0, 12: 0, 17: -1}


class _Rslab:
    """RSLAB, supernodal L D L' (rslab)."""

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern
        self._symbolic: Any = None

    def _lower(self, values: np.ndarray) -> sp.csc_matrix:
        n = self._pattern.n  # the upper triangle by rows is the lower one by columns
        return sp.csc_matrix((values, self._pattern.indices, self._pattern.indptr), shape=(n, n))

    def factor(self, values: np.ndarray) -> int | None:
        import rslab

        try:
            if self._symbolic is None:
                self._symbolic = rslab.analyze(
                    self._lower(values),
                    path="ldlt",
                    ordering="metis",
                    threads=cores(),  # never a string: see the tests
                )
            self._factors = self._symbolic.factor(self._lower(values))
        except (RuntimeError, ValueError, ArithmeticError) as error:
            raise Singular(str(error)) from error
        return int(self._factors.inertia[1])

    def solve(self, b: np.ndarray) -> np.ndarray:
        return np.asarray(self._factors.solve_many(b))


class _SuperLU:
    """SciPy's SuperLU in symmetric mode; no inertia."""

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern

    def factor(self, values: np.ndarray) -> int | None:
        try:
            self._factors = scipy.sparse.linalg.splu(
                full_matrix(self._pattern, values).tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise Singular(str(error)) from error
        return None

    def solve(self, b: np.ndarray) -> np.ndarray:
        return self._factors.solve(b)


def full_matrix(pattern: Pattern, values: np.ndarray) -> sp.csr_matrix:
    """Both triangles of the symmetric matrix."""
    n = pattern.n
    upper = sp.csr_matrix((values, pattern.indices, pattern.indptr), shape=(n, n))
    return (upper + sp.triu(upper, k=1).T).tocsr()


BACK_ENDS: dict[str, tuple[Callable[[Pattern], BackEnd], str]] = {
    "pardiso": (_Pardiso, "pymklpardiso"),
    "rslab": (_Rslab, "rslab"),
    "splu": (_SuperLU, "scipy"),
}


MANY_UNKNOWNS = 12_000
"""from here on the threads of rslab pay (measured on two cores: 0.4 s against 0.65 s for 31,000
unknowns, but 27 to 40 ms against 25 ms for 4,300)"""


def available(unknowns: int = 0) -> list[str]:
    """Names of the back ends that can be imported, the best for so many unknowns first."""
    found = [name for name, (_, module) in BACK_ENDS.items() if importlib.util.find_spec(module)]
    threaded = unknowns >= MANY_UNKNOWNS and cores() > 1
    return sorted(found, key=lambda name: name != "rslab") if threaded else found


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LinearSolver:
    """Factor and solve with the first back end that can; counts and times what it does."""

    def __init__(self, pattern: Pattern, choice: str = "auto") -> None:
        self._pattern = pattern
        names = available(pattern.n)
        if choice != "auto":
            names = [choice, *[n for n in names if n != choice]]
        self._back_ends = {name: BACK_ENDS[name][0](pattern) for name in names}
        self._names = names
        self._name = names[0]
        self._values: np.ndarray = np.empty(0)
        self._choice = choice
        self.reset_counts()

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process, a solver without factors."""
        return LinearSolver, (self._pattern, self._choice)

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return self._pattern.n

    def reset_counts(self) -> None:
        """Count and time from here."""
        self.factorisations = 0
        self.factor_seconds = 0.0

    @property
    def name(self) -> str:
        """The back end that factored last."""
        return self._name

    def factor(self, values: np.ndarray) -> int | None:
        """Factor the matrix; returns its number of negative eigenvalues, None if unknown.

        Raises Singular if no back end can.
        """
        start = time.perf_counter()
        self.factorisations += 1
        self._values = values
        try:
            return self._factor_with(self._names)
        finally:
            self.factor_seconds += time.perf_counter() - start

    def _factor_with(self, names: list[str]) -> int | None:
        """Factor with the first of `names` that can; one that does not load is not asked again."""
        if not np.all(np.isfinite(self._values)):
            raise Singular("the tangent is not finite")
        failure = Singular("no sparse solver is left")
        for name in list(names):
            try:
                self._name = name
                return self._back_ends[name].factor(self._values)
            except Singular as error:
                failure = error
            except (ImportError, OSError) as error:
                self._names = [other for other in self._names if other != name]
                failure = Singular(f"{name} does not load: {error}")
        raise failure

    @np.errstate(over="ignore", invalid="ignore")  # an error that overflows is too large, and refused
    def solve(self, b: np.ndarray) -> np.ndarray:
        """Solve K x = b for b (n, n_rhs), checked. Raises Singular if it is not accurate."""
        while True:
            back_end = self._back_ends[self._name]
            x = back_end.solve(b)
            for _ in range(2):
                error = b - self._times(x)
                if self._is_accurate(x, b, error):
                    return x
                x = x + back_end.solve(error)
            after = self._names[self._names.index(self._name) + 1 :]
            if not after:
                raise Singular("the linear system could not be solved accurately")
            self._factor_with(after)

    def _is_accurate(self, x: np.ndarray, b: np.ndarray, error: np.ndarray) -> bool:
        """True if each column's residual is small beside b, or no more than rounding."""
        left, size, found = (np.linalg.norm(columns, axis=0) for columns in (error, b, x))
        rounding = ROUNDING * np.max(np.abs(self._values)) * found
        return bool(
            np.all(left <= np.maximum(RELATIVE_RESIDUAL * size, np.minimum(rounding, LEAST_ACCURACY * size)))
        )

    def holds(self, values: np.ndarray) -> bool:
        """True if this very array was factored last."""
        return self._values is values

    def _times(self, x: np.ndarray) -> np.ndarray:
        n = self._pattern.n
        upper = sp.csr_matrix((self._values, self._pattern.indices, self._pattern.indptr), shape=(n, n))
        diagonal = self._values[self._pattern.indptr[:-1]]
        return upper @ x + upper.T @ x - diagonal[:, None] * x


MOST_SOLVERS = 2
"""solvers that a result keeps: for the tangent in the body, and for that at the stop"""


class Factors:
    """The factorisations of one result. Each belongs to a tangent and is asked for by it.

    A solver is in the hands of one thread at a time: it is taken out of the box, and put back with the
    tangent that it has factored. Results never share a solver.
    """

    def __init__(self, pattern: Pattern, choice: str = "auto", *solvers: LinearSolver) -> None:
        self._pattern, self._choice = pattern, choice
        self._box, self._lock = list(solvers), threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process, an empty box."""
        return Factors, (self._pattern, self._choice)

    def take(self, values: np.ndarray | None = None) -> LinearSolver:
        """A solver for good, out of the box or new: the one that has factored `values`, if there is one."""
        with self._lock:
            known = [solver for solver in self._box if values is not None and solver.holds(values)]
            # else the one that was put back first, once there are enough
            spare = self._box[:1] if values is None or len(self._box) >= MOST_SOLVERS else []
            for solver in (*known, *spare):
                self._box.remove(solver)
                return solver
        return LinearSolver(self._pattern, self._choice)

    @contextmanager
    def lease(self, values: np.ndarray) -> Iterator[LinearSolver]:
        """A solver with the factors of a tangent, for a while. Raises Singular."""
        solver = self.take(values)
        if not solver.holds(values):
            solver.factor(values)
        try:
            yield solver
        finally:
            with self._lock:
                self._box = [*self._box, solver][-MOST_SOLVERS:]

    def solve(self, values: np.ndarray, b: np.ndarray) -> np.ndarray:
        """K^-1 b for a tangent and right-hand sides b (n, n_rhs). Raises Singular."""
        with self.lease(values) as solver:
            return solver.solve(b)
