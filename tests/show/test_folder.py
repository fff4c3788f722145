"""The rest of a folder of results, as its user reads it: jaw, drawings, scene, what it says of itself."""

import csv
import dataclasses
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from test_outputs import COARSE

import jaxclamp as jc
from jaxclamp.core.parts import own_parts
from jaxclamp.core.records import record
from jaxclamp.physics.jaws import Cylinder
from jaxclamp.scenes import schema
from jaxclamp.show import jaw as jaw_files
from jaxclamp.show.readme import about
from jaxclamp.trust.estimates import SOURCES

meshio = pytest.importorskip("meshio")

JAWS = (
    "cylinder-1mm",
    "flat-2mm",
    "wide-nearly-flat",
    "{ shape = 'flat', half_width_mm = 1.0, edge_radius_mm = 0.02 }",
    # straight towards its ends, so that its sides tilt
    "{ shape = 'spline', half_width_mm = 2.0, slopes = [0.0, 0.2, 0.3, 0.3], edge_radius_mm = 0.5 }",
    # two valleys: no other polygon here is concave
    "{ shape = 'spline', half_width_mm = 2.0, slopes = [0.5, -0.3, 0.6, -0.2, 0.4], edge_radius_mm = 0.3 }",
)


@pytest.fixture(scope="module")
def result():
    return jc.clamp(jc.load_scene("human-lad", [*COARSE, "stop.occlusion=0.3"]))


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    """What `result.write` leaves; for reading only."""
    target = tmp_path_factory.mktemp("folder") / "lad"
    files = result.write(str(target))
    assert set(files) == {path for path in target.rglob("*") if path.is_file()}
    return target


# --- the jaw ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=JAWS)
def written(request, tmp_path_factory):
    """A jaw with its two files."""
    shape = jc.load_scene("human-lad", [f"clamp.jaw={request.param}"]).clamp.jaw
    return shape, *jaw_files.write_jaw(shape, 5.0, 4.0, tmp_path_factory.mktemp("jaw"))


def gap_and_slope(jaw, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gap at points (n, 3), mm, and its gradient by central differences, (n, 3)."""
    gap = lambda p: np.asarray(jaw.gap(tuple(map(jnp.asarray, p.T))))
    steps = 1e-6 * np.eye(3)
    return gap(points), np.stack([(gap(points + s) - gap(points - s)) / 2e-6 for s in steps], axis=1)


def test_the_profile_is_on_the_face_in_order(written):
    jaw, path, _ = written
    with path.open(newline="") as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    z, y = (np.array([row[key] for row in rows]) for key in ("z_mm", "y_mm"))
    gap, _ = gap_and_slope(jaw, np.stack([0.0 * z, y, z], axis=1))
    assert np.abs(gap).max() < 1e-6
    assert y.min() == pytest.approx(0.0, abs=1e-6)
    assert z.max() == pytest.approx(-z.min(), abs=1e-3)
    lowest = int(np.argmin(np.hypot(z, y)))
    assert z[lowest] == pytest.approx(0.0, abs=0.02 * z.max())
    assert np.all(np.diff(z[lowest - 20 : lowest + 20]) > 0.0)  # from the one side to the other
    assert np.hypot(np.diff(z), np.diff(y)).max() < 0.1 * y.max()


def test_the_solid_is_closed_with_its_normals_outwards(written):
    jaw, _, path = written
    mesh = meshio.read(path)
    (block,) = mesh.cells
    assert block.type == "triangle"
    edges = np.concatenate([block.data[:, [i, (i + 1) % 3]] for i in range(3)])
    there, back = ({tuple(edge) for edge in each.tolist()} for each in (edges, edges[:, ::-1]))
    assert len(there) == len(edges)
    assert there == back
    a, b, c = (mesh.points[block.data[:, i]].astype(float) for i in range(3))
    normal = np.cross(b - a, c - a)
    assert np.sum(a * normal) / 6.0 > 0.0  # the volume
    x, y, z = ((a + b + c) / 3.0).T
    on_face = (np.abs(np.abs(x) - 4.0) > 1e-3) & (y < 0.9 * mesh.points[:, 1].max())
    gap, slope = gap_and_slope(jaw, np.stack([x, y, z], axis=1)[on_face])
    assert np.abs(gap).max() < 2e-3
    size = np.linalg.norm(normal[on_face], axis=1)
    assert np.min(np.linalg.norm(normal, axis=1)) > 0.0
    assert np.min(np.sum(normal[on_face] * slope, axis=1) / size) > 0.9
    assert np.abs(mesh.points[:, 0]).max() == pytest.approx(4.0)


def test_the_volume_is_that_of_the_section():
    """A bar of 1 mm radius, 8 mm long, as a polygon: pi r**2 l, less a little."""
    bar = jc.load_scene("human-lad", ["clamp.jaw=cylinder-1mm"]).clamp.jaw
    points, triangles = jaw_files.solid(jaw_files.profile(bar, 5.0)[1], 4.0)
    a, b, c = (points[triangles[:, i]] for i in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6.0
    assert volume == pytest.approx(8.0 * np.pi, rel=1e-3)
    assert volume < 8.0 * np.pi


def test_the_jaw_of_a_run_is_the_scenes(folder, result):
    z, y = np.loadtxt(folder / "jaw.csv", delimiter=",", skiprows=1).T
    assert np.hypot(z, y - 3.0) == pytest.approx(3.0, abs=1e-5)
    assert float(result.scene.clamp.jaw.radius) == 3.0
    artery = meshio.read(sorted(folder.glob("paraview/artery_*.vtu"))[-1])
    assert meshio.read(folder / "jaw.stl").points[:, 0].max() > artery.points[:, 0].max()


# --- figures, scene, text -----------------------------------------------------------------------------------


def test_figures_are_drawings_too(folder):
    for path in folder.glob("figures/*.png"):
        root = ET.parse(path.with_suffix(".svg")).getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > 20
    assert len(list(folder.glob("figures/*.svg"))) == 6


def test_the_scene_is_in_both_files(folder, result):
    """Each alone repeats the run."""
    in_json = json.loads((folder / "result.json").read_text())["scene"]
    assert schema.read(jc.Scene, in_json) == result.scene
    assert jc.load_scene(folder / "scene.toml") == result.scene


@record
class Spot(Cylinder):
    """A jaw of a user's own."""

    shape: str = jc.static("spot")


def test_scenes_of_ones_own_are_written_too(result, tmp_path, monkeypatch):
    """With a jaw of another file; and with constants of each point, which no scene file holds."""
    monkeypatch.setattr("jaxclamp.pictures.plots.figures", lambda result: ())
    for path, value in (
        ("clamp.jaw", Spot(radius=3.0)),
        ("artery.layers[0].material.c", 27.0 + jnp.zeros((8, 48))),
    ):
        scene = jc.replace(result.scene, path, value)
        model = dataclasses.replace(result.model, scene=scene)
        changed = dataclasses.replace(result, model=model, states=result.states[:2])
        changed.write(tmp_path)
        content = json.loads((tmp_path / "result.json").read_text())["scene"]
        text = (tmp_path / "report.html").read_text()
        if path == "clamp.jaw":
            assert content["clamp"]["jaw"] == {"shape": "spot", "radius_mm": 3.0}
            assert jc.load_scene(tmp_path / "scene.toml") == scene
        else:
            assert content is None
            assert not (tmp_path / "scene.toml").exists()  # that of the other result is gone
            assert "a scene file holds one number there" in text


def test_the_folder_says_what_lies_in_it(folder):
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert text.startswith("# Human LAD between two cylinders\n")
    assert "1 media, 2 adventitia" in text
    assert text.endswith(about())
    for path in folder.iterdir():
        assert path.name in text or path.is_dir() or path.name == "README.md", path.name


def test_every_field_is_explained_and_no_other(folder):
    mesh = meshio.read(folder / "paraview/artery_002.vtu")
    fields = {re.sub("layer_.*", "layer_NAME", name) for name in (*mesh.point_data, *mesh.cell_data)}
    rows = [line for line in about().split("## Fields")[1].splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall("`(.*?)`", row.split(" | ")[0])} == fields
    for row in rows:
        names, where, *_ = row.split(" | ")
        for name in re.findall("`(.*?)`", names):
            data = mesh.point_data if where == "points" else mesh.cell_data
            assert any(each == name or name == "layer_NAME" for each in data), row


def keys(text: str) -> list[str]:
    """What stands between backticks."""
    return re.findall("`(.*?)`", text)


def test_every_key_of_the_result_is_explained_and_no_other(folder, result):
    content = json.loads((folder / "result.json").read_text())
    whole, record = (
        about().split("## What result.json holds")[1].split("## Fields")[0].split("A record holds")
    )
    rows = {keys(row)[0]: keys(row)[1:] for row in whole.splitlines() if row.startswith("| `")}
    assert list(rows) == list(content)
    for key in ("load_free", "physiological", "model", "solver", "cost"):
        assert rows[key] == list(content[key]), key
    assert result.errors is None
    assert rows["errors"] == ["value", "error", *SOURCES]
    assert rows["own_parts"] == [*own_parts(Spot(radius=1.0))[0]]
    assert all(name in whole for name in content["versions"])
    names = [
        name for row in record.splitlines() if row.startswith("| `") for name in keys(row.split(" | ")[0])
    ]
    final = {f"{n}.LAYER" if isinstance(v, dict) else n for n, v in content["final"].items()}
    assert sorted(names) == sorted(final)


def test_the_page_of_the_docs_says_the_same():
    page = Path(__file__).parents[2] / "docs" / "outputs.md"
    assert about() in page.read_text(encoding="utf-8")
