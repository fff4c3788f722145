"""A result in a file: the same to the last bit when it is read back, and safe to read whoever wrote it."""

from __future__ import annotations

import dataclasses
import io
import json
import struct

import cloudpickle
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxclamp as jc
from jaxclamp.core.records import record, withdraw
from jaxclamp.physics.jaws import Cylinder, Jaw
from jaxclamp.pictures.plots import figures, png
from jaxclamp.potential.model import build_model
from jaxclamp.solve import loading, nested
from jaxclamp.solve.saving import HEADER, Header, digest

SMALL = ("mesh.circumferential=3", "mesh.axial=6", "mesh.radial=[2, 1]", "stop.occlusion=0.4")
NESTED = ("mesh.circumferential=6", "mesh.axial=9", "mesh.radial=[3, 2]", "stop.occlusion=0.6")


@pytest.fixture(scope="module")
def small():
    return jc.clamp(jc.load_scene("human-lad", SMALL))


@pytest.fixture(scope="module")
def saved(small, tmp_path_factory):
    """The file of `small`; for reading only."""
    return small.save(tmp_path_factory.mktemp("saved") / "run.h5")


@pytest.fixture(scope="module")
def walked():
    """A result whose path was walked on a coarser mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nested, "LEAST_CELLS", 60)
        return jc.clamp(jc.load_scene("human-lad", NESTED))


def same(a, b) -> bool:
    """True if two records hold the same bits; models count as their scenes, factors and times as nothing."""
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        if hasattr(a, "discretisation"):
            return a.scene == b.scene and same(a.potential, b.potential)
        names = [f.name for f in dataclasses.fields(a) if f.name not in ("factors", "failure")]
        return type(a) is type(b) and all(same(getattr(a, n), getattr(b, n)) for n in names)
    if isinstance(a, jax.Array | np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def test_everything_comes_back_to_the_last_bit(walked, tmp_path):
    path = walked.save(tmp_path / "run.h5")
    again = jc.load_result(path)
    assert walked.coarser is not None
    assert same(walked, again)
    assert again.to_dict() == walked.to_dict()
    assert again.coarser.to_dict() == walked.coarser.to_dict()
    # as before, states of the path are those of the coarser result, on its model
    assert [k.model is again.model for k in again.states] == [k.model is walked.model for k in walked.states]
    assert all(k in again.coarser.states for k in again.states if k.model is not again.model)
    assert again.load_free_like(again.states[3]) is again.coarser.load_free


def test_measures_and_pictures_are_the_same(small, saved):
    again, force = jc.load_result(saved), jc.clamp_force()
    assert small.measure(force) == again.measure(force)
    assert png(small.plot_sections()) == png(again.plot_sections())


@pytest.mark.slow
def test_errors_and_all_else_are_the_same_with_a_path_on_a_coarser_mesh(walked, tmp_path):
    known = jc.with_errors(walked)
    again = jc.load_result(known.save(tmp_path / "run.h5"))
    assert again.errors == known.errors
    peak = jc.smooth_peak_axial_stress("media")
    for measure in (peak, jc.physiological_lumen_radius()):
        assert jc.value_and_gradient(walked, measure) == jc.value_and_gradient(again, measure)
    assert jc.neighbours(again).estimates([peak]) == jc.neighbours(walked).estimates([peak])
    assert jc.with_errors(again).errors == known.errors
    for before, after in zip(figures(walked), figures(again), strict=True):
        assert png(before.figure) == png(after.figure), before.name


def test_a_loaded_result_starts_a_neighbour(small, saved):
    wider = jc.replace(small.scene, "clamp.jaw.radius", 3.1)
    near = jc.clamp(wider, guess=jc.load_result(saved))
    assert near.final["clamp_force_N"] == pytest.approx(jc.clamp(wider).final["clamp_force_N"], rel=1e-7)


def test_a_failure_comes_back_with_its_sentence_and_what_converged(tmp_path):
    scene = jc.load_scene("human-lad", [*SMALL[:3], "stop.force_N=1e3"])
    with pytest.raises(jc.EquilibriumError) as caught:
        jc.clamp(scene)
    again = jc.load_result(caught.value.result.save(tmp_path / "failed.h5"))
    assert not again.converged
    assert str(again.failure) == str(caught.value)
    assert again.failure.result is again
    travelled = cloudpickle.loads(cloudpickle.dumps(caught.value))
    assert (str(travelled), travelled.result) == (str(caught.value), None)
    assert travelled.history == again.history
    assert [record["stage"] for record in travelled.history][:2] == ["physiological", "clamping"]
    assert again.to_dict() == caught.value.result.to_dict()
    with pytest.raises(jc.EquilibriumError, match="no equilibrium in stage 'clamping'"):
        again.measure(jc.clamp_force())


def test_numbers_that_no_scene_file_holds_come_back(small, tmp_path):
    """Constants of each point, and an angle that is no multiple of a degree's float."""
    scene = jc.replace(small.scene, "artery.layers[1].opening_angle", 2.0943951023931953)
    points = small.model.potential.layers[0].solid.dV.shape
    c = 27.0 + jnp.linspace(0.0, 1.0, int(np.prod(points))).reshape(points)
    scene = jc.replace(scene, "artery.layers[0].material.c", c)
    model = build_model(scene)
    states = tuple(dataclasses.replace(kept, model=model) for kept in small.states)
    result = dataclasses.replace(small, model=model, states=states)
    again = jc.load_result(result.save(tmp_path / "body.h5"))
    assert again.scene == scene
    assert same(result, again)


@record
class Bar(Cylinder):
    """A jaw of a user's own file."""

    shape: str = jc.static("bar of a user")


def test_a_jaw_of_ones_own_is_known_once_it_is_imported(small, tmp_path, monkeypatch):
    scene = jc.replace(small.scene, "clamp.jaw", Bar(radius=3.0))
    path = dataclasses.replace(small, model=dataclasses.replace(small.model, scene=scene)).save(
        tmp_path / "r"
    )
    assert jc.load_result(path).scene == scene
    monkeypatch.setattr(loading, "loads_scene", _without(Bar, loading.loads_scene))
    with pytest.raises(
        jc.SceneError, match=r"jaw.shape = \"bar of a user\".*\(made with 'Bar' of .*known once imported\)$"
    ):
        jc.load_result(path)


OWN = """
import jaxclamp as jc
from jaxclamp.physics.jaws import Cylinder

@jc.record
class Bar(Cylinder):
    shape: str = jc.static("bar of a file")

    def half_extent(self):
        return 1.0 * self.radius
"""


def test_a_part_that_was_edited_is_refused(small, tmp_path):
    """Its states are of the part as it was. A file that has only moved is the same."""
    file, moved = tmp_path / "saved_parts.py", tmp_path / "saved_parts_moved.py"
    file.write_text(OWN)
    first = jc.import_parts(file)
    scene = jc.replace(small.scene, "clamp.jaw", first.Bar(radius=3.0))
    model = dataclasses.replace(small.model, scene=scene)
    states = tuple(dataclasses.replace(kept, model=model) for kept in small.states)
    path = dataclasses.replace(small, model=model, states=states).save(tmp_path / "r")
    assert jc.load_result(path).scene == scene
    file.write_text(OWN.replace("1.0 *", "0.5 *"))
    second = jc.import_parts(file)
    said = refused(path)
    assert "found 'Bar' of " in said
    assert said.endswith(": import their file as it was then, or clamp the scene again")
    withdraw(second.Bar)
    moved.write_text(OWN)
    third = jc.import_parts(moved)
    assert type(jc.load_result(path).scene.clamp.jaw) is third.Bar
    withdraw(third.Bar)
    assert "which is known once imported)" in refused(path)


def _without(jaw, loads_scene):
    """The reader in a process that has not imported a jaw."""

    def read(*args):
        with pytest.MonkeyPatch.context() as patch:
            others = [cls for cls in jc.scenes.schema.concrete_subclasses(Jaw) if cls is not jaw]
            known = jc.scenes.schema.concrete_subclasses
            patch.setattr(
                jc.scenes.schema, "concrete_subclasses", lambda base: others if base is Jaw else known(base)
            )
            return loads_scene(*args)

    return read


# --- what is no such file -------------------------------------------------------------------------------


def refused(path) -> str:
    with pytest.raises(jc.SceneError) as caught:
        jc.load_result(path)
    said = str(caught.value)
    assert "\n" not in said
    assert said.isprintable()
    assert said.startswith(str(path))
    return said


def test_files_that_are_none_are_refused_in_one_sentence(saved, tmp_path):
    assert "there is no such file" in refused(tmp_path / "none.h5")
    assert "cannot be read" in refused(tmp_path)
    other = tmp_path / "other"
    for content in (b"", b"title = 'a scene'\n", bytes(range(256)) * 9, saved.read_bytes()[HEADER:]):
        other.write_bytes(content)
        assert "found another kind of file" in refused(other)


def test_damage_is_seen_wherever_it_is(saved, tmp_path):
    content, damaged = saved.read_bytes(), tmp_path / "damaged.h5"
    for place in np.linspace(0, len(content) - 1, 60).astype(int):
        flipped = bytearray(content)
        flipped[place] ^= 4
        damaged.write_bytes(flipped)
        if place > HEADER:
            assert "the file is damaged" in refused(damaged)
    for end in (HEADER // 2, HEADER, len(content) // 2, len(content) - 1):
        damaged.write_bytes(content[:end])
        assert "damaged" in refused(damaged) or end < HEADER


def test_another_version_is_named(saved, tmp_path):
    content, other = saved.read_bytes(), tmp_path / "other.h5"
    header = Header.of(content)
    for changed in ({"version": "99.1.0"}, {"layout": 99}):
        other.write_bytes(dataclasses.replace(header, **changed).to_bytes() + content[HEADER:])
        assert "saved by jaxclamp" in refused(other)
        assert "clamp its scene again" in refused(other)
    patch = ".".join([*header.version.split(".")[:2], "99+0123abcd"])
    other.write_bytes(dataclasses.replace(header, version=patch).to_bytes() + content[HEADER:])
    assert jc.load_result(other).converged


def forged(saved, path, change) -> str:
    """What is said of a file whose inside a stranger changed, with a digest to match."""
    content = saved.read_bytes()
    buffer = io.BytesIO(content)
    with h5py.File(buffer, "r+") as file:
        change(file)
    inside = buffer.getvalue()[HEADER:]
    header = dataclasses.replace(Header.of(content), digest=digest(inside))
    path.write_bytes(header.to_bytes() + inside)
    return refused(path)


def _put(group, name, **options):
    del group[name]
    return group.create_dataset(name, **options)


def _relink(group, name, link):
    del group[name]
    group[name] = link


def _edit(group, **changes):
    plain = json.loads(group["plain"].asstr()[()])
    _put(group, "plain", data=json.dumps(plain | changes))


FORGERIES = {
    "a link to another file": lambda f: _relink(
        f["states/0"], "responses", h5py.ExternalLink("/etc/x", "/a")
    ),
    "a link to elsewhere": lambda f: _relink(
        f["states/0"], "responses", h5py.SoftLink("/states/1/responses")
    ),
    "data of another file": lambda f: _put(
        f["states/0/state"], "x", shape=(4,), dtype="f8", external=[("/etc/hostname", 0, 32)]
    ),
    "no list of own parts": lambda f: _put(f["scenes/0"], "own_parts", data="[1]"),
    "a part of a stranger": lambda f: _put(
        f["scenes/0"], "own_parts", data=json.dumps([{"part": "\n" * 999, "from": "\a", "sha256": "\a"}])
    ),
    "a circle": lambda f: _relink(f["states/0"], "lin", f["states"]),
    "terabytes of nothing": lambda f: _put(f["states/0/state"], "x", shape=(10**12, 3), dtype="f8"),
    "packed terabytes": lambda f: _put(
        f["states/0/state"], "x", shape=(10**12, 3), dtype="f8", compression="gzip", chunks=(1000, 3)
    ),
    "another shape": lambda f: _put(f["states/0/state"], "x", data=np.zeros((2, 3))),
    "an object": lambda f: _put(f["states/0/state"], "x", data=np.zeros(3, np.complex128)),
    "no state": lambda f: f.pop("states/1"),
    "no such state": lambda f: _edit(f["results/0"], states=[0, 99]),
    "a text for a number": lambda f: _edit(
        f["states/0"],
        equilibrium=json.loads(f["states/0/plain"].asstr()[()])["equilibrium"] | {"pressure": "1"},
    ),
    "no result": lambda f: f.pop("results/0"),
    "a failure of two words": lambda f: _edit(f["results/0"], failure=["a", "b"]),
    "a list for a table": lambda f: _put(f["results/0"], "plain", data="[1]"),
    "brackets": lambda f: _put(f["results/0"], "plain", data="[" * 100_000),
    "another scene": lambda f: _put(f["scenes/0"], "toml", data="title = 3"),
    "a number out of range": lambda f: _put(f["scenes/0/floats"], "artery.pressure", data=-1.0),
}


@pytest.mark.parametrize("what", FORGERIES)
def test_what_a_stranger_forges_is_refused_in_one_sentence(what, saved, tmp_path):
    assert "expected" in forged(saved, tmp_path / "f.h5", FORGERIES[what])


def test_a_file_is_written_whole_or_not_at_all(small, tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    path.write_text("mine")
    monkeypatch.setattr("os.replace", lambda a, b: (_ for _ in ()).throw(OSError("no room")))
    with pytest.raises(OSError, match="no room"):
        small.save(path)
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


def test_other_programs_read_the_states(small, saved):
    with h5py.File(saved) as file:
        x = file["states/0/state/x"][()]
        assert file["scenes/0/floats/clamp.jaw.radius"][()] == 3.0
        assert jc.scenes.files.loads_scene(file["scenes/0/toml"].asstr()[()]) == small.scene
    assert np.array_equal(x, small.load_free.state.x)
    assert struct.unpack("8s", saved.read_bytes()[HEADER : HEADER + 8])[0] == b"\x89HDF\r\n\x1a\n"


# --- the history as a table -----------------------------------------------------------------------------


def test_history_table_has_a_column_for_each_number(small):
    table = small.history_table()
    assert {len(column) for column in table.values()} == {len(small.history)}
    assert table["stage"].tolist() == [record["stage"] for record in small.history]
    assert table["clamp_force_N"].dtype == float
    assert table["clamp_force_N"][-1] == small.final["clamp_force_N"]
    media = [record["peak_axial_stress_kPa"]["media"] for record in small.history]
    assert table["peak_axial_stress_kPa.media"].tolist() == media
    z = small.final["peak_axial_stress_location_mm"]["media"][2]
    assert table["peak_axial_stress_location_mm.media.z"][-1] == z
    assert all(column.ndim == 1 and column.dtype != object for column in table.values())


def test_a_result_and_its_states_are_shown_in_a_line(small):
    force = f"{small.final['clamp_force_N']:.3g}"
    assert repr(small) == (
        f"<Result of 'Human LAD between two cylinders': {len(small.states)} states, occlusion 40.0%, "
        f"jaw force {force} N; numerical errors: not estimated, see jaxclamp.with_errors>"
    )
    assert repr(dataclasses.replace(small, errors={})).endswith("numerical errors: in .errors>")
    assert repr(small.states[-1]) == f"<clamping state: occlusion 40.0%, jaw force {force} N>"
    assert len(repr(small.states)) < 100 * len(small.states)
