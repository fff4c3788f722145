"""What a clamping leaves on disk: complete, readable by others, consistent, and all or nothing."""

import csv
import dataclasses
import errno
import functools
import json
import re
import types
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from scipy.spatial import KDTree

import jaxclamp as jc
from jaxclamp.core.failures import EquilibriumError, NotConverged
from jaxclamp.fem.tube import closed_positions
from jaxclamp.observe.figures import shown_in
from jaxclamp.observe.stresses import stresses
from jaxclamp.pictures import fields, plots
from jaxclamp.pictures.plots import style
from jaxclamp.pictures.plots.style import colours
from jaxclamp.potential.densities import rigid
from jaxclamp.potential.energy import with_equilibrium_pressure
from jaxclamp.potential.model import build_model
from jaxclamp.show import export, paraview
from jaxclamp.show.report import page, write_report

meshio = pytest.importorskip("meshio")

FIGURES = ("axial_stress_maps", "damage_maps", "force_travel", "sections", "stress_at_P", "wall_stress")
COARSE = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2, 1]"]
LAYERS = ("media", "adventitia")
FINAL = (
    *("jaw_travel_mm", "lumen_height_mm", "lumen_width_mm", "occlusion", "lumen_area_mm2", "area_occlusion"),
    *("clamp_force_N", "max_contact_pressure_kPa", "max_penetration_mm", "axial_stress_at_P_kPa"),
    *("axial_stress_ratio_at_P", "circumferential_stress_ratio_at_P", "peak_axial_stress_kPa"),
    *("peak_axial_stress_location_mm", "smooth_peak_axial_stress_kPa", "J_min", "J_max"),
)
"""keys of `final` that programs rely on"""


@pytest.fixture(scope="module")
def result():
    return jc.clamp(jc.load_scene("human-lad", [*COARSE, "stop.occlusion=0.5"]))


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    """The outputs of `result`; for reading only."""
    target = tmp_path_factory.mktemp("outputs") / "new" / "place"
    target_files = export.write_outputs(result, target)
    assert all(path.is_file() for path in target_files)
    assert set(target_files) == files_below(target)
    return target


def files_below(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


def volumes(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, float]:
    """Volumes of hexahedra in VTK's numbering by 2 x 2 x 2 Gauss points, and the least Jacobian."""
    corners = np.array(
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    )
    total, least = np.zeros(len(cells)), np.inf
    for gauss in corners / np.sqrt(3.0):
        factors = 1.0 + corners * gauss
        slopes = [corners[:, d] * np.prod(np.delete(factors, d, axis=1), axis=1) / 8.0 for d in range(3)]
        jacobian = np.linalg.det(np.einsum("da,cai->cdi", np.array(slopes), points[cells]))
        total, least = total + jacobian, min(least, jacobian.min())
    return total, least


# --------------------------------------------------------------------------------- the set of files


def test_every_file_is_there_and_nothing_else(result, folder):
    states = {
        f"paraview/{part}_{i:03d}.vtu" for part in ("artery", "jaws") for i in range(len(result.states))
    }
    figures = {f"figures/{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")}
    expected = {"README.md", "result.json", "scene.toml", "history.csv", "report.html", "clamping.pvd"}
    expected |= {"jaw.csv", "jaw.stl"} | states | figures
    assert {path.relative_to(folder).as_posix() for path in files_below(folder)} == expected


def test_result_json_is_strict_and_complete(result, folder):
    refuse = lambda text: pytest.fail(f"{text} is not JSON")
    content = json.loads((folder / "result.json").read_text(), parse_constant=refuse)
    assert set(content) >= {"title", "converged", "load_free", "physiological", "final", "history", "model"}
    assert set(content) >= {"solver", "cost", "versions"}
    assert content["converged"] is True
    assert set(FINAL) <= set(content["final"])
    assert all(set(content["final"]) == set(record) for record in content["history"])
    assert content["final"] == content["history"][-1]
    assert set(content["final"]["peak_axial_stress_kPa"]) == set(LAYERS)
    assert content["final"]["occlusion"] == pytest.approx(0.5)
    assert content == json.loads(json.dumps(export.plain(result.to_dict())))


def test_history_csv_has_a_row_per_state_and_flat_columns(result, folder):
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.history)
    assert [row["state"] for row in rows] == [str(i) for i in range(len(rows))]
    for row, record in zip(rows, result.history, strict=True):
        assert float(row["clamp_force_N"]) == record["clamp_force_N"]
        assert float(row["peak_axial_stress_kPa.media"]) == record["peak_axial_stress_kPa"]["media"]
        z = record["peak_axial_stress_location_mm"]["adventitia"][2]
        assert float(row["peak_axial_stress_location_mm.adventitia.z"]) == z


def test_numbers_that_json_does_not_have_become_null_and_empty():
    record = {"a": float("nan"), "b": np.float64(2.0), "c": {"media": jnp.inf}, "n": np.int64(3), "d": None}
    assert json.loads(export.as_json(export.plain(record))) == {
        "a": None,
        "b": 2.0,
        "c": {"media": None},
        "n": 3,
        "d": None,
    }
    assert export.history_csv([record]) == "state,a,b,c.media,n,d\n0,,2.0,,3,\n"


# --------------------------------------------------------------------------------- ParaView


def test_index_names_every_state_of_both_parts(result, folder):
    root = ET.parse(folder / "clamping.pvd").getroot()
    assert (root.tag, root.attrib["type"]) == ("VTKFile", "Collection")
    entries = [entry.attrib for entry in root.iter("DataSet")]
    times = list(dict.fromkeys(float(entry["timestep"]) for entry in entries))
    assert times == [-1.0, *(record["occlusion"] for record in result.history)]
    assert {(entry["part"], entry["name"]) for entry in entries} == {("0", "artery"), ("1", "jaws")}
    assert len(entries) == 2 * len(result.states)
    assert all((folder / entry["file"]).is_file() for entry in entries)


@pytest.mark.parametrize("number", [0, 1, -1])
def test_artery_is_whole_sound_and_of_the_right_volume(result, folder, number):
    kept = result.states[number]
    mesh = meshio.read(sorted(folder.glob("paraview/artery_*.vtu"))[number])
    (block,) = mesh.cells
    assert block.type == "hexahedron"
    assert len(block.data) == 8 * result.model.mesh.n_cells
    cell_volumes, least = volumes(mesh.points, block.data)
    assert least > 0.0
    potential = result.model.potential
    known = zip(potential.layers, stresses(potential, kept.state), strict=True)
    modelled = sum(float(jnp.sum(s.J * group.solid.dV)) for group, s in known)
    assert cell_volumes.sum() == pytest.approx(8.0 * modelled, rel=1e-12)
    stretch = kept.equilibrium.axial_stretch
    length = float(result.scene.artery.length) * stretch
    assert np.ptp(mesh.points[:, 2]) == pytest.approx(length)
    np.testing.assert_allclose(mesh.points.min(0), -mesh.points.max(0), rtol=1e-12)
    for name, values in (mesh.point_data | {k: v[0] for k, v in mesh.cell_data.items()}).items():
        assert np.all(np.isfinite(values)), name
    assert set(mesh.point_data) >= {*fields.STRESSES, "pressure_kPa", "displacement_mm"}
    assert np.unique(mesh.cell_data["layer"][0]).tolist() == [1, 2]
    assert mesh.cell_data["J"][0] == pytest.approx(1.0, abs=0.05)


def test_points_are_shared_inside_a_layer_and_doubled_between_layers(result, folder):
    mesh = meshio.read(sorted(folder.glob("paraview/artery_*.vtu"))[-1])
    cells, layer = mesh.cells[0].data, mesh.cell_data["layer"][0]
    inner, outer = np.unique(cells[layer == 1]), np.unique(cells[layer == 2])
    assert len(np.intersect1d(inner, outer)) == 0
    assert len(inner) + len(outer) == len(mesh.points)
    for points in (mesh.points[inner], mesh.points[outer]):
        assert len(np.unique(np.round(points, 9), axis=0)) == len(points)
    around, along = 4 * 4, 2 * 6 + 1
    assert len(outer) == around * along * 2
    both = np.unique(np.round(mesh.points, 9), axis=0)
    assert len(mesh.points) - len(both) == around * along


def test_stress_and_displacement_are_those_of_the_result(result, folder):
    mesh = meshio.read(sorted(folder.glob("paraview/artery_*.vtu"))[-1])
    P = [0.0, 0.5 * result.final["lumen_height_mm"], 0.0]
    nearest = np.argmin(np.linalg.norm(mesh.points - P, axis=1))
    assert mesh.points[nearest] == pytest.approx(P, abs=1e-12)
    assert mesh.point_data["axial_stress_kPa"][nearest] == pytest.approx(
        result.final["axial_stress_at_P_kPa"]
    )
    start = meshio.read(folder / "paraview/artery_000.vtu")
    moved = mesh.points - start.points
    np.testing.assert_allclose(mesh.point_data["displacement_mm"], moved, atol=1e-12)
    assert not np.any(start.point_data["displacement_mm"])


def test_contact_pressure_at_the_nodes_carries_the_jaw(result):
    state = result.states[-1].state
    pressure = fields.nodal_contact_pressure(result.model, state)
    assert pressure.min() >= 0.0
    assert 0.2 < pressure.max() / result.final["max_contact_pressure_kPa"] <= 1.0
    outer = result.model.mesh.plane(0, -1)
    assert np.all(np.isin(np.flatnonzero(pressure), outer))


def test_jaws_are_drawn_where_the_gap_is_zero(result, folder):
    jaw, height = result.scene.clamp.jaw, float(result.states[-1].state.jaw_height)
    mesh = meshio.read(sorted(folder.glob("paraview/jaws_*.vtu"))[-1])
    (block,) = mesh.cells
    assert block.type == "quad"
    x, y, z = mesh.points.T
    gap = jaw.gap((jnp.asarray(x), jnp.asarray(np.abs(y) - height), jnp.asarray(z)))
    assert np.abs(gap).max() < 1e-3
    assert np.min(np.abs(y)) == pytest.approx(height, abs=1e-3)
    assert (y > 0).sum() == (y < 0).sum()
    artery = meshio.read(sorted(folder.glob("paraview/artery_*.vtu"))[-1])
    assert x.max() > artery.points[:, 0].max()
    opened = meshio.read(folder / "paraview/jaws_001.vtu")
    outer = result.physiological.values["outer_radius_mm"]
    assert np.min(np.abs(opened.points[:, 1])) == pytest.approx(outer, abs=1e-3)


@pytest.mark.parametrize("jaw", ["cylinder-1mm", "flat-2mm", "rounded-3mm", "wide-nearly-flat"])
def test_outline_of_every_shipped_jaw_is_a_closed_curve_on_its_face(jaw):
    shape = jc.load_scene("human-lad", [f"clamp.jaw={jaw}"]).clamp.jaw
    curve = fields.jaw_outline(shape, 3.0)
    z, y = curve.T
    assert np.array_equal(curve[0], curve[-1])
    assert y.min() == pytest.approx(0.0, abs=1e-3)
    lower = y < 0.999 * y.max()
    gap = np.asarray(shape.gap((jnp.zeros(lower.sum()), jnp.asarray(y[lower]), jnp.asarray(z[lower]))))
    assert np.abs(gap).max() < 2e-3
    assert z.min() == pytest.approx(-z.max(), abs=1e-6)


def test_quadratic_elements_are_written_and_mirrored_too(tmp_path):
    scene = jc.load_scene(
        "human-lad",
        ["mesh.circumferential=2", "mesh.axial=2", "mesh.radial=[1, 1]", "mesh.element=q2p1"],
    )
    model = build_model(scene)
    far = jnp.asarray([100.0])
    x = closed_positions(model.mesh, scene.mesh, scene.artery)
    kept = types.SimpleNamespace(state=with_equilibrium_pressure(model.potential, x, far), model=model)
    fake = types.SimpleNamespace(
        model=model, scene=scene, load_free_like=lambda kept: kept, in_body_like=lambda kept: None
    )
    meshio.write(tmp_path / "a.vtu", paraview.artery_mesh(fake, kept))
    (block,) = meshio.read(tmp_path / "a.vtu").cells
    assert block.type == "hexahedron27"
    assert block.data.shape == (8 * model.mesh.n_cells, 27)
    for layer in map(fields.whole, fields.layer_fields(model, kept.state)):
        points, weights = layer.element.quadrature()
        tangents = np.einsum("qka,aci->qcki", layer.element.shape(points)[1], layer.points[layer.cells])
        J = np.linalg.det(tangents)
        assert J.min() > 0.0
        modelled = (weights @ J)[: model.mesh.layer_cells[0][1]].sum()
        assert (weights @ J).sum() == pytest.approx(8.0 * modelled)
    # corners, then edges: each of VTK's mid-edge points lies near the middle of its edge
    grid = model.mesh.element.node_grid[list(model.mesh.element.meshio_nodes)]
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    for number, (a, b) in enumerate(edges, start=8):
        assert np.array_equal(2 * grid[number], grid[a] + grid[b])


def test_an_artery_too_fine_to_show_whole_is_written_as_the_modelled_part(result, tmp_path, monkeypatch):
    monkeypatch.setattr(paraview, "LARGEST_WHOLE", 100)
    files = paraview.write_states(result, tmp_path)
    artery, jaws = meshio.read(files[0]), meshio.read(files[1])
    assert len(artery.cells[0].data) == result.model.mesh.n_cells
    assert volumes(artery.points, artery.cells[0].data)[1] > 0.0
    assert jaws.points[:, 1].min() > 0.0


# --------------------------------------------------------------------------------- any symmetry

SYMMETRIES = ("xyz", "xy", "xz", "yz", "x", "y", "z", "none")


@functools.cache
def pressed(symmetry: str, element: str = "q1p0"):
    """A result of one made-up flattened state, the same artery however much of it is modelled."""
    counts = ["mesh.circumferential=4", "mesh.axial=3", "mesh.radial=[2, 1]"]
    scene = jc.load_scene("human-lad", [*counts, f"mesh.symmetry={symmetry}", f"mesh.element={element}"])
    model = build_model(scene)
    x, y, z = closed_positions(model.mesh, scene.mesh, scene.artery).T
    near = jnp.exp(-((z / 3.0) ** 2))
    flat = jnp.stack([x * (1.0 + 0.2 * near), y * (1.0 - 0.5 * near), z * (1.0 + 1e-3 * x**2)], axis=1)
    load_free, last = (
        types.SimpleNamespace(
            state=with_equilibrium_pressure(
                model.potential, positions, rigid(1.1, model.discretisation.layout.n_rigid)
            ),
            values={"outer_radius_mm": 2.4},
            model=model,
        )
        for positions in (jnp.stack([x, y, z], axis=1), flat)
    )
    return types.SimpleNamespace(
        model=model,
        scene=scene,
        load_free=load_free,
        load_free_like=lambda kept: load_free,
        in_body_like=lambda kept: None,
        physiological=load_free,
        states=(load_free, last),
        closing=(load_free, last),
        history=[{"jaw_travel_mm": travel, "occlusion": 0.5 * travel} for travel in (0.0, 1.0)],
        converged=True,
        coarser=None,
    )


def layers_of(result) -> tuple[fields.LayerFields, ...]:
    return fields.layer_fields(result.model, result.closing[-1].state, result.load_free.state)


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_the_whole_artery_is_the_same_however_much_is_modelled(symmetry):
    eighth, result = pressed("xyz"), pressed(symmetry)
    assert 8 * eighth.model.mesh.n_cells == result.model.symmetry.parts * result.model.mesh.n_cells
    for few, many in zip(layers_of(eighth), layers_of(result), strict=True):
        expected, found = fields.whole(few), fields.whole(many)
        assert found.points.shape == expected.points.shape
        distance, place = KDTree(found.points).query(expected.points)
        assert distance.max() < 1e-9
        assert len(np.unique(place)) == len(place)
        assert set(found.point_data) == {*fields.STRESSES, "pressure_kPa", "contact_pressure_kPa"} | {
            "displacement_mm"
        }
        for name, values in expected.point_data.items():
            np.testing.assert_allclose(found.point_data[name][place], values, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(found.volumes[place], expected.volumes)
        assert few.volumes.sum() == pytest.approx(expected.volumes.sum() / 8.0)
        corners = list(found.element.meshio_nodes)
        sizes, least = volumes(found.points, found.cells[corners].T)
        assert least > 0.0
        assert sizes.sum() == pytest.approx(volumes(expected.points, expected.cells[corners].T)[0].sum())
        assert np.sort(found.cell_data["J"]) == pytest.approx(np.sort(expected.cell_data["J"]))


@pytest.mark.parametrize(
    ("symmetry", "element"), [*((symmetry, "q1p0") for symmetry in SYMMETRIES), ("x", "q2p1")]
)
def test_the_whole_grid_goes_from_end_to_end_and_round_from_the_fold(symmetry, element):
    result = pressed(symmetry, element)
    order = result.model.mesh.element.order
    for layer, cells in zip(layers_of(result), (2, 1), strict=True):
        grid = fields.whole_grid(layer)
        assert grid.points.shape == (2 * 3 * order + 1, 4 * 4 * order + 1, cells * order + 1, 3)
        assert np.array_equal(grid.points[:, 0], grid.points[:, -1])
        assert np.all(np.diff(grid.points[..., 2], axis=0) > 0.0)
        angle = np.degrees(np.unwrap(np.arctan2(grid.points[..., 1], grid.points[..., 0]), axis=1))
        assert np.all(np.diff(angle, axis=1) > 0.0)
        assert angle[:, [0, grid.line(1), grid.line(2), grid.line(3), -1]] == pytest.approx(
            np.broadcast_to(
                np.array([0, 90, 180, 270, 360])[:, None], (*angle[:, :5].shape[:2], cells * order + 1)
            ),
            abs=1e-9,
        )
        assert grid.points[grid.middle, ..., 2] == pytest.approx(0.0, abs=1e-12)
        # as many points as the cells have, each once: the grid repeats only the line on which it closes
        every = np.concatenate([grid.points[:, :-1].reshape(-1, 3), fields.whole(layer).points])
        assert len(np.unique(np.round(every, 9) + 0.0, axis=0)) == len(every) // 2
        for axis in range(3):  # moved outwards where it lies outside, on all sides
            moved = grid.point_data["displacement_mm"][..., axis]
            turned = moved * np.sign(np.round(grid.points[..., axis], 9)) * (-1.0 if axis == 1 else 1.0)
            assert turned.min() > -1e-9
            assert turned.max() > 0.01


@pytest.mark.parametrize("name", ["axial_stress_maps", "sections", "wall_stress"])
@pytest.mark.parametrize("symmetry", ["none", "xz", "z"])
def test_pictures_do_not_tell_how_much_is_modelled(symmetry, name):
    draw = getattr(plots, f"plot_{name}")
    expected, found = (_pixels(draw(each)) for each in (pressed("xyz"), pressed(symmetry)))
    assert expected.shape == found.shape
    assert expected.std() > 20.0
    assert np.mean(np.abs(expected - found).max(axis=-1) > 16.0) < 1e-3


@pytest.mark.parametrize("symmetry", ["xyz", "x", "none"])
def test_pictures_have_both_walls_and_every_peak(symmetry):
    result = pressed(symmetry)
    along = plots.plot_sections(result).axes[1]
    outlines = np.concatenate([patch.get_xy() for patch in along.patches])
    for mirror in ([1, -1], [-1, 1]):
        assert KDTree(outlines).query(outlines * mirror)[0].max() < 0.01
    for axes, layer in zip(plots.plot_axial_stress_maps(result).axes[::2], layers_of(result), strict=False):
        (crosses,) = [line.get_xydata() for line in axes.lines if line.get_marker() == "x"]
        assert KDTree(crosses).query(crosses * [-1, 1])[0].max() < 1e-9
        assert KDTree(crosses).query([0, 180] + crosses * [1, -1])[0].max() < 1e-9
        zoom = axes.get_xlim()[1]
        shown = np.abs(layer.points[:, 2]) <= zoom
        highest = np.argmax(np.where(shown, layer.point_data["axial_stress_kPa"], -np.inf))
        assert np.abs(np.abs(crosses[:, 0]) - np.abs(layer.points[highest, 2])).max() < 1e-9


def test_colours_are_not_stretched_by_a_fold_that_the_mesh_does_not_resolve():
    """A thousandth of the volume is beyond them, with an arrow and in words; a hundredth is not."""
    smooth, few = np.linspace(2.0, 38.0, 1000), np.array([-40.0, 61.36])
    values, weights = np.concatenate([smooth, few]), np.concatenate([np.ones(1000), [1.0, 1.0]])
    found = colours([values, smooth], [weights, np.ones(1000)], 5.0)
    assert found.limits == (0.0, 40.0)
    assert found.extremes == (-40.0, 61.36)
    assert found.beyond == "both"
    assert "\N{MINUS SIGN}40 to 61.4" in found.said("volume")
    assert "0.5th to 99.5th percentile by volume" in found.said("volume")
    all_of_it = colours([values], [np.concatenate([np.ones(1000), [10.0, 10.0]])], 5.0)
    assert all_of_it.limits == (-40.0, 65.0)
    assert (all_of_it.beyond, all_of_it.said("volume")) == ("neither", "")


def test_the_bar_of_a_stress_map_says_what_lies_beyond_it(monkeypatch):
    monkeypatch.setattr(style, "OUTSIDE", 0.1)
    bar = plots.plot_axial_stress_maps(pressed("xyz")).axes[-1]
    low, high = map(float, re.search(r"in all (\S+) to ([^;]+);", plain_minus(bar.get_ylabel())).groups())
    assert low < bar.get_ylim()[0] or high > bar.get_ylim()[1]
    assert "10th to 90th percentile by volume" in bar.get_ylabel()


def plain_minus(text: str) -> str:
    return text.replace("\N{MINUS SIGN}", "-")


def _pixels(figure) -> np.ndarray:
    """Red, green, blue and opacity from 0 to 255, (height, width, 4)."""
    figure.set_dpi(60)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba(), float)


@pytest.mark.parametrize(("symmetry", "jaws"), [("xyz", [0]), ("z", [0, 1])])
def test_files_of_the_modelled_part_show_the_jaws_that_are_modelled(symmetry, jaws):
    result = pressed(symmetry)
    drawn = paraview.jaw_mesh(result, result.closing[-1], 3.0, full=False)
    assert np.unique(drawn.cell_data["jaw"][0]).tolist() == jaws
    assert np.ptp(np.sign(drawn.points[:, 1])) == 2.0 * (len(jaws) - 1)


def test_a_report_of_a_half_says_so(result):
    half = jc.clamp(jc.replace(result.scene, "mesh.symmetry", "z"))
    text = page(half, [])
    assert "one half: the whole circumference by half the length" in text
    assert "eighth" not in text
    assert half.to_dict()["model"]["symmetry"] == "1/2"
    for figure in shown_in("numbers"):
        assert half.final[figure.key] == pytest.approx(result.final[figure.key], rel=1e-6), figure.key


# --------------------------------------------------------------------------------- figures and report


@pytest.mark.parametrize("name", FIGURES)
def test_figures_show_something(folder, name):
    image = matplotlib.image.imread(folder / "figures" / f"{name}.png")
    assert image.shape[0] > 400
    assert image.shape[1] > 900
    assert image[..., :3].std() > 0.08
    border = np.concatenate(
        [image[:2].reshape(-1, 4), image[-2:].reshape(-1, 4), image[:, :2].reshape(-1, 4)]
    )
    assert np.all(border[:, :3] > 0.95), "something is cut off at the edge"


def test_figures_leave_matplotlib_alone(result):
    from matplotlib import _pylab_helpers, rcParams

    before = dict(rcParams)
    for name in FIGURES:
        figure = getattr(result, f"plot_{name}")()
        assert figure.axes
        assert figure._repr_png_().startswith(b"\x89PNG")
    assert dict(rcParams) == before
    assert not _pylab_helpers.Gcf.figs


@pytest.mark.parametrize("name", FIGURES)
def test_long_names_of_layers_leave_a_figure_its_room(result, name):
    """Names of 200 characters are cut: nothing is pushed aside, and no warning (an error here) is given."""
    scene = result.scene
    for i in range(2):
        scene = jc.replace(scene, f"artery.layers[{i}].name", str(i) * 200)
    model = dataclasses.replace(result.model, scene=scene)
    states = tuple(dataclasses.replace(kept, model=model) for kept in result.states)
    renamed = dataclasses.replace(result, model=model, states=states)
    images = [_pixels(getattr(r, f"plot_{name}")()) for r in (result, renamed)]
    assert images[0].shape == images[1].shape
    inked = [np.ptp(np.nonzero((image[..., :3] < 128).any(axis=-1))[1]) for image in images]
    assert inked[1] > 0.9 * inked[0]


class Page(HTMLParser):
    """Tags in order, and links to anything."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("src", "href", "data", "action")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_report_stands_alone(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    parsed = Page(text)
    assert parsed.open == []
    assert parsed.tags.count("img") == len(FIGURES)
    assert all(link.startswith("data:image/png;base64,") for link in parsed.links)
    assert not {"script", "link", "iframe", "object"} & set(parsed.tags)
    assert "://" not in text
    assert "url(" not in text
    assert not re.search(r"\b(nan|None|inf)\b", re.sub(r"base64,[^\"]*", "", text))
    for said in (
        "Human LAD between two cylinders",
        "negative pivots",
        "opening_angle_deg",
        "newton iterations",
    ):
        assert said in text


def test_report_escapes_what_it_is_told(result):
    nasty = '<script>alert("1")</script> & co'
    scene = jc.replace(result.scene, "title", nasty)
    text = page(dataclasses.replace(result, model=dataclasses.replace(result.model, scene=scene)), [])
    assert "<script" not in text
    assert "&lt;script&gt;" in text
    assert Page(text).open == []


def test_report_can_be_written_alone(result, tmp_path):
    path = write_report(result, tmp_path / "report.html")
    assert Page(path.read_text(encoding="utf-8")).tags.count("img") == len(FIGURES)


# --------------------------------------------------------------------------------- what did not converge


@pytest.mark.parametrize("kept", [0, 1, 2, 5])
def test_whatever_converged_is_written(result, tmp_path, kept):
    failure = EquilibriumError(
        "clamping", "beyond occlusion 12 %", NotConverged("cut", 1.0, 0.5), "refine the mesh"
    )
    files = export.write_outputs(
        dataclasses.replace(result, states=result.states[:kept], failure=failure), tmp_path
    )
    assert set(files) == files_below(tmp_path)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["converged"] is False
    assert len(list(tmp_path.glob("paraview/artery_*.vtu"))) == kept
    assert len(list(tmp_path.glob("figures/*.png"))) == (0, 1, 6, 6)[min(kept, 3)]
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "The stop was not reached" in text
    assert "refine the mesh" in text


def test_shown_states_are_spread_evenly_and_few():
    assert fields.spread([0.0], 6) == [0]
    assert fields.spread([0.0, 1.0], 6) == [0, 1]
    assert fields.spread([0.0, 0.1, 1.0, 2.1, 2.9, 4.0, 4.6, 5.0], 6) == [0, 2, 3, 4, 5, 7]
    assert fields.spread([0.0, 0.0, 1.0, 1.0, 1.0], 3) == [0, 4]
    assert len(fields.spread([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 5.0], 6)) == 6


def test_figures_that_need_more_states_say_so(result):
    only = dataclasses.replace(result, states=result.states[:1])
    only.plot_wall_stress()
    for name in FIGURES[:-1]:
        with pytest.raises(ValueError, match="did not converge"):
            getattr(only, f"plot_{name}")()


# --------------------------------------------------------------------------------- all or nothing


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files_below(folder)}


def full_disk(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    "stage", ["meshio.write", "jaxclamp.show.report.page", "jaxclamp.show.export.history_csv"]
)
def test_a_full_disk_leaves_nothing_behind(result, tmp_path, monkeypatch, stage):
    monkeypatch.setattr(stage, full_disk)
    with pytest.raises(OSError, match="No space left"):
        export.write_outputs(result, tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_or_an_interruption_leaves_earlier_results_as_they_were(result, tmp_path, monkeypatch):
    few = dataclasses.replace(result, states=result.states[:2])
    export.write_outputs(few, tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    before = snapshot(tmp_path)

    def interrupt(*args):
        raise KeyboardInterrupt

    for failing in (full_disk, interrupt):
        monkeypatch.setattr("jaxclamp.show.export.as_json", failing)
        with pytest.raises((OSError, KeyboardInterrupt)):
            export.write_outputs(few, tmp_path)
        assert snapshot(tmp_path) == before
        assert not list(tmp_path.glob(".*"))


def test_an_earlier_result_with_more_states_is_replaced_as_a_whole(result, folder, tmp_path):
    export.write_outputs(result, tmp_path)
    mine = {tmp_path / name for name in ("notes.txt", "figures/photo.png", "paraview/artery_mine.vtu")}
    for path in mine:
        path.write_text("mine")
    files = export.write_outputs(dataclasses.replace(result, states=result.states[:1]), tmp_path)
    assert files_below(tmp_path) == {*files, *mine}
    assert len(list(tmp_path.glob("paraview/*.vtu"))) == 2 + 1
    assert len(list(tmp_path.glob("figures/*.png"))) == 1 + 1


def test_files_of_others_stay_where_no_earlier_result_is(result, tmp_path):
    for name in ("scene.toml", "README.md", "jaw.stl"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(FileExistsError, match=f"{name}, which is not of a run of jaxclamp"):
            export.write_outputs(result, tmp_path)
        assert snapshot(tmp_path) == {name: b"mine"}
        (tmp_path / name).unlink()


def test_a_file_in_place_of_the_folder_is_refused(result, tmp_path):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(OSError, match="taken"):
        export.write_outputs(result, tmp_path / "taken")
    assert snapshot(tmp_path) == {"taken": b"mine"}


def test_progress_is_told(result, tmp_path):
    events = []
    export.write_outputs(dataclasses.replace(result, states=result.states[:2]), tmp_path, events.append)
    fractions = [event.fraction for event in events]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert {event.stage for event in events} == {"writing"}
