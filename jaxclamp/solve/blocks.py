"""General blocks through the same doors: a brick, a strip, a block under a jaw, with any nodes held.

What a clamped artery is solved with, on bodies of one's own: patch tests, analytic cases and comparisons
with other codes need nothing else.

    block = brick("q1p0", (2,), 3, 4, positions, (material,), held)
    found = settle(block, moved)            # moved: where the held nodes go
    reactions(block, found.state)           # forces on the held nodes
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxclamp.core.failures import NotConverged
from jaxclamp.core.programs import forget_if_crowded
from jaxclamp.fem.grid import Mesh, build_block
from jaxclamp.fem.pattern import FACETS_PER_BLOCK, Layout, Pattern, block_size, build_pattern
from jaxclamp.fem.stencils import build_stencils
from jaxclamp.observe.stresses import cauchy_stress
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material
from jaxclamp.physics.placement import SQUARE
from jaxclamp.potential.bodies import Body, brick_body, facet_areas
from jaxclamp.potential.densities import Touch, jaw_energy, rigid
from jaxclamp.potential.energy import State, energy, with_equilibrium_pressure
from jaxclamp.potential.kinds import wall_terms
from jaxclamp.potential.tangent import whole
from jaxclamp.potential.terms import JAWS, Potential, Term, build_potential
from jaxclamp.solve.descent import descend
from jaxclamp.solve.linear_solvers import LinearSolver
from jaxclamp.solve.newton import Equilibrium, Step, System, newton
from jaxclamp.solve.stops import Held

OPEN = 1e6
"""height of a jaw that is not there, mm"""


@dataclasses.dataclass(frozen=True)
class Block:
    """A body with held nodes, ready to compute with."""

    body: Body
    """cells, laws, stress-free positions"""
    held: np.ndarray
    """degrees of freedom that go where they are told to, (n_nodes, 3)"""
    positions: np.ndarray
    """stress-free position of the nodes, mm, (n_nodes, 3)"""
    potential: Potential
    """its terms"""
    pattern: Pattern
    """of the sparse tangent"""

    @property
    def mesh(self) -> Mesh:
        """Its cells and facets; `mesh.plane` finds the nodes of a side."""
        return self.body.mesh

    @property
    def layout(self) -> Layout:
        """Numbers of the unknowns."""
        return self.potential.layout


def brick(
    element: str,
    layers: tuple[int, ...],
    around: int,
    along: int,
    positions: np.ndarray | Callable[[np.ndarray], np.ndarray],
    materials: tuple[Material, ...],
    held: np.ndarray | Callable[[np.ndarray], np.ndarray],
    jaw: tuple[Jaw, Contact] | None = None,
    contact_points: int = 4,
) -> Block:
    """A structured block of `layers` by `around` by `along` cells, stress-free where its nodes are.

    positions: (n_nodes, 3) in mm, or a function that gives them for places in the unit cube (through the
    layers, around, along; (n_nodes, 3)); held: True for held degrees of freedom, (n_nodes, 3), or a
    function of the positions; materials: one for each layer, fibres in the y-z plane; constants may be
    arrays (n_q, n_cells of the layer); jaw: presses on the outer facets of the last layer, from above (+y)
    """
    forget_if_crowded()
    mesh = build_block(element, layers, around, along)
    stencils = build_stencils(mesh.element, contact_points)
    X = positions(unit_places(mesh)) if callable(positions) else np.asarray(positions, float)
    fixed = np.asarray(held(X) if callable(held) else held, bool)
    size = block_size(len(stencils.weights))
    nodes = {f"layer {i}": (mesh.cells[:, slice(*span)], size) for i, span in enumerate(mesh.layer_cells)}
    nodes["upper outside"] = (mesh.outer_facets, FACETS_PER_BLOCK)
    layout, regions, pattern = build_pattern(fixed, nodes)
    layout, regions = jax.device_put((layout, regions))
    body = brick_body(mesh, stencils, X, materials)
    terms = list(wall_terms(body, stencils, [str(i) for i in range(len(layers))]))
    if jaw is not None:
        dA = facet_areas(body, stencils.contact, outer=True)
        here = Touch(jaw=jaw[0], placement=SQUARE, contact=jaw[1], dA=dA, rule=stencils.contact)
        touch = {"name": JAWS, "region": "upper outside", "stencil": "contact"}
        terms.append(Term(density=jaw_energy, here=here, moved=True, **touch))
    potential = build_potential(terms, regions, stencils, layout)
    potential = jax.device_put(potential)
    return Block(body=body, held=fixed, positions=X, potential=potential, pattern=pattern)


def unit_places(mesh: Mesh) -> np.ndarray:
    """Grid places of the nodes in the unit cube (through, around, along), (n_nodes, 3)."""
    places = np.unravel_index(np.arange(mesh.n_nodes), mesh.grid[::-1])[::-1]
    return np.stack(places, axis=1) / (np.array(mesh.grid) - 1.0)


def settle(
    block: Block,
    moved: np.ndarray,
    *,
    start: np.ndarray | None = None,
    jaw_height: float | None = None,
    steps: int = 1,
    tolerance: float = 1e-10,
) -> Equilibrium:
    """Equilibrium with the held degrees of freedom where `moved` (n_nodes, 3; mm) says.

    start: positions to start from, (n_nodes, 3); steps: in which the held nodes (and the jaw) get there.
    Where Newton's method fails, the way downhill. Raises NotConverged.
    """
    x = block.positions if start is None else np.asarray(start, float)
    size = float(np.max(np.ptp(block.positions, axis=0)))
    solver = LinearSolver(block.pattern)
    system = System(block.potential, solver, tolerance, size, block.pattern)
    height = OPEN if jaw_height is None else jaw_height
    top = float(np.max(x[:, 1]))
    found, way = None, np.where(block.held, np.asarray(moved) - x, 0.0) / steps
    carried = _carried_along(block, way)
    for number in range(1, steps + 1):
        target = x + np.where(block.held, way, carried)
        jaw = height if height == OPEN else top + number / steps * (height - top)
        state = at_rest(block, target, jaw)
        step = Step(Held(jaw), 0.0, 1.0)
        try:
            found = newton(system, state, step)
        except NotConverged:
            found = descend(system, state, step)
        x = np.asarray(found.state.x)
    assert found is not None
    return found


def _carried_along(block: Block, way: np.ndarray) -> np.ndarray:
    """How all nodes go if the body follows its held nodes like an affine map, mm, (n_nodes, 3)."""
    X = np.column_stack([np.ones(len(block.positions)), block.positions])
    fits = [
        np.linalg.lstsq(X[held], u[held], rcond=None)[0] for held, u in zip(block.held.T, way.T, strict=True)
    ]
    return X @ np.stack(fits, axis=1)


def at_rest(block: Block, x: np.ndarray, jaw_height: float = OPEN) -> State:
    """The state with nodes at x (n_nodes, 3) and pressures that fit."""
    q = rigid(jaw_height)
    return with_equilibrium_pressure(block.potential, jnp.asarray(x), q)


def reactions(block: Block, state: State) -> np.ndarray:
    """Forces that hold the held degrees of freedom, mN, (n_nodes, 3); 0 elsewhere, to the tolerance."""
    return np.asarray(_gradient(block.potential, state))


_gradient = jax.jit(lambda potential, state: jax.grad(energy, argnums=1)(potential, state.x, state.q))


def stress(block: Block, state: State, layer: int = 0) -> np.ndarray:
    """Cauchy stress at the points of a layer, kPa, (3, 3, n_q, n_cells)."""
    group = block.potential.layers[layer]
    _, sigma = cauchy_stress(whole(group, state))
    return np.stack([np.stack([np.asarray(sigma[i, j]) for j in range(3)]) for i in range(3)])
