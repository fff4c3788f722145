"""How equilibrium is differentiated: the implicit function theorem at the converged states.

The unknowns u are the free positions of the physiological state, those at the stop, and the jaw's
height; pressures are eliminated. They solve, for a scene s,

    R_0(u_0, s) = d Pi/dx without contact = 0                  in the body
    R_1(u_1, h, s) = d Pi/dx = 0,  S(u_0, u_1, h, s) = 0       at the stop (bordered)

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
from jaxclamp.observe.measures import Measure, Seen
from jaxclamp.observe.stresses import PARTS_OF_A_JAW, Landmarks
from jaxclamp.potential.model import Discretisation, body_of, discretise
from jaxclamp.potential.tangent import Body, State, artery_forces, contact_forces, with_equilibrium_pressure
from jaxclamp.scenes.scene import OcclusionStop, Scene, Stop, TravelStop
from jaxclamp.sensitivity.worker import call_elsewhere
from jaxclamp.solve.clamping import clamp, inflate
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.newton import Equilibrium
from jaxclamp.solve.results import LinearSolvers, Result


@record
class Unknowns:
    """What the equilibrium equations determine; also the form of their residuals."""

    physiological: Array | None
    """free positions in the body, mm, (n_free,); None where they are held"""
    stop: Array | None
    """free positions at the stop, mm, (n_free,); None where nothing at the stop is asked for"""
    jaw_height: Array | None
    """at the stop, mm"""


def positions(scene: Scene, parts: Discretisation, free: Array) -> Array:
    """Positions of all nodes, mm, (n_nodes, 3): the free ones, the symmetry planes and the moved end."""
    n_nodes = parts.mesh.n_nodes
    end = 0.5 * scene.artery.length * scene.artery.axial_stretch
    held = jnp.zeros((n_nodes, 3)).at[parts.mesh.end_plane, 2].set(end)
    return held.ravel().at[parts.topology.free].set(free).reshape(n_nodes, 3)


def equations(scene: Scene, parts: Discretisation, u: Unknowns) -> Unknowns:
    """Residuals of equilibrium and of the stop, mN and mm (mN for a force stop)."""
    body, pressure, free = body_of(scene, parts), scene.artery.pressure, parts.topology.free
    assert u.physiological is not None
    x0 = positions(scene, parts, u.physiological)
    at_rest = artery_forces(body, x0, pressure).ravel()[free]
    if u.stop is None or u.jaw_height is None:
        return Unknowns(physiological=at_rest, stop=None, jaw_height=None)
    stopped = stop_equations(scene, parts, u)
    return dataclasses.replace(stopped, physiological=at_rest)


def stop_equations(scene: Scene, parts: Discretisation, u: Unknowns) -> Unknowns:
    """The same without the equilibrium in the body, which is held."""
    body, pressure, free = body_of(scene, parts), scene.artery.pressure, parts.topology.free
    assert u.stop is not None
    closed = artery_forces(body, positions(scene, parts, u.stop), pressure).ravel()[free]
    jaw = jaw_equations(scene, parts, u)
    assert jaw.stop is not None
    return dataclasses.replace(jaw, stop=closed + jaw.stop)


def closing_residual(
    stop: Stop, marks: Landmarks, x0: Array, x1: Array, jaw_height: Array, lift: Array
) -> Array:
    """Residual of the stop, mm (mN for a force stop); x0: in the body, lift: d Pi/d jaw_height, mN."""
    top, outer = marks.lumen_top, marks.outer_top
    if isinstance(stop, OcclusionStop):
        return x1[top, 1] - (1.0 - stop.occlusion) * x0[top, 1]
    if isinstance(stop, TravelStop):
        return jaw_height - (x0[outer, 1] - stop.travel)
    return -lift - stop.force / PARTS_OF_A_JAW


@jax.jit
def _jaw_equations(
    body: Body, stop: Stop, parts: Discretisation, x0: Array, x1: Array, jaw_height: Array
) -> tuple[Array, Array]:
    """Contact forces on the free positions, mN, (n_free,), and the residual of the stop."""
    touch, lift = contact_forces(body, x1, jaw_height)
    closing = closing_residual(stop, parts.marks, x0, x1, jaw_height, lift)
    return touch.ravel()[parts.topology.free], closing


def jaw_equations(scene: Scene, parts: Discretisation, u: Unknowns) -> Unknowns:
    """The part of `equations` in which jaw, contact and stop appear: the artery in the body is held."""
    assert u.physiological is not None
    assert u.stop is not None
    assert u.jaw_height is not None
    x0, x1 = positions(scene, parts, u.physiological), positions(scene, parts, u.stop)
    touch, closing = _jaw_equations(body_of(scene, parts), scene.stop, parts, x0, x1, u.jaw_height)
    return Unknowns(physiological=None, stop=touch, jaw_height=closing)


@jax.custom_jvp
def implicit(scene: Scene, parts: Discretisation, u: Unknowns, ticket: Array) -> Unknowns:
    """The solution u of the equations, as a function of the scene with its true derivatives.

    ticket: number of the `Solution` whose factors solve the linear systems, see `register`
    """
    return u


@partial(implicit.defjvp, symbolic_zeros=True)
def _implicit_jvp(primals: Any, tangents: Any) -> tuple[Unknowns, Unknowns]:
    scene, parts, u, ticket = primals
    u = implicit(scene, parts, u, ticket)  # for derivatives of higher order
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
        return (equations if body_moves else jaw_equations)(changed, parts, u)

    active_moves = [moves[i] for i in active]
    _, slope = jax.jvp(residual, ([leaves[i] for i in active],), (active_moves,))
    # the transpose of the linear solve asks for right-hand sides that all depend on the moves
    nothing = 0.0 * sum(jnp.sum(move) for move in active_moves)
    fixed = lax.stop_gradient(ticket)
    du = lax.custom_linear_solve(
        partial(_tangent, scene, parts, u),
        jax.tree_util.tree_map(lambda r: nothing - r, slope),
        solve=lambda _, b: _on_host(fixed, b, transposed=False),
        transpose_solve=lambda _, b: _on_host(fixed, b, transposed=True),
    )
    return u, du if body_moves else dataclasses.replace(du, physiological=still.physiological)


@jax.jit
def _tangent(scene: Scene, parts: Discretisation, u: Unknowns, v: Unknowns) -> Unknowns:
    """dR/du v; where the artery in the body is held, without its equations."""
    if v.physiological is not None:
        _, everywhere = jax.jvp(lambda w: equations(scene, parts, w), (u,), (v,))
        return everywhere
    held = lambda w: dataclasses.replace(w, physiological=u.physiological)  # noqa: E731
    start = dataclasses.replace(u, physiological=None)
    _, at_stop = jax.jvp(lambda w: stop_equations(scene, parts, held(w)), (start,), (v,))
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
    solvers: LinearSolvers
    tangents: tuple[np.ndarray, np.ndarray | None]
    """values of K_0 and K_1, mN/mm"""
    responses: np.ndarray
    """K_1^-1 times the coupling of positions and jaw height, (n_free,)"""
    coupling: np.ndarray
    """d2 Pi/dx d jaw_height at the stop, mN/mm, (n_free,)"""
    rows: tuple[np.ndarray, np.ndarray, float]
    """derivatives of the stop's equation by the positions in the body and at the stop, and by the height"""


def solution(result: Result, to_stop: bool) -> Solution:
    """The solution that a result holds. Raises its EquilibriumError if it did not reach the stop."""
    result.require(to_stop)
    free = np.asarray(result.model.discretisation.topology.free)
    assert result.physiological is not None
    base, last = result.physiological.equilibrium, result.states[-1].equilibrium
    at = lambda state: np.asarray(state.x).reshape(-1)[free]  # noqa: E731
    height: Any = np.asarray(last.state.jaw_height) if to_stop else None
    u = Unknowns(physiological=at(base.state), stop=at(last.state) if to_stop else None, jaw_height=height)
    return Solution(
        u=u,
        solvers=result.linear_solvers,
        tangents=(np.asarray(base.lin.values), np.asarray(last.lin.values) if to_stop else None),
        responses=-last.responses[:, 1],
        coupling=np.asarray(last.lin.jaw_coupling),
        rows=_closing_row(result, last, free),
    )


def _closing_row(result: Result, last: Equilibrium, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    stop, marks = result.scene.stop, result.model.marks
    unit = lambda node: (free == 3 * node + 1).astype(float)  # noqa: E731
    none = np.zeros(len(free))
    if isinstance(stop, OcclusionStop):
        return -(1.0 - float(stop.occlusion)) * unit(marks.lumen_top), unit(marks.lumen_top), 0.0
    if isinstance(stop, TravelStop):
        return -unit(marks.outer_top), none, 1.0
    return none, -np.asarray(last.lin.jaw_coupling), -float(last.lin.jaw_stiffness)


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
    n = len(known.coupling)
    columns = lambda a: np.asarray(a).reshape(-1, n).T  # noqa: E731  (n, n_rhs)
    solve_0 = lambda b: _solve_columns(known.solvers.holding(known.tangents[0]), b)  # noqa: E731
    held = b.physiological is None
    if b.stop is None:
        return Unknowns(
            physiological=_rows(solve_0(columns(b.physiological)), b.physiological),
            stop=None,
            jaw_height=None,
        )
    assert b.jaw_height is not None
    solve_1 = lambda b: _solve_columns(known.solvers.stop, b, known.tangents[1])  # noqa: E731
    b1, bh = columns(b.stop), np.asarray(b.jaw_height).reshape(-1)
    b0 = np.zeros((n, bh.size)) if held else columns(b.physiological)
    by_body, by_stop, by_jaw = known.rows
    if transposed:
        both = solve_1(np.column_stack([b1, by_stop]))
        y, y_stop = both[:, :-1], both[:, -1]
        zh = (bh - known.responses @ b1) / (by_jaw - known.coupling @ y_stop)
        z1 = y - np.outer(y_stop, zh)
        z0 = b0 if held else solve_0(b0 - np.outer(by_body, zh))
    else:
        z0, y = solve_0(b0), solve_1(b1)
        zh = (bh - by_body @ z0 - by_stop @ y) / (by_jaw - by_stop @ known.responses)
        z1 = y - np.outer(known.responses, zh)
    height: Any = zh.reshape(np.shape(b.jaw_height))
    base = None if held else _rows(z0, b.physiological)
    return Unknowns(physiological=base, stop=_rows(z1, b.stop), jaw_height=height)


def _solve_columns(solver: LinearSolver, b: np.ndarray, values: Any = None) -> np.ndarray:
    """K^-1 b for b (n, n_rhs), with the factors at hand or those of `values`; zero columns cost nothing."""
    x = np.zeros_like(b)
    wanted = np.any(b != 0.0, axis=0)
    if np.any(wanted):
        columns = np.ascontiguousarray(b[:, wanted])
        x[:, wanted] = solver.solve(columns) if values is None else solver.solve_for(values, columns)
    return x


def _rows(columns: np.ndarray, like: Any) -> Any:
    return np.ascontiguousarray(columns.T).reshape(np.shape(like))


# --- measures of a scene ---------------------------------------------------------------------------


def see(scene: Scene, parts: Discretisation, u: Unknowns) -> Seen:
    """The body with its states, as a JAX function of scene and unknowns."""
    body = body_of(scene, parts)

    def state(free: Array | None, jaw_height: Array) -> State:
        assert free is not None
        return with_equilibrium_pressure(body, positions(scene, parts, free), jaw_height)

    return Seen(
        body=body,
        marks=parts.marks,
        physiological=state(u.physiological, jnp.zeros(())),
        stop=None if u.stop is None or u.jaw_height is None else state(u.stop, u.jaw_height),
    )


_read = jax.jit(lambda measure, seen: measure(seen), static_argnums=0)


def measured(measure: Measure, scene: Scene, parts: Discretisation, u: Unknowns, ticket: Any) -> Array:
    """The measure at a known solution of a scene, differentiable in the scene.

    Several programs rather than one: they compile faster, and measures share all but their own.
    """
    value: Array = _read(measure, see(scene, parts, implicit(scene, parts, u, ticket)))
    return value


def evaluate(scene: Scene, measure: Measure, *, guess: Result | None = None) -> Array:
    """The value of a measure for a scene, in internal units: a JAX function of every float in it.

    `grad`, `value_and_grad`, `jvp`, `jacfwd`, `jacrev`, Hessian-vector products and `jit` work.
    guess: the result of a neighbouring scene to start from (not under `jit`)

    Raises EquilibriumError if the scene has no converged state (under `jit`, JAX reports it as a
    JaxRuntimeError with the same sentence); there is no value and no derivative then.
    """
    fixed = lax.stop_gradient(jax.tree_util.tree_map(jnp.asarray, scene))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(fixed)):
        parts, _ = discretise(scene)
        u, ticket = _solve_in_worker(fixed, parts, measure.needs_stop)
    else:
        result = solve(jax.tree_util.tree_map(np.asarray, fixed), measure.needs_stop, guess)
        parts = result.model.discretisation
        known = solution(result, measure.needs_stop)
        u, ticket = known.u, register(known)
    return measured(measure, scene, parts, u, ticket)


def solve(scene: Scene, to_stop: bool, guess: Result | None = None) -> Result:
    """The equilibria of a scene, as far as they are needed."""
    return (clamp if to_stop else inflate)(scene, guess=guess)


def _solve_in_worker(scene: Scene, parts: Discretisation, to_stop: bool) -> tuple[Unknowns, Any]:
    """The solution of an abstract scene, by a callback to another process."""
    many: Any = jax.ShapeDtypeStruct(parts.topology.free.shape, jnp.float64)
    one: Any = jax.ShapeDtypeStruct((), jnp.float64)
    u = Unknowns(physiological=many, stop=many if to_stop else None, jaw_height=one if to_stop else None)

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
