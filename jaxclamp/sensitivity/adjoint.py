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
from jaxclamp.observe.measures import Measure, Seen
from jaxclamp.observe.stresses import Landmarks
from jaxclamp.physics.materials import Material
from jaxclamp.potential.densities import Geometry, Parameters, Stencils
from jaxclamp.potential.model import Discretisation, body_of
from jaxclamp.potential.tangent import (
    Body,
    Piece,
    State,
    block_energy,
    contact_potential,
    cut,
    lumen_volume,
    touch_potential,
    with_equilibrium_pressure,
)
from jaxclamp.scenes.scene import Scene, Stop
from jaxclamp.sensitivity.implicit import Unknowns, closing_residual, positions, solution, solve_linear
from jaxclamp.solve.results import Result


@record
class Sizes:
    """What the potential and the measures know of a scene; also the form of derivatives by it."""

    geometry: Geometry
    parameters: Parameters
    pressure: Array
    stop: Stop
    x_body: Array
    """positions in the body, mm, (n_nodes, 3)"""
    x_stop: Array
    """positions at the stop, mm, (n_nodes, 3); in a measure of the body alone, those in the body"""
    jaw_height: Array
    """at the stop, mm"""


def value_and_gradient(result: Result, measure: Measure) -> tuple[float, Scene]:
    """Value of a measure and its derivative by every float of the scene, at a result at hand.

    The gradient is a scene, per internal unit (mm, kPa, mN, radians). One adjoint solve with the factors
    that the clamping left behind.

    Raises EquilibriumError if the stop was not reached, ValueError if it was not asked for.
    """
    to_stop = measure.needs_stop
    known = solution(result, to_stop)
    model = result.model
    parts, body, free = model.discretisation, model.body, np.asarray(model.discretisation.topology.free)
    assert result.physiological is not None
    base, last = result.physiological.state, result.states[-1].state
    scene = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf, float), result.scene)
    at = Sizes(
        geometry=body.geometry,
        parameters=body.parameters,
        pressure=scene.artery.pressure,
        stop=scene.stop,
        x_body=base.x,
        x_stop=last.x if to_stop else base.x,
        jaw_height=last.jaw_height,
    )
    value, slopes = _measured(measure, body, parts.marks, at)
    on_free = lambda a: np.asarray(a).reshape(-1)[free]  # noqa: E731
    height: Any = np.asarray(slopes.jaw_height)
    y = solve_linear(
        known,
        Unknowns(
            physiological=on_free(slopes.x_body),
            stop=on_free(slopes.x_stop) if to_stop else None,
            jaw_height=height if to_stop else None,
        ),
        transposed=True,
    )
    everywhere = lambda v: np.bincount(free, v, minlength=base.x.size).reshape(base.x.shape)  # noqa: E731
    y_body = everywhere(y.physiological)
    work = [_wall_work(body, base, y_body)]
    if to_stop:
        y_stop, y_height = everywhere(y.stop), jnp.asarray(y.jaw_height)
        work.append(_wall_work(body, last, y_stop))
        touch = _surface_work(body, parts.marks, at, y_body, y_stop, y_height)
    else:
        touch = _surface_work(body, parts.marks, at, y_body, None, at.jaw_height)
    return float(value), _by_scene(parts, scene, slopes, touch, work)


@partial(jax.jit, static_argnums=0)
def _measured(measure: Measure, body: Body, marks: Landmarks, at: Sizes) -> tuple[Array, Sizes]:
    """The measure and its derivatives."""

    def of(sizes: Sizes) -> Array:
        same = _with(body, sizes)
        state = partial(with_equilibrium_pressure, same)
        seen = Seen(
            body=same,
            marks=marks,
            physiological=state(sizes.x_body, jnp.zeros(())),
            stop=state(sizes.x_stop, sizes.jaw_height) if measure.needs_stop else None,
        )
        return measure(seen)

    return jax.value_and_grad(of)(at)


def _with(body: Body, sizes: Sizes) -> Body:
    return dataclasses.replace(body, geometry=sizes.geometry, parameters=sizes.parameters)


WallWork = list[tuple[Piece, Material]]
"""derivatives of the wall's forces times an adjoint, by block: by its positions, geometry, material"""


def _wall_work(body: Body, state: State, y: np.ndarray) -> WallWork:
    """Derivatives of the wall's forces at a state times y, (n_nodes, 3)."""
    pieces = cut(body, state)
    moves = cut(body, dataclasses.replace(state, x=jnp.asarray(y)))
    materials = [body.parameters.materials[layer] for layer, _, _ in body.topology.blocks]
    blocks = zip(pieces, moves, materials, strict=True)
    return [_block_work(piece, material, body.stencils, move.x) for piece, move, material in blocks]


@jax.jit
def _block_work(piece: Piece, material: Material, stencils: Stencils, y: Array) -> tuple[Piece, Material]:
    """Derivatives of a block's forces times y; one program for all blocks of one size and law."""

    def work(piece: Piece, material: Material) -> Array:
        energy = lambda x: block_energy(dataclasses.replace(piece, x=x), stencils, material)  # noqa: E731
        return jax.jvp(energy, (piece.x,), (y,))[1]

    return jax.grad(work, argnums=(0, 1))(piece, material)


@jax.jit
def _surface_work(
    body: Body, marks: Landmarks, at: Sizes, y_body: Array, y_stop: Array | None, y_height: Array
) -> Sizes:
    """Derivatives of the forces of blood and contact times y plus the residual of the stop times y_height.

    y_body, y_stop: (n_nodes, 3); y_stop is None for a measure of the body alone
    """

    def work(sizes: Sizes) -> Array:
        same, height = _with(body, sizes), sizes.jaw_height
        blood = lambda x: -sizes.pressure * lumen_volume(same, x)  # noqa: E731
        done: Array = jax.jvp(blood, (sizes.x_body,), (y_body,))[1]
        if y_stop is not None:
            closed = lambda x: blood(x) + touch_potential(same, x, height)  # noqa: E731
            lift = jax.grad(contact_potential, argnums=2)(same, sizes.x_stop, height)
            closing = closing_residual(sizes.stop, marks, sizes.x_body, sizes.x_stop, height, lift)
            done = done + jax.jvp(closed, (sizes.x_stop,), (y_stop,))[1] + y_height * closing
        return done

    return jax.grad(work)(at)


@jax.jit
def _by_scene(
    parts: Discretisation, scene: Scene, measured: Sizes, surfaces: Sizes, walls: list[WallWork]
) -> Scene:
    """Derivatives by the scene from those by what it decides; the free positions are no part of that."""

    def sizes(scene: Scene) -> tuple[Sizes, WallWork]:
        body = body_of(scene, parts)
        x = positions(scene, parts, jnp.zeros(parts.topology.free.shape))
        state = State(
            x=x, p=jnp.zeros((len(body.stencils.modes), parts.mesh.n_cells)), jaw_height=jnp.zeros(())
        )
        known = Sizes(
            geometry=body.geometry,
            parameters=body.parameters,
            pressure=scene.artery.pressure,
            stop=scene.stop,
            x_body=x,
            x_stop=x,
            jaw_height=jnp.zeros(()),
        )
        materials = [body.parameters.materials[layer] for layer, _, _ in parts.topology.blocks]
        return known, list(zip(cut(body, state), materials, strict=True))

    of_sizes = jax.tree_util.tree_map(jnp.subtract, measured, surfaces)
    of_blocks = [
        jax.tree_util.tree_map(lambda *each: -sum(each), *block) for block in zip(*walls, strict=True)
    ]
    return jax.vjp(sizes, scene)[1]((of_sizes, of_blocks))[0]
