"""Sparse direct back ends against dense algebra, what they refuse, and the way from one to the next."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.sparse as sp

from jaxclamp.core.failures import Singular
from jaxclamp.fem.pattern import Pattern
from jaxclamp.solve import linear_solvers
from jaxclamp.solve.linear_solvers import BACK_ENDS, LinearSolver, available, full_matrix

BACK_END_NAMES = available()
TELL_INERTIA = {"pardiso", "rslab"}


def indefinite(n: int, negative_share: float, seed: int) -> tuple[Pattern, np.ndarray, np.ndarray]:
    """A random sparse symmetric matrix: pattern, upper values, dense. Its spectrum has both signs."""
    rng = np.random.default_rng(seed)
    coupling = sp.random(n, n, density=5.0 / n, random_state=rng, data_rvs=lambda k: rng.normal(size=k))
    signs = np.where(rng.random(n) < negative_share, -1.0, 1.0)
    dense = np.asarray((coupling + coupling.T).todense()) * 0.4 + np.diag(signs * rng.uniform(1.0, 6.0, n))
    upper = sp.csr_matrix(np.triu(dense))
    upper.sort_indices()
    return Pattern(upper.indptr, upper.indices), upper.data.copy(), dense


@pytest.fixture(params=BACK_END_NAMES)
def name(request):
    return request.param


def test_a_fallback_is_always_there():
    assert BACK_END_NAMES[-1] == "splu"
    assert set(BACK_END_NAMES) <= set(BACK_ENDS)


@pytest.mark.parametrize("seed", range(3))
def test_solution_and_inertia(name, seed):
    pattern, values, dense = indefinite(200, 0.3, seed)
    solver = LinearSolver(pattern, name)
    negative = solver.factor(values)
    b = np.random.default_rng(seed + 10).normal(size=(200, 2))
    x = solver.solve(b)
    assert solver.name == name
    np.testing.assert_allclose(x, np.linalg.solve(dense, b), rtol=0.0, atol=1e-9 * np.max(np.abs(x)))
    if name in TELL_INERTIA:
        expected = int(np.sum(np.linalg.eigvalsh(dense) < 0.0))
        assert 0 < expected < 200
        assert negative == expected
    else:
        assert negative is None


def test_new_values_on_the_same_pattern(name):
    """The second factorisation reuses the analysis of the first and must not reuse its numbers."""
    pattern, values, dense = indefinite(150, 0.0, 4)
    solver = LinearSolver(pattern, name)
    solver.factor(values)
    b = np.ones((150, 1))
    first = solver.solve(b)
    shift = np.zeros_like(values)
    shift[pattern.indptr[:-1]] = 10.0
    solver.factor(values + shift)
    second = solver.solve(b)
    np.testing.assert_allclose(first, np.linalg.solve(dense, b), rtol=1e-8)
    np.testing.assert_allclose(second, np.linalg.solve(dense + 10.0 * np.eye(150), b), rtol=1e-8)
    assert solver.factorisations == 2


def test_full_matrix_has_both_triangles():
    pattern, values, dense = indefinite(40, 0.5, 5)
    np.testing.assert_array_equal(full_matrix(pattern, values).toarray(), dense)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_is_refused(name, bad):
    pattern, values, _ = indefinite(60, 0.3, 6)
    values[7] = bad
    with pytest.raises(Singular):
        LinearSolver(pattern, name).factor(values)


def test_a_singular_matrix_is_refused(name):
    """A graph's Laplacian has the constant vector in its null space; b is outside its range."""
    n = 80
    diagonal, beside = 2.0 * np.ones(n), -np.ones(n - 1)
    diagonal[[0, -1]] = 1.0
    upper = sp.diags([diagonal, beside], [0, 1]).tocsr()
    solver = LinearSolver(Pattern(upper.indptr, upper.indices), name)

    def solve() -> None:
        solver.factor(upper.data)
        solver.solve(np.ones((n, 1)))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        with pytest.raises(Singular):
            solve()


def test_a_soft_direction_is_answered_as_well_as_float64_can(name):
    """An eigenvalue of 1e-5 beside others up to 1e6: rounding alone leaves more than 1e-8 of b."""
    n, rng = 60, np.random.default_rng(3)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    dense = Q @ np.diag([1e-5, *np.geomspace(1.0, 1e6, n - 1)]) @ Q.T
    dense = 0.5 * (dense + dense.T)
    upper = sp.csr_matrix(np.triu(dense))
    upper.sort_indices()
    solver = LinearSolver(Pattern(upper.indptr, upper.indices), name)
    solver.factor(upper.data)
    b = 1e-5 * Q[:, :1]
    x = solver.solve(b)
    left = np.linalg.norm(dense @ x - b) / np.linalg.norm(b)
    assert left < 1e-4
    np.testing.assert_allclose(x, Q[:, :1], atol=1e-3)
    assert solver.name == name


@pytest.mark.skipif(len(BACK_END_NAMES) < 2, reason="needs two back ends")
def test_a_back_end_that_solves_wrongly_hands_over(monkeypatch):
    pattern, values, dense = indefinite(100, 0.2, 7)
    first = BACK_ENDS[BACK_END_NAMES[0]][0]
    monkeypatch.setattr(first, "solve", lambda self, b: np.zeros_like(b))
    solver = LinearSolver(pattern)
    solver.factor(values)
    b = np.ones((100, 1))
    np.testing.assert_allclose(solver.solve(b), np.linalg.solve(dense, b), rtol=1e-8)
    assert solver.name == BACK_END_NAMES[1]


@pytest.mark.skipif(len(BACK_END_NAMES) < 2, reason="needs two back ends")
@pytest.mark.parametrize("size", [1e200, 1e308, np.inf, np.nan])
def test_a_solution_that_overflows_hands_over_silently(monkeypatch, size):
    """A tangent that is all but singular: what a back end makes of it may be beyond any float."""
    pattern, values, dense = indefinite(60, 0.0, 7)
    first = BACK_ENDS[available()[0]][0]
    monkeypatch.setattr(first, "solve", lambda self, b: np.full_like(b, size))
    solver = LinearSolver(pattern)
    solver.factor(values)
    b = np.ones((60, 1))
    if len(available()) == 1:
        with pytest.raises(Singular):
            solver.solve(b)
    else:
        np.testing.assert_allclose(solver.solve(b), np.linalg.solve(dense, b), rtol=1e-8)


def test_a_back_end_that_cannot_factor_hands_over(monkeypatch):
    pattern, values, dense = indefinite(100, 0.2, 8)
    first = BACK_ENDS[BACK_END_NAMES[0]][0]

    def refuse(self, values):
        raise Singular("out of memory")

    monkeypatch.setattr(first, "factor", refuse)
    solver = LinearSolver(pattern)
    solver.factor(values)
    b = np.ones((100, 1))
    np.testing.assert_allclose(solver.solve(b), np.linalg.solve(dense, b), rtol=1e-8)
    assert solver.name == BACK_END_NAMES[1]


def test_without_optional_back_ends_superlu_works(monkeypatch):
    monkeypatch.setattr(linear_solvers, "available", lambda unknowns: ["splu"])
    pattern, values, dense = indefinite(100, 0.2, 9)
    solver = LinearSolver(pattern)
    solver.factor(values)
    b = np.ones((100, 1))
    np.testing.assert_allclose(solver.solve(b), np.linalg.solve(dense, b), rtol=1e-8)
    assert solver.name == "splu"


@pytest.mark.skipif("rslab" not in BACK_END_NAMES, reason="rslab is not installed")
def test_rslab_is_given_a_number_of_threads(monkeypatch):
    """Left to itself it may take every core of the machine; None is not a number."""
    import rslab

    given = []
    analyze = rslab.analyze

    def spy(*arguments, **options):
        given.append(options.get("threads"))
        return analyze(*arguments, **options)

    monkeypatch.setattr(rslab, "analyze", spy)
    pattern, values, _ = indefinite(50, 0.2, 10)
    LinearSolver(pattern, "rslab").factor(values)
    assert len(given) == 1
    assert type(given[0]) is int
    assert given[0] >= 1


def test_threads_are_used_for_large_systems(monkeypatch):
    """Only where there is a second core; the choice stays among what is installed."""
    monkeypatch.setattr(linear_solvers, "cores", lambda: 2)
    few, many = available(linear_solvers.MANY_UNKNOWNS - 1), available(linear_solvers.MANY_UNKNOWNS)
    assert few == available()
    assert sorted(many) == sorted(few)
    assert many[0] == ("rslab" if "rslab" in few else few[0])
    monkeypatch.setattr(linear_solvers, "cores", lambda: 1)
    assert available(linear_solvers.MANY_UNKNOWNS) == few
