"""ParaView files as a user reads them: tensors, fibres, energy, layers, contact, time of the series."""

import dataclasses
import types

import numpy as np
import pytest
from scipy.spatial import KDTree
from test_outputs import COARSE, pressed, volumes

import jaxclamp as jc
from jaxclamp.pictures.fields import layer_fields, whole
from jaxclamp.pictures.tensors import with_fibres, with_tensors
from jaxclamp.show import paraview

meshio = pytest.importorskip("meshio")


@pytest.fixture(scope="module")
def result():
    return jc.clamp(jc.load_scene("human-lad", [*COARSE, "stop.occlusion=0.5"]))


@pytest.fixture(scope="module")
def states(result, tmp_path_factory):
    """The artery in every state, as read back."""
    folder = tmp_path_factory.mktemp("states")
    paraview.write_states(result, folder)
    return [meshio.read(path) for path in sorted(folder.glob("paraview/artery_*.vtu"))]


def tensor(mesh, name: str) -> np.ndarray:
    return mesh.point_data[name].reshape(-1, 3, 3)


def test_the_stress_tensor_is_that_of_the_other_stresses(states):
    for mesh in states:
        sigma = tensor(mesh, "cauchy_stress_kPa")
        np.testing.assert_allclose(sigma[:, 2, 2], mesh.point_data["axial_stress_kPa"], atol=1e-10)
        np.testing.assert_allclose(sigma, sigma.transpose(0, 2, 1), atol=1e-10)


def test_stress_balances_the_blood(states, result):
    """Laplace: the mean circumferential stress of the tube in the body is p r_i / wall."""
    mesh, body = states[1], result.physiological.values
    inner, outer = 0.5 * body["lumen_height_mm"], body["outer_radius_mm"]
    cells = mesh.cells[0].data
    radius = np.hypot(*mesh.points[:, :2].T)
    around = np.stack([-mesh.points[:, 1], mesh.points[:, 0], 0 * radius], axis=1) / radius[:, None]
    hoop = np.einsum("ni,nij,nj->n", around, tensor(mesh, "cauchy_stress_kPa"), around)
    area = volumes(mesh.points, cells)[0] / radius[cells].mean(1)
    mean = np.sum(hoop[cells].mean(1) * area) / np.sum(area)
    pressure = float(result.scene.artery.pressure)
    assert mean == pytest.approx(pressure * inner / (outer - inner), rel=0.03)


def test_fibres_turn_and_stretch_with_the_wall(states, result):
    """In a tube: tan(angle) grows by axial over circumferential stretch."""
    mesh = states[1]
    F, layer = tensor(mesh, "deformation_gradient"), np.zeros(len(mesh.points), dtype=int)
    for number in (1, 2):
        layer[mesh.cells[0].data[mesh.cell_data["layer"][0] == number]] = number - 1
    assert np.linalg.det(F) == pytest.approx(1.0, abs=0.02)
    hoop, along = np.linalg.norm(F[:, :, 1], axis=1), np.linalg.norm(F[:, :, 2], axis=1)
    assert along == pytest.approx(1.1, rel=0.02)  # the sectors are as long as the load-free tube
    angle = np.array([float(each.material.fibre_angle) for each in result.scene.artery.layers])[layer]
    outward = mesh.points * [1, 1, 0] / np.hypot(*mesh.points[:, :2].T)[:, None]
    for number, sign in ((1, 1.0), (2, -1.0)):
        fibre = mesh.point_data[f"fibre_{number}"]
        assert np.linalg.norm(fibre, axis=1) == pytest.approx(1.0)
        assert np.abs(np.sum(fibre * outward, axis=1)).max() < 0.02
        around = fibre[:, 1] * outward[:, 0] - fibre[:, 0] * outward[:, 1]
        np.testing.assert_allclose(sign * fibre[:, 2] / around, np.tan(angle) * along / hoop, rtol=0.02)
        stretch = np.hypot(hoop * np.cos(angle), along * np.sin(angle))
        assert mesh.point_data[f"fibre_{number}_stretch"] == pytest.approx(stretch, rel=0.01)


def test_energy_of_the_cells_is_that_of_the_wall(states, result):
    """Per stress-free volume, which is the volume in the file over the cell's J."""
    for mesh, kept in zip(states, result.states, strict=True):
        size = volumes(mesh.points, mesh.cells[0].data)[0]
        energy = mesh.cell_data["strain_energy_density_kPa"][0] * size / mesh.cell_data["J"][0]
        assert energy.sum() == pytest.approx(8.0 * kept.equilibrium.lin.wall_energy, rel=1e-8)


def test_layers_have_their_names(states):
    number = states[0].cell_data["layer"][0]
    for i, name in enumerate(("media", "adventitia"), 1):
        assert np.array_equal(states[0].cell_data[f"layer_{name}"][0], number == i)


def test_the_highest_contact_pressure_is_that_of_the_table(states, result):
    """At the points of the cells; spread to the nodes it is lower."""
    cells, nodes = (
        [data.max() for data in parts]
        for parts in zip(
            *(
                (mesh.cell_data["highest_contact_pressure_kPa"][0], mesh.point_data["contact_pressure_kPa"])
                for mesh in states[2:]
            ),
            strict=True,
        )
    )
    table = [record["max_contact_pressure_kPa"] for record in result.history[1:]]
    np.testing.assert_allclose(cells, table, rtol=1e-12)
    assert np.all(np.array(nodes) < np.array(table))
    pressed_cells = states[-1].cell_data["highest_contact_pressure_kPa"][0] > 0.0
    assert np.all(states[-1].cell_data["layer"][0][pressed_cells] == 2)


@pytest.mark.parametrize("symmetry", ["xy", "yz", "none"])
def test_tensors_and_fibres_do_not_tell_how_much_is_modelled(symmetry):
    few, many = (_with_all(pressed(each)) for each in ("xyz", symmetry))
    for expected, found in zip(few, many, strict=True):
        distance, place = KDTree(found.points).query(expected.points)
        assert distance.max() < 1e-9
        for name in ("cauchy_stress_kPa", "deformation_gradient", "fibre_1", "fibre_2", "fibre_1_stretch"):
            values = found.point_data[name][place]
            np.testing.assert_allclose(values, expected.point_data[name], atol=1e-9, err_msg=name)
        for name in ("strain_energy_density_kPa", "highest_contact_pressure_kPa"):
            assert np.sort(found.cell_data[name]) == pytest.approx(np.sort(expected.cell_data[name]))


def _with_all(result):
    model, state = result.model, result.closing[-1].state
    layers = with_tensors(model, state, layer_fields(model, state))
    return with_fibres(tuple(whole(layer) for layer in layers))


def test_a_layer_without_fibres_stands_beside_one_with():
    layers = _with_all(pressed("xyz"))
    bare = dataclasses.replace(layers[0], fibres=())
    media, adventitia = with_fibres((bare, layers[1]))
    assert not np.any(media.point_data["fibre_1"])
    assert not np.any(media.point_data["fibre_2_stretch"])
    assert np.linalg.norm(adventitia.point_data["fibre_2"], axis=1) == pytest.approx(1.0)
    assert not [name for name in with_fibres((bare,))[0].point_data if name not in layers[0].point_data]


def test_times_are_told_apart(result):
    """States of one occlusion, on a way that comes back: none hides another."""
    kept = [types.SimpleNamespace(stage="clamping", values={"occlusion": o}) for o in (0.5, 0.9, 0.5, 0.5)]
    first = types.SimpleNamespace(stage="load-free", values={"occlusion": 0.0})
    times = paraview.times(types.SimpleNamespace(states=(first, *kept)))
    assert len(set(times)) == 5
    assert times == pytest.approx([-1.0, 0.5, 0.9, 0.5, 0.5], rel=1e-15)
