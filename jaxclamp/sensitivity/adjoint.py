"""The gradient of a measure by every float of the scene, at a result at hand.

With the equations R(u, s) = 0 of `sensitivity`, a measure m(u, s) and the adjoint y = (dR/du)^-T dm/du,

    dm/ds = @m/@s - @/@s (y . R(u, s)),

and y . R is the change of the potential along y: a scalar, whose derivative is as cheap as a force. It is
taken in a few programs that hold for every measure on one kind of scene, through the body's geometry and
parameters, which the scene is asked for last. `sensitivity.evaluate` gives the same in JAX's own terms, and
what goes beyond a gradient.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxclamp.core.records import record
from jaxclamp.fem.landmarks import Landmarks
from jaxclamp.fem.pattern import Layout
from jaxclamp.observe.equilibria import Equilibria
from jaxclamp.observe.measure import Measure, require_measure
from jaxclamp.potential.energy import State, energy, settled
from jaxclamp.potential.model import Discretisation, bare, positions, potential_of
from jaxclamp.potential.tangent import Piece, cut, is_of_cells, piece_energy, whole
from jaxclamp.potential.terms import Group, Potential
from jaxclamp.scenes.scene import InjuryThreshold, Scene, Stop
from jaxclamp.sensitivity.implicit import Unknowns, contact_forces, solution, solve_linear
from jaxclamp.solve.results import Result
from jaxclamp.solve.stops import stop_residual


@record
class Sizes:
    """What the potential and the measures know of a scene; also the form of derivatives by it."""

    data: Any
    """the floats of the terms, see `Potential.data`"""
    stop: Stop
    """with its target"""
    x_body: Array
    """positions in the body, mm, (n_nodes, 3)"""
    x_stop: Array
    """positions at the stop, mm, (n_nodes, 3); in a measure of the body alone, those in the body"""
    q: Array
    """rigid coordinates at the stop, mm, (n_q,)"""
    injury: tuple[InjuryThreshold, ...]
    """the user's thresholds"""


def value_and_gradient(result: Result, measure: Measure) -> tuple[float, Scene]:
    """Value of a measure and its derivative by every float of the scene, at a result at hand.

    The gradient is a scene, per internal unit (mm, kPa, mN, radians). One adjoint solve with the factors
    that the clamping left behind.

    Raises EquilibriumError if the stop was not reached, ValueError if it was not asked for.
    """
    to_stop = require_measure(measure).needs_stop
    known = solution(result, to_stop)
    model = result.model
    d, potential = model.discretisation, model.potential
    free = np.asarray(d.layout.free)
    assert result.physiological is not None
    base, last = result.physiological.state, result.states[-1].state
    scene = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, float), bare(result.scene))
    x_stop = last.x if to_stop else base.x
    at = Sizes(
        data=potential.data,
        stop=scene.stop,
        x_body=base.x,
        x_stop=x_stop,
        q=last.q,
        injury=scene.injury,
    )
    value, slopes = _measured(measure, potential, d.marks, at)
    on_free = lambda a: np.asarray(a).reshape(-1)[free]  # noqa: E731
    by_q: Any = np.asarray(slopes.q)
    y = solve_linear(
        known,
        Unknowns(
            physiological=on_free(slopes.x_body),
            stop=on_free(slopes.x_stop) if to_stop else None,
            q=by_q if to_stop else None,
        ),
        transposed=True,
    )
    y_body = _on_nodes(d.layout, y.physiological)
    work = [_wall_work(potential, base, y_body)]
    y_stop, y_q = None, at.q
    if to_stop:
        y_stop, y_q = _on_nodes(d.layout, y.stop), jnp.asarray(y.q)
        work.append(_wall_work(potential, last, y_stop))
    touch = _surface_work(potential, d.marks, at, y_body, y_stop, y_q)
    return float(value), _named(_by_scene(d, scene, slopes, touch, work), result.scene)


@partial(jax.jit, static_argnums=0)
def _measured(measure: Measure, potential: Potential, marks: Landmarks, at: Sizes) -> tuple[Array, Sizes]:
    """The measure and its derivatives."""

    def of(sizes: Sizes) -> Array:
        same = potential.with_data(sizes.data)
        in_body = settled(same, sizes.x_body, jnp.zeros_like(sizes.q))
        closed = (settled(same, sizes.x_stop, sizes.q),) if measure.needs_stop else ()
        return measure(
            Equilibria(potential=same, marks=marks, states=(in_body, *closed), injury=sizes.injury)
        )

    return jax.value_and_grad(of)(at)


def _on_nodes(layout: Layout, v: Any) -> Any:
    """Unknowns (n_free,) as a field (n_nodes, 3), zero where nodes are held, on the host."""
    field = np.zeros(3 * layout.n_nodes)
    field[np.asarray(layout.free)] = v
    return field.reshape(-1, 3)


Wall = tuple[Array, tuple[Any, ...], Array]
"""what a layer of the wall, or a piece of it, knows of a scene: positions of its nodes, its points, M^-1"""


def _of_piece(cells: Piece) -> Wall:
    assert cells.pressures is not None
    return cells.x, cells.heres, cells.pressures.stiffness


def _wall_work(potential: Potential, state: State, y: Array) -> list[Wall]:
    """Derivatives of the wall's forces at a state times y, (n_nodes, 3), by layer."""
    return [_layer_work(group, state, dataclasses.replace(state, x=y)) for group in potential.layers]


def _layer_work(group: Group, state: State, moves: State) -> Wall:
    """The same for a layer: what belongs to its cells side by side, what they share summed."""
    n, size, parts = group.nodes.shape[1], group.size, []
    for i, (cells, move) in enumerate(zip(cut(group, state), cut(group, moves), strict=True)):
        there = np.arange(i * size, (i + 1) * size) < n  # and not there to fill up a block
        parts.append(_piece_work(cells, move.x * there))

    def together(known: Any, *found: Any) -> Any:
        return np.concatenate(found, axis=-1)[..., :n] if is_of_cells(known, n) else sum(found)

    uncut = _of_piece(whole(*jax.tree_util.tree_map(np.asarray, (group, state))))
    return jax.tree_util.tree_map(together, uncut, *jax.device_get(parts))


@jax.jit
def _piece_work(cells: Piece, y: Array) -> Wall:
    """Derivatives of a piece's forces times y; one program for all pieces of one size and law."""

    slopes = jax.grad(lambda *known: piece_energy(cells, *known), argnums=(0, 1, 2))
    x, *others = _of_piece(cells)
    found: Wall = jax.jvp(lambda x: slopes(x, *others), (x,), (y,))[1]
    return found


@jax.jit
def _surface_work(
    potential: Potential, marks: Landmarks, at: Sizes, y_body: Array, y_stop: Array | None, y_q: Array
) -> Sizes:
    """Derivatives of the forces of blood and contact times y, plus the residuals of q times y_q.

    y_body, y_stop: (n_nodes, 3); y_stop is None for a measure of the body alone
    """

    def work(sizes: Sizes) -> Array:
        same = potential.with_data(sizes.data)
        blood = lambda x: energy(same.surfaces.artery, x, sizes.q)  # noqa: E731
        done: Array = jax.jvp(blood, (sizes.x_body,), (y_body,))[1]
        if y_stop is not None:
            all_of_them = lambda x: energy(same.surfaces, x, sizes.q)  # noqa: E731
            states = (settled(same, sizes.x_body, sizes.q), settled(same, sizes.x_stop, sizes.q))
            closing = stop_residual(sizes.stop, marks, same, states)
            residuals = contact_forces(same, sizes.x_stop, sizes.q)[1].at[0].set(closing)
            done = done + jax.jvp(all_of_them, (sizes.x_stop,), (y_stop,))[1] + y_q @ residuals
        return done

    return jax.grad(work)(at)


@jax.jit
def _by_scene(
    d: Discretisation, scene: Scene, measured: Sizes, surfaces: Sizes, walls: list[list[Wall]]
) -> Scene:
    """Derivatives by the scene from those by what it decides; the free positions are no part of that."""

    def sizes(scene: Scene) -> tuple[Sizes, list[Wall]]:
        potential = potential_of(scene, d)
        x, q = positions(scene, d, jnp.zeros(d.layout.free.shape)), jnp.zeros_like(measured.q)
        p = jnp.zeros((len(d.stencils.modes), d.mesh.n_cells))
        state = State(x=x, p=p, q=q)
        known = Sizes(data=potential.data, stop=scene.stop, x_body=x, x_stop=x, q=q, injury=scene.injury)
        return known, [_of_piece(whole(group, state)) for group in potential.layers]

    of_sizes = jax.tree_util.tree_map(jnp.subtract, measured, surfaces)
    of_layers = [
        jax.tree_util.tree_map(lambda *each: -sum(each), *parts) for parts in zip(*walls, strict=True)
    ]
    gradient: Scene = jax.vjp(sizes, scene)[1]((of_sizes, of_layers))[0]
    return gradient


# --- by the clamp alone: a design of jaws needs no more ------------------------------------------------


def value_and_clamp_gradient(result: Result, measure: Measure) -> tuple[float, Scene]:
    """The same with derivatives by clamp, contact and stop alone, 0 elsewhere: a small part of the work.

    The artery in the body does not depend on them, and the wall knows nothing of them.
    """
    known = solution(result, to_stop=True)
    d, potential = result.model.discretisation, result.model.potential
    free = np.asarray(d.layout.free)
    last = result.states[-1].state
    assert result.physiological is not None
    scene = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, float), bare(result.scene))
    at = Sizes(
        data=potential.clamp.data,
        stop=scene.stop,
        x_body=result.physiological.state.x,
        x_stop=last.x,
        q=last.q,
        injury=scene.injury,
    )
    value, slopes = _measured_by_clamp(measure, potential, d.marks, at)
    right: Any = np.asarray(slopes.x_stop).reshape(-1)[free]
    by_q: Any = np.asarray(slopes.q)
    if not np.any(right) and not np.any(by_q):  # a measure of the jaw alone
        nothing = jax.tree_util.tree_map(jnp.zeros_like, at)
        return float(value), _named(_by_clamp(d, scene, slopes, nothing), result.scene)
    y = solve_linear(known, Unknowns(physiological=None, stop=right, q=by_q), transposed=True)
    y_stop = _on_nodes(d.layout, y.stop)
    touch = _clamp_work(potential, d.marks, at, y_stop, jnp.asarray(y.q))
    return float(value), _named(_by_clamp(d, scene, slopes, touch), result.scene)


def _named(gradient: Scene, scene: Scene) -> Scene:
    """A gradient with the title, the solver and the sources of its scene."""
    injury = tuple(
        dataclasses.replace(slope, source=given.source)
        for slope, given in zip(gradient.injury, scene.injury, strict=True)
    )
    return dataclasses.replace(gradient, title=scene.title, solver=scene.solver, injury=injury)


@partial(jax.jit, static_argnums=0)
def _measured_by_clamp(
    measure: Measure, potential: Potential, marks: Landmarks, at: Sizes
) -> tuple[Array, Sizes]:
    def of(sizes: Sizes) -> Array:
        same = potential.with_clamp_data(sizes.data)
        in_body = settled(same, at.x_body, jnp.zeros_like(sizes.q))
        closed = settled(same, sizes.x_stop, sizes.q)
        return measure(Equilibria(potential=same, marks=marks, states=(in_body, closed), injury=at.injury))

    return jax.value_and_grad(of)(at)


@jax.jit
def _clamp_work(potential: Potential, marks: Landmarks, at: Sizes, y_stop: Array, y_q: Array) -> Sizes:
    """Derivatives of the forces of contact times y, plus the residuals of q times y_q."""

    def work(sizes: Sizes) -> Array:
        same = potential.with_clamp_data(sizes.data)
        touch = lambda x: energy(same.clamp, x, sizes.q)  # noqa: E731
        states = (settled(same, at.x_body, sizes.q), settled(same, at.x_stop, sizes.q))
        closing = stop_residual(sizes.stop, marks, same, states)
        residuals = contact_forces(same, at.x_stop, sizes.q)[1].at[0].set(closing)
        done: Array = jax.jvp(touch, (at.x_stop,), (y_stop,))[1]
        return done + y_q @ residuals

    return jax.grad(work)(at)


@jax.jit
def _by_clamp(d: Discretisation, scene: Scene, measured: Sizes, touch: Sizes) -> Scene:
    """Derivatives by clamp, contact and stop from those by what they decide."""

    def sizes(clamp: Any, contact: Any, stop: Any) -> tuple[Any, Stop]:
        changed = dataclasses.replace(scene, clamp=clamp, contact=contact, stop=stop)
        return potential_of(changed, d).clamp.data, stop

    both = [(part.data, part.stop) for part in (measured, touch)]
    by_what = jax.tree_util.tree_map(jnp.subtract, *both)
    clamp, contact, stop = jax.vjp(sizes, scene.clamp, scene.contact, scene.stop)[1](by_what)
    nothing: Scene = jax.tree_util.tree_map(jnp.zeros_like, scene)
    return dataclasses.replace(nothing, clamp=clamp, contact=contact, stop=stop)
