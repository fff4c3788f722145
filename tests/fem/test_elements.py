"""Reference elements: what every entry of `ELEMENTS` promises."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxclamp.fem.elements import ELEMENTS, gauss, lagrange, lobatto, tensor_rule

every_element = pytest.mark.parametrize("element", ELEMENTS.values(), ids=ELEMENTS)
inside = np.random.default_rng(1).uniform(-1.0, 1.0, (40, 3))


def node_positions(element):
    """Reference coordinates of the nodes, (n_en, 3)."""
    return element.nodes_1d[element.node_grid]


@every_element
def test_each_shape_function_is_one_at_its_node_and_zero_at_the_others(element):
    N, _ = element.shape(node_positions(element))
    np.testing.assert_allclose(N, np.eye((element.order + 1) ** 3), atol=1e-14)


@every_element
def test_partition_of_unity(element):
    N, dN = element.shape(inside)
    np.testing.assert_allclose(N.sum(axis=-1), 1.0, rtol=1e-13)
    np.testing.assert_allclose(dN.sum(axis=-1), 0.0, atol=1e-13)


@every_element
def test_polynomials_up_to_the_order_are_reproduced(element):
    polynomial = lambda p: (1 + p[:, 0] + p[:, 1] * p[:, 2]) ** element.order - 2 * p[:, 2] ** element.order
    N, _ = element.shape(inside)
    interpolated = N @ polynomial(node_positions(element))
    np.testing.assert_allclose(interpolated, polynomial(inside), rtol=1e-12, atol=1e-13)


@every_element
def test_gradient_of_shape_functions(element):
    """Against automatic differentiation of the Lagrange product formula."""
    nodes, grid = jnp.asarray(element.nodes_1d), element.node_grid

    def shape(point):
        one = lambda k, x: jnp.prod(
            jnp.stack([(x - nodes[m]) / (nodes[k] - nodes[m]) for m in range(len(nodes)) if m != k])
        )
        return jnp.stack([one(i, point[0]) * one(j, point[1]) * one(k, point[2]) for i, j, k in grid])

    N, dN = element.shape(inside)
    value, slope = jax.jit(jax.vmap(lambda p: (shape(p), jax.jacfwd(shape)(p))))(jnp.asarray(inside))
    np.testing.assert_allclose(N, value, atol=1e-13)
    np.testing.assert_allclose(dN, np.swapaxes(slope, 1, 2), atol=1e-13)


@every_element
def test_facet_functions_are_those_of_the_cell_on_its_outer_face(element):
    on_face = np.column_stack([np.ones(len(inside)), inside[:, 1:]])
    N, dN = element.shape(on_face)
    outer = element.node_grid[:, 0] == element.order
    N_facet, dN_facet = lagrange(element.nodes_1d, on_face[:, 1:])
    np.testing.assert_array_equal(element.node_grid[outer][:, 1:], element.facet_grid)
    np.testing.assert_allclose(N[:, outer], N_facet, atol=1e-14)
    np.testing.assert_allclose(N[:, ~outer], 0.0, atol=1e-14)
    np.testing.assert_allclose(dN[:, 1:][..., outer], dN_facet, atol=1e-13)


@every_element
def test_quadrature_is_exact_to_its_order(element):
    """n Gauss points integrate x**(2n - 1) exactly: int x**p = 2/(p + 1) for even p, else 0; not x**(2n)."""
    points, weights = element.quadrature()
    integral = lambda p: 2.0 / (p + 1) if p % 2 == 0 else 0.0
    n = element.points_per_axis
    for powers in itertools.product(range(2 * n), repeat=3):
        found = weights @ np.prod(points**powers, axis=1)
        assert found == pytest.approx(np.prod([integral(p) for p in powers]), abs=1e-13)
    beyond = weights @ points[:, 0] ** (2 * n)
    assert abs(beyond - 4.0 * integral(2 * n)) > 1e-3


def cell_volume(element, x):
    """Volume of the cell with nodes x (n_en, 3), by the element's own rule."""
    points, weights = element.quadrature()
    _, dN = element.shape(points)
    return weights @ np.linalg.det(dN @ x)


@every_element
def test_volume_of_a_twisted_hexahedron(element):
    """x = (X + a Y Z, Y + b Z X, Z + c X Y): det = 1 - bc X^2 - ca Y^2 - ab Z^2 + 2 abc XYZ.

    Its integral over [-1, 1]^3 is 8 - 8/3 (ab + bc + ca).
    """
    a, b, c = 0.3, -0.2, 0.25
    X, Y, Z = node_positions(element).T
    x = np.column_stack([X + a * Y * Z, Y + b * Z * X, Z + c * X * Y])
    assert cell_volume(element, x) == pytest.approx(8.0 - 8.0 / 3.0 * (a * b + b * c + c * a), rel=1e-13)


@pytest.mark.parametrize("element", [e for e in ELEMENTS.values() if e.order >= 2], ids=lambda e: e.name)
def test_volume_of_a_curved_hexahedron(element):
    """x = (X (1 + a Y^2 Z^2), Y (1 + b X^2), Z): det = (1 + a Y^2 Z^2)(1 + b X^2) - 4 ab X^2 Y^2 Z^2.

    Its integral is 8 [1 + a/9 + b/3 + ab/27 - 4 ab/27].
    """
    a, b = 0.3, -0.2
    X, Y, Z = node_positions(element).T
    x = np.column_stack([X * (1 + a * Y**2 * Z**2), Y * (1 + b * X**2), Z])
    expected = 8.0 * (1.0 + a / 9.0 + b / 3.0 - a * b / 9.0)
    assert cell_volume(element, x) == pytest.approx(expected, rel=1e-13)


@every_element
def test_volume_does_not_depend_on_the_frame(element):
    rotation, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    x = node_positions(element) + 0.1 * np.random.default_rng(3).normal(size=(len(element.node_grid), 3))
    moved = 2.0 * x @ rotation.T + [1.0, -5.0, 3.0]
    assert cell_volume(element, moved) == pytest.approx(8.0 * cell_volume(element, x), rel=1e-12)


@every_element
def test_pressure_modes(element):
    """One mode per cell, and those linear along some axes, independent on the quadrature points."""
    points, weights = element.quadrature()
    modes = element.pressure_modes(points)
    axes = {"q1p0": [], "q1pz": [2], "q2p1": [0, 1, 2]}[element.name]
    np.testing.assert_array_equal(modes, [np.ones(len(points)), *points.T[axes]])
    # int 1 = 8, int x**2 = 8/3, all mixed integrals vanish
    expected = np.diag([8.0, *[8.0 / 3.0] * (len(modes) - 1)])
    np.testing.assert_allclose((modes * weights) @ modes.T, expected, atol=1e-13)


@every_element
def test_fewer_pressures_than_displacements(element):
    """Constraints per cell against 3 order**3 displacements per cell of a large mesh: no locking."""
    n_modes = len(element.pressure_modes(np.zeros((1, 3))))
    assert n_modes < 3 * element.order**3


# Node numbering of VTK's hexahedra (vtkHexahedron, vtkTriQuadraticHexahedron): corners round the
# bottom, then round the top; the edges between the corners named; faces -x +x -y +y -z +z; centre.
VTK_CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
VTK_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
VTK_FACES = [(0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7)]
MESHIO_NODES = {"hexahedron": 8, "hexahedron27": 27}


@every_element
def test_mesh_files_number_nodes_as_vtk_does(element):
    order = list(element.meshio_nodes)
    assert sorted(order) == list(range((element.order + 1) ** 3))
    assert len(order) == MESHIO_NODES[element.meshio_name]
    x = node_positions(element)[order]
    np.testing.assert_array_equal(x[:8], 2.0 * np.array(VTK_CORNERS) - 1.0)
    if len(order) == 27:
        np.testing.assert_array_equal(x[8:20], [x[list(edge)].mean(axis=0) for edge in VTK_EDGES])
        np.testing.assert_array_equal(x[20:26], [x[list(face)].mean(axis=0) for face in VTK_FACES])
        np.testing.assert_array_equal(x[20:26:2], -np.eye(3))
        np.testing.assert_array_equal(x[21:26:2], np.eye(3))
        np.testing.assert_array_equal(x[26], 0.0)


@every_element
def test_corners_are_right_handed_in_mesh_files(element):
    x = node_positions(element)[list(element.meshio_nodes)]
    edges = np.stack([x[1] - x[0], x[3] - x[0], x[4] - x[0]])
    assert np.linalg.det(edges) > 0.0


def test_gauss_rule():
    """Two points: +-1/sqrt(3), weights 1."""
    points, weights = gauss(2)
    np.testing.assert_allclose(points, [-1 / np.sqrt(3), 1 / np.sqrt(3)], rtol=1e-14)
    np.testing.assert_allclose(weights, 1.0, rtol=1e-14)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 8])
def test_lobatto_rule(n):
    """The ends are points; polynomials of degree 2 n - 3 are integrated exactly, the next even one is not."""
    points, weights = lobatto(n)
    assert (points[0], points[-1], len(points)) == (-1.0, 1.0, n)
    for degree in range(2 * n - 2):
        expected = (1.0 + (-1.0) ** degree) / (degree + 1)
        assert weights @ points**degree == pytest.approx(expected, abs=1e-14)
    assert abs(weights @ points ** (2 * n - 2) - 2.0 / (2 * n - 1)) > 1e-6


def test_tensor_rule_may_differ_by_axis():
    points, weights = tensor_rule((2, 3))
    assert points.shape == (6, 2)
    assert weights @ (points[:, 0] ** 2 * points[:, 1] ** 4) == pytest.approx(2 / 3 * 2 / 5, rel=1e-13)
