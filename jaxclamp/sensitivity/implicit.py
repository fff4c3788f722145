"""How equilibrium is differentiated: the implicit function theorem at the converged states.

The unknowns u are the free positions of the physiological state, those at the stop, and the rigid
coordinates q; pressures are eliminated. They solve, for a scene s,

    R_0(u_0, s) = d Pi/dx without contact = 0                  in the body
    R_1(u_1, q, s) = d Pi/dx = 0,  S(u_0, u_1, q, s) = 0       at the stop (bordered)

so that du = -(dR/du)^-1 dR/ds ds. `implicit` is the identity on u with exactly this derivative,
as a JAX function of any order: its linear solve runs on the host with the factors that the
clamping left behind, forward or transposed. No iteration is ever differentiated.

The solve itself never runs inside a compiled program: with a concrete scene it runs before it,
with an abstract one (under `jit` or `vmap`) in a process of its own, because JAX must not be
called from its own callbacks.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import OrderedDict
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jaxclamp.core.records import record
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measure import Measure, require_measure
from jaxclamp.potential.energy import State, energy, settled
from jaxclamp.potential.model import Discretisation, bare, discretise, positions, potential_of
from jaxclamp.potential.terms import Potential
from jaxclamp.scenes.files import require_scene
from jaxclamp.scenes.scene import Scene, Stop
from jaxclamp.sensitivity.worker import call_elsewhere
from jaxclamp.solve.clamping import clamp, inflate
from jaxclamp.solve.linear_solvers import Factors
from jaxclamp.solve.results import Result
from jaxclamp.solve.stops import stop_residual, stop_row


@record
class Unknowns:
    """What the equilibrium equations determine; also the form of their residuals."""

    physiological: Array | None
    """free positions in the body, mm, (n_free,); None where they are held"""
    stop: Array | None
    """free positions at the stop, mm, (n_free,); None where nothing at the stop is asked for"""
    q: Array | None
    """rigid coordinates at the stop, mm, (n_q,)"""


@jax.jit
def artery_forces(potential: Potential, x: Array) -> Array:
    """d Pi/dx of wall and blood on the unknowns, mN, (n_free,): what `linearise` gives without the
    tangent, in one program that is cheap to differentiate."""
    slope = jax.grad(energy, argnums=1)(potential.artery, x, jnp.zeros(0))
    return slope.ravel()[potential.layout.free]


@jax.jit
def contact_forces(potential: Potential, x: Array, q: Array) -> tuple[Array, Array]:
    """d Pi/dx of all contact on the unknowns, mN, (n_free,), and d Pi/dq, mN, (n_q,)."""
    by_x, by_q = jax.grad(energy, argnums=(1, 2))(potential.clamp, x, q)
    return by_x.ravel()[potential.layout.free], by_q


def equations(scene: Scene, d: Discretisation, u: Unknowns) -> Unknowns:
    """Residuals of equilibrium and of the stop, mN and the stop's unit."""
    assert u.physiological is not None
    at_rest = artery_forces(potential_of(scene, d), positions(scene, d, u.physiological))
    if u.stop is None or u.q is None:
        return Unknowns(physiological=at_rest, stop=None, q=None)
    return dataclasses.replace(stop_equations(scene, d, u), physiological=at_rest)


def stop_equations(scene: Scene, d: Discretisation, u: Unknowns) -> Unknowns:
    """The same without the equilibrium in the body, which is held."""
    assert u.stop is not None
    closed = artery_forces(potential_of(scene, d), positions(scene, d, u.stop))
    jaw = jaw_equations(scene, d, u)
    assert jaw.stop is not None
    return dataclasses.replace(jaw, stop=closed + jaw.stop)


@jax.jit
def _jaw_equations(
    potential: Potential, stop: Stop, d: Discretisation, x0: Array, x1: Array, q: Array
) -> tuple[Array, Array]:
    """Contact forces on the unknowns, mN, (n_free,), and the residuals of q: of the stop, then of the
    rigid coordinates that find their own equilibrium, (n_q,)."""
    touch, by_q = contact_forces(potential, x1, q)
    states = (settled(potential, x0, q), settled(potential, x1, q))
    closing = stop_residual(stop, d.marks, potential, states)
    return touch, by_q.at[0].set(closing)


def jaw_equations(scene: Scene, d: Discretisation, u: Unknowns) -> Unknowns:
    """The part of `equations` in which jaw, contact and stop appear: the artery in the body is held."""
    assert u.physiological is not None
    assert u.stop is not None
    assert u.q is not None
    x0, x1 = positions(scene, d, u.physiological), positions(scene, d, u.stop)
    touch, closing = _jaw_equations(potential_of(scene, d), scene.stop, d, x0, x1, u.q)
    return Unknowns(physiological=None, stop=touch, q=closing)


@jax.custom_jvp
def implicit(scene: Scene, d: Discretisation, u: Unknowns, ticket: Array) -> Unknowns:
    """The solution u of the equations, as a function of the scene with its true derivatives.

    ticket: number of the `Solution` whose factors solve the linear systems, see `register`
    """
    return u


@partial(implicit.defjvp, symbolic_zeros=True)
def _implicit_jvp(primals: Any, tangents: Any) -> tuple[Unknowns, Unknowns]:
    scene, d, u, ticket = primals
    u = implicit(scene, d, u, ticket)  # for derivatives of higher order
    is_still = lambda t: isinstance(t, SymbolicZero)  # noqa: E731
    all_still = lambda tree: all(map(is_still, jax.tree_util.tree_leaves(tree, is_leaf=is_still)))  # noqa: E731
    moves, tree = jax.tree_util.tree_flatten(tangents[0], is_leaf=is_still)
    leaves = jax.tree_util.tree_leaves(scene)
    active = [i for i, move in enumerate(moves) if not is_still(move)]
    still = jax.tree_util.tree_map(jnp.zeros_like, u)
    body_moves = not all_still((tangents[0].artery, tangents[0].mesh))
    if not active or (u.stop is None and not body_moves):
        return u, still

    def residual(values: list[Array]) -> Unknowns:
        others: list[Any] = list(leaves)
        for i, value in zip(active, values, strict=True):
            others[i] = value
        changed = jax.tree_util.tree_unflatten(tree, others)
        return (equations if body_moves else jaw_equations)(changed, d, u)

    active_moves = [moves[i] for i in active]
    _, slope = jax.jvp(residual, ([leaves[i] for i in active],), (active_moves,))
    # the transpose of the linear solve asks for right-hand sides that all depend on the moves
    nothing = 0.0 * sum(jnp.sum(move) for move in active_moves)
    fixed = lax.stop_gradient(ticket)
    du = lax.custom_linear_solve(
        partial(_tangent, scene, d, u),
        jax.tree_util.tree_map(lambda r: nothing - r, slope),
        solve=lambda _, b: _on_host(fixed, b, transposed=False),
        transpose_solve=lambda _, b: _on_host(fixed, b, transposed=True),
    )
    return u, du if body_moves else dataclasses.replace(du, physiological=still.physiological)


@jax.jit
def _tangent(scene: Scene, d: Discretisation, u: Unknowns, v: Unknowns) -> Unknowns:
    """dR/du v; where the artery in the body is held, without its equations."""
    if v.physiological is not None:
        _, everywhere = jax.jvp(lambda w: equations(scene, d, w), (u,), (v,))
        return everywhere
    held = lambda w: dataclasses.replace(w, physiological=u.physiological)  # noqa: E731
    start = dataclasses.replace(u, physiological=None)
    _, at_stop = jax.jvp(lambda w: stop_equations(scene, d, held(w)), (start,), (v,))
    return at_stop


def _on_host(ticket: Array, b: Unknowns, transposed: bool) -> Unknowns:
    """Solve with the factors of a registered result."""
    shapes = jax.tree_util.tree_map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), b)
    call = partial(_solve, transposed=transposed)
    return jax.pure_callback(call, shapes, ticket, b, vmap_method="broadcast_all")


# --- on the host: numbers only, no JAX ------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Solution:
    """A solution of the equations and what its linear systems are made of; NumPy throughout."""

    u: Unknowns
    """the unknowns"""
    factors: Factors
    """of its tangents"""
    tangents: tuple[np.ndarray, np.ndarray | None]
    """values of K_0 and K_1, mN/mm"""
    responses: np.ndarray
    """K_1^-1 times the coupling of positions and rigid coordinates, (n_free, n_q)"""
    coupling: np.ndarray
    """d2 Pi/dx dq at the stop, mN/mm, (n_free, n_q)"""
    rows: tuple[np.ndarray, np.ndarray, np.ndarray]
    """derivatives of the equations of q by the positions in the body and at the stop, (n_q, n_free) each,
    and by q, (n_q, n_q)"""


def solution(result: Result, to_stop: bool) -> Solution:
    """The solution that a result holds. Raises its EquilibriumError if it did not reach the stop."""
    result.require(to_stop)
    free = np.asarray(result.model.discretisation.layout.free)
    assert result.physiological is not None
    base, last = result.physiological.equilibrium, result.states[-1].equilibrium
    at = lambda state: np.asarray(state.x).reshape(-1)[free]  # noqa: E731
    q: Any = np.asarray(last.state.q) if to_stop else None
    u = Unknowns(physiological=at(base.state), stop=at(last.state) if to_stop else None, q=q)
    coupling = np.asarray(last.lin.coupling)
    n_q, n = coupling.shape[::-1]
    return Solution(
        u=u,
        factors=result.factors,
        tangents=(np.asarray(base.lin.values), np.asarray(last.lin.values) if to_stop else None),
        responses=-last.responses[:, 1:],
        coupling=coupling,
        rows=_rows_of_q(result) if to_stop else (np.zeros((n_q, n)), np.zeros((n_q, n)), np.eye(n_q)),
    )


def _rows_of_q(result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The stop's row, and below it those of the rigid coordinates that find their own equilibrium."""
    e, lin, stop = result.equilibria, result.states[-1].equilibrium.lin, result.scene.stop
    by_body, (_, by_stop, by_q) = jax.device_get((_by_body(stop, e), stop_row(stop, e)))
    others = np.asarray(lin.coupling).T[1:]
    return (
        np.vstack([by_body, np.zeros_like(others)]),
        np.vstack([by_stop, others]),
        np.vstack([by_q, np.asarray(lin.rigid_stiffness)[1:]]),
    )


@jax.jit
def _by_body(stop: Stop, e: Equilibria) -> Array:
    """Derivative of a stop's measure by the unknowns in the body, (n_free,)."""

    def of(x: Array) -> Array:
        return stop.measure(dataclasses.replace(e, states=(settled(e.potential, x, e.body.q), e.last)))

    return jax.grad(of)(e.body.x).ravel()[e.potential.layout.free]


_solutions: OrderedDict[int, Solution] = OrderedDict()
_numbers = itertools.count(1)
MOST_SOLUTIONS = 4
"""solutions whose factors are kept for derivatives"""


def register(known: Solution) -> np.ndarray:
    """Keep a solution for the linear solves of its derivatives; returns its ticket."""
    ticket = next(_numbers)
    _solutions[ticket] = known
    while len(_solutions) > MOST_SOLUTIONS:
        _solutions.popitem(last=False)
    return np.asarray(float(ticket))


def _solve(ticket: Any, b: Unknowns, *, transposed: bool) -> Unknowns:
    """The linear system of a registered solution."""
    known = _solutions.get(int(np.asarray(ticket).ravel()[0]))
    if known is None:
        raise RuntimeError("this equilibrium is no longer kept: differentiate fewer scenes at a time")
    return solve_linear(known, b, transposed=transposed)


def solve_linear(known: Solution, b: Unknowns, *, transposed: bool) -> Unknowns:
    """Solve A z = b or A' z = b, A = dR/du, for right-hand sides with any batch axes in front."""
    n, n_q = known.coupling.shape
    columns = lambda a, size=n: np.asarray(a).reshape(-1, size).T  # noqa: E731  (size, n_rhs)
    solve_0 = lambda b: _solve_columns(known.factors, known.tangents[0], b)  # noqa: E731
    held = b.physiological is None
    if b.stop is None:
        x0 = _rows(solve_0(columns(b.physiological)), b.physiological)
        return Unknowns(physiological=x0, stop=None, q=None)
    solve_1 = lambda b: _solve_columns(known.factors, known.tangents[1], b)  # noqa: E731
    b1, bq = columns(b.stop), columns(b.q, n_q)
    b0 = np.zeros((n, bq.shape[1])) if held else columns(b.physiological)
    by_body, by_stop, by_q = known.rows
    if transposed:
        both = solve_1(np.column_stack([b1, by_stop.T]))
        y, y_stop = both[:, :-n_q], both[:, -n_q:]
        zq = np.linalg.solve(by_q.T - known.coupling.T @ y_stop, bq - known.responses.T @ b1)
        z1 = y - y_stop @ zq
        z0 = b0 if held else solve_0(b0 - by_body.T @ zq)
    else:
        z0, y = solve_0(b0), solve_1(b1)
        zq = np.linalg.solve(by_q - by_stop @ known.responses, bq - by_body @ z0 - by_stop @ y)
        z1 = y - known.responses @ zq
    base = None if held else _rows(z0, b.physiological)
    return Unknowns(physiological=base, stop=_rows(z1, b.stop), q=_rows(zq, b.q))


def _solve_columns(factors: Factors, values: Any, b: np.ndarray) -> np.ndarray:
    """K^-1 b for the tangent `values` and b (n, n_rhs); zero columns cost nothing."""
    x = np.zeros_like(b)
    wanted = np.any(b != 0.0, axis=0)
    if np.any(wanted):
        x[:, wanted] = factors.solve(values, np.ascontiguousarray(b[:, wanted]))
    return x


def _rows(columns: np.ndarray, like: Any) -> Any:
    return np.ascontiguousarray(columns.T).reshape(np.shape(like))


# --- measures of a scene ---------------------------------------------------------------------------


def see(scene: Scene, d: Discretisation, u: Unknowns) -> Equilibria:
    """The scene with its states, as a JAX function of scene and unknowns."""
    potential = potential_of(scene, d)

    def state(free: Array | None, q: Array) -> State:
        assert free is not None
        return settled(potential, positions(scene, d, free), q)

    in_body = state(u.physiological, jnp.zeros(d.layout.n_rigid))
    closed = () if u.stop is None or u.q is None else (state(u.stop, u.q),)
    return Equilibria(potential=potential, marks=d.marks, states=(in_body, *closed), injury=scene.injury)


_read = jax.jit(lambda measure, equilibria: measure(equilibria), static_argnums=0)


def measured(measure: Measure, scene: Scene, d: Discretisation, u: Unknowns, ticket: Any) -> Array:
    """The measure at a known solution of a scene, differentiable in the scene.

    Several programs rather than one: they compile faster, and measures share all but their own.
    """
    scene = bare(scene)
    value: Array = _read(measure, see(scene, d, implicit(scene, d, u, ticket)))
    return value


def evaluate(scene: Scene, measure: Measure, *, guess: Result | None = None) -> Array:
    """The value of a measure for a scene, in internal units: a JAX function of every float in it.

    `grad`, `value_and_grad`, `jvp`, `jacfwd`, `jacrev`, Hessian-vector products and `jit` work.
    guess: the result of a neighbouring scene to start from (not under `jit`)

    Raises EquilibriumError if the scene has no converged state (under `jit`, JAX reports it as a
    JaxRuntimeError with the same sentence); there is no value and no derivative then.
    """
    require_measure(measure)
    require_scene(scene)
    fixed = lax.stop_gradient(jax.tree_util.tree_map(jnp.asarray, scene))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(fixed)):
        d, _ = discretise(scene)
        u, ticket = _solve_in_worker(fixed, d, measure.needs_stop)
    else:
        result = solve(jax.tree_util.tree_map(np.asarray, fixed), measure.needs_stop, guess)
        d = result.model.discretisation
        known = solution(result, measure.needs_stop)
        u, ticket = known.u, register(known)
    return measured(measure, scene, d, u, ticket)


def solve(scene: Scene, to_stop: bool, guess: Result | None = None) -> Result:
    """The equilibria of a scene, as far as they are needed."""
    return (clamp if to_stop else inflate)(scene, guess=guess)


def _solve_in_worker(scene: Scene, d: Discretisation, to_stop: bool) -> tuple[Unknowns, Any]:
    """The solution of an abstract scene, by a callback to another process."""
    many: Any = jax.ShapeDtypeStruct(d.layout.free.shape, jnp.float64)
    one: Any = jax.ShapeDtypeStruct((), jnp.float64)
    few: Any = jax.ShapeDtypeStruct((d.layout.n_rigid,), jnp.float64)
    u = Unknowns(physiological=many, stop=many if to_stop else None, q=few if to_stop else None)

    def call(leaves: Scene) -> tuple[Unknowns, np.ndarray]:
        known = call_elsewhere(_solution_of, jax.tree_util.tree_map(np.asarray, leaves), to_stop)
        return known.u, register(known)

    return jax.pure_callback(call, (u, one), scene, vmap_method="sequential")


_last: Result | None = None


def _solution_of(scene: Scene, to_stop: bool) -> Solution:
    """Solve a scene in the worker, from the one before if that is near."""
    global _last
    _last = solve(scene, to_stop, _last)
    return solution(_last, to_stop)
