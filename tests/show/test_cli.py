"""The command line: exit codes, one sentence for a mistake, and nothing else on standard output."""

import dataclasses
import errno
import json
import math
import os
import signal
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

from jaxclamp.cli import main
from jaxclamp.core.failures import EquilibriumError, NoReference, NotConverged, SceneError
from jaxclamp.scenes import schema
from jaxclamp.scenes.fidelity import mesh_for
from jaxclamp.scenes.files import load_scene
from jaxclamp.scenes.notes import notes
from jaxclamp.scenes.presets import presets
from jaxclamp.scenes.scene import MeshSettings
from jaxclamp.show import console
from jaxclamp.show import export as real_export

FIGURES = {
    "title": "Human LAD",
    "converged": True,
    "physiological": {"lumen_radius_mm": 2.5123},
    "final": {
        "occlusion": 0.925,
        "clamp_force_N": 0.4789,
        "lumen_height_mm": None,
        "max_penetration_mm": math.nan,
        "peak_axial_stress_kPa": {"media": 41.23, "adventitia": 39.9},
    },
}


@dataclasses.dataclass
class FakeResult:
    """What the command needs of a result."""

    converged: bool = True
    failure: Exception | None = None
    solver: dict = dataclasses.field(default_factory=lambda: {"branch": "the closing path"})

    def to_dict(self):
        return FIGURES | {"converged": self.converged}


def failed():
    return EquilibriumError(
        "clamping", "beyond 91 % occlusion", NotConverged("cut", 1.0, 0.2), "refine the mesh"
    )


class Elsewhere(FakeResult):
    """A result that is another equilibrium than the closing path's."""

    def to_dict(self):
        return super().to_dict() | {"solver": {"branch": "another equilibrium: unstable"}}


class Engine:
    """Stands in for clamping and export: records what it was asked."""

    def __init__(self):
        self.scenes, self.written = [], []
        self.outcome = FakeResult()
        self.write_error = None

    def clamp(self, scene, *, guess=None, progress=None):
        self.scenes.append(scene)
        if callable(progress):
            for stage in ("load-free", "clamping"):
                for step in range(101):
                    event = types.SimpleNamespace(stage=stage, fraction=step / 100, message="[b]step[/b]")
                    progress(event)
        if isinstance(self.outcome, BaseException):
            raise self.outcome
        return self.outcome

    def describe(self, scene):
        return {
            "symmetry": "1/8",
            "modelled": "one eighth",
            "layers": ["media", "adventitia"],
            "terms": [("wall", "always")],
            "unknowns": 4266,
            "predicted_seconds": 3.0,
            "warnings": [],
        }

    def write_outputs(self, result, folder, progress=None):
        if self.write_error is not None:
            raise self.write_error
        folder.mkdir(parents=True, exist_ok=True)
        names = ("result.json", "figure.png", "report.html")
        for name in names:
            (folder / name).write_text(json.dumps({"converged": result.converged, "versions": {}}))
        return [folder / name for name in names]


@pytest.fixture
def engine(monkeypatch, tmp_path):
    """The command line with a stand-in for the solver, in an empty folder."""
    fake = Engine()
    clamping, export = types.ModuleType("clamping"), types.ModuleType("export")
    clamping.clamp, export.write_outputs = fake.clamp, fake.write_outputs
    errors = types.ModuleType("estimates")
    errors.with_errors = lambda result: result
    monkeypatch.setitem(sys.modules, "jaxclamp.trust.estimates", errors)
    monkeypatch.setattr("jaxclamp.show.description.describe", fake.describe)
    monkeypatch.setitem(sys.modules, "jaxclamp.solve.clamping", clamping)
    monkeypatch.setitem(sys.modules, "jaxclamp.show.export", export)
    monkeypatch.chdir(tmp_path)
    return fake


def call(capsys, *arguments):
    code = main(arguments)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def command(*arguments, cwd):
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, "-m", "jaxclamp", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def everything_below(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


# ------------------------------------------------------------------------------------- run


def test_run_warns_of_another_equilibrium(engine, capsys):
    engine.outcome = Elsewhere()
    code, out, err = call(capsys, "run", "human-lad", "--quiet", "--json")
    assert code == 0
    assert json.loads(out)["solver"]["branch"] == "another equilibrium: unstable"
    assert "jaxclamp: warning: another equilibrium: unstable\n" in err
    engine.outcome = FakeResult()
    assert call(capsys, "run", "human-lad", "--quiet")[2] == ""


class Noted(FakeResult):
    """A result with a note on its scene and one on its states."""

    def to_dict(self):
        scene = load_scene("human-lad", ["artery.pressure_kPa=100"])
        return super().to_dict() | {"notes": [*notes(scene), "J is far from 1"]}


def test_run_notes_what_is_unlikely_once(engine, capsys):
    engine.outcome = Noted()
    command = ["run", "human-lad", "--set", "artery.pressure_kPa=100", "--json"]
    code, _, err = call(capsys, *command)
    told = [line for line in err.splitlines() if line.startswith("note: ")]
    assert code == 0
    assert told[0].startswith("note: artery.pressure_kPa = 100 is far from")
    assert told[1:] == ["note: J is far from 1"]
    assert err.index(told[0]) < err.index("load-free:") < err.index(told[1])
    assert call(capsys, *command, "--quiet")[2] == ""


def test_run_writes_beside_us_and_says_what_to_open(engine, capsys, tmp_path):
    code, out, err = call(capsys, "run", "human-lad")
    assert code == 0
    assert everything_below(tmp_path / "human-lad-result") == ["figure.png", "report.html", "result.json"]
    assert out.index("report.html") < out.index("result.json")
    assert "figure.png" not in out
    assert "clamp force" in out
    assert "0.4789 N" in out
    assert "peak axial stress, adventitia" in out
    assert "load-free:   0%" in err
    assert "clamping: 100%" in err


def test_run_out_chooses_the_folder(engine, capsys, tmp_path):
    code, *_ = call(capsys, "run", "human-lad", "--out", "a/b")
    assert code == 0
    assert everything_below(tmp_path) == ["a", "a/b", "a/b/figure.png", "a/b/report.html", "a/b/result.json"]


def test_run_passes_overrides_and_fidelity_on(engine, capsys):
    options = ("--set", "clamp.jaw.radius_mm=1.5", "--set", "stop.travel_mm=2", "--fidelity", "draft")
    code, _, err = call(capsys, "run", "human-lad", *options)
    assert code == 0
    (scene,) = engine.scenes
    assert (scene.clamp.jaw.radius, scene.stop.travel) == (1.5, 2.0)
    assert scene.mesh == schema.read(MeshSettings, mesh_for("draft", scene.artery), "mesh")
    assert "note: --fidelity draft: on human-lad, errors of 4.0% in the" in err
    assert "those of this scene are estimated at the end" in err
    assert "% in the jaw force" in err


def test_run_notes_a_fidelity_that_the_scene_overrules(engine, capsys, tmp_path):
    (tmp_path / "mine.toml").write_text(
        'artery = "human-lad-wall"\n[clamp]\njaw = "flat-2mm"\n[stop]\nocclusion = 0.9\n[mesh]\naxial = 12\n'
    )
    code, _, err = call(capsys, "run", "mine.toml", "--fidelity", "reference")
    assert code == 0
    assert engine.scenes[0].mesh.axial == 12
    assert err.splitlines()[0].startswith("note: mine.toml sets mesh.axial itself")
    assert "note:" not in call(capsys, "run", "mine.toml")[2]
    assert (tmp_path / "mine-result" / "report.html").exists()


@pytest.mark.parametrize("options", [(), ("--quiet",)])
def test_json_is_alone_on_standard_output_and_nothing_is_written(engine, capsys, tmp_path, options):
    code, out, err = call(capsys, "run", "human-lad", "--json", *options)
    assert code == 0
    content = json.loads(out, parse_constant=pytest.fail)
    assert content["final"]["clamp_force_N"] == 0.4789
    assert content["final"]["max_penetration_mm"] is None
    assert everything_below(tmp_path) == []
    assert bool(err) != bool(options)


def test_json_with_a_folder_does_both(engine, capsys, tmp_path):
    code, out, _ = call(capsys, "run", "human-lad", "--json", "--out", "here")
    assert code == 0
    assert json.loads(out)["converged"] is True
    assert "here/result.json" in everything_below(tmp_path)


def test_quiet_is_silent(engine, capsys):
    assert call(capsys, "run", "human-lad", "--quiet") == (0, "", "")


def test_progress_is_not_a_line_for_every_step(engine, capsys):
    _, _, err = call(capsys, "run", "human-lad")
    lines = err.splitlines()
    assert 20 <= len(lines) <= 50
    assert "[b]step[/b]" in lines[0]


def test_progress_on_a_terminal_is_a_bar_and_leaves_standard_output_alone(engine, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    code, out, err = call(capsys, "run", "human-lad", "--json")
    assert code == 0
    assert json.loads(out)["converged"] is True
    assert "clamping" in err
    assert "[b]step[/b]" in err


# ------------------------------------------------------------------------------------- no solution


@pytest.mark.parametrize("raised", [True, False])
def test_no_solution_keeps_what_converged(engine, capsys, tmp_path, raised):
    partial = FakeResult(converged=False, failure=failed())
    engine.outcome = partial
    if raised:
        engine.outcome = failed()
        engine.outcome.result = partial
    code, out, err = call(capsys, "run", "human-lad", "--json", "--out", "kept")
    assert code == 3
    assert json.loads(out)["converged"] is False
    assert json.loads((tmp_path / "kept" / "result.json").read_text())["converged"] is False
    sentence = err.splitlines()[-1]
    assert all(word in sentence for word in ("clamping", "91 % occlusion", "refine the mesh", "kept"))
    assert "Traceback" not in err


def test_no_solution_says_so_above_its_figures(engine, capsys):
    engine.outcome = FakeResult(converged=False, failure=failed())
    code, out, _ = call(capsys, "run", "human-lad")
    assert code == 3
    assert "NOT CONVERGED" in out.splitlines()[0]


def test_no_solution_at_all_writes_nothing(engine, capsys, tmp_path):
    engine.outcome = failed()
    code, out, err = call(capsys, "run", "human-lad", "--quiet")
    assert (code, out, len(err.splitlines())) == (3, "", 1)
    assert everything_below(tmp_path) == []


@pytest.mark.parametrize(("failure", "code"), [(NoReference("no finer mesh"), 3), (SceneError("bad"), 2)])
def test_every_failure_brings_its_exit_code(engine, capsys, failure, code):
    engine.outcome = failure
    assert call(capsys, "run", "human-lad", "--quiet") == (code, "", f"jaxclamp: {failure}\n")


# ------------------------------------------------------------------------------------- the machine


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (MemoryError(), "memory"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes"), "memory"),
    ],
)
def test_lack_of_memory_is_exit_4(engine, capsys, error, word):
    engine.outcome = error
    code, out, err = call(capsys, "run", "human-lad", "--quiet")
    assert (code, out, len(err.splitlines())) == (4, "", 1)
    assert word in err


def test_a_full_disk_is_exit_4(engine, capsys):
    engine.write_error = OSError(errno.ENOSPC, "No space left on device", "human-lad-result/result.json")
    code, out, err = call(capsys, "run", "human-lad", "--quiet")
    assert (code, out, len(err.splitlines())) == (4, "", 1)
    assert "No space left on device" in err
    assert "human-lad-result/result.json" in err


def test_an_interruption_is_exit_130_on_one_line(engine, capsys):
    engine.outcome = KeyboardInterrupt()
    code, out, err = call(capsys, "run", "human-lad", "--quiet")
    assert (code, out) == (130, "")
    assert err.strip() == "jaxclamp: interrupted"


def test_termination_leaves_nothing_half_written(engine, capsys, tmp_path, monkeypatch):
    def write_half(result, folder, tell):
        (folder / "half.json").write_text("{")
        os.kill(os.getpid(), signal.SIGTERM)
        yield folder / "half.json"

    monkeypatch.setattr(real_export, "_write_all", write_half)
    engine.write_outputs = real_export.write_outputs
    sys.modules["jaxclamp.show.export"].write_outputs = real_export.write_outputs
    code, out, err = call(capsys, "run", "human-lad", "--quiet")
    assert (code, out, err) == (143, "", "jaxclamp: terminated\n")
    assert everything_below(tmp_path) == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_an_interruption_while_packages_are_imported_is_exit_130_on_one_line(tmp_path):
    """JAX is on its way, as soon as the package is found."""
    (tmp_path / "jax.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    done = command("show", "human-lad", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "jaxclamp: interrupted\n")


@pytest.mark.parametrize("quiet", [False, True])
def test_a_damaged_compilation_cache_is_one_line(engine, capsys, quiet, recwarn):
    def clamp(scene, *, guess=None, progress=None):
        for name in ("jit_stage", "jit_other"):
            warnings.warn(f"Error reading persistent compilation cache entry for '{name}': ...", stacklevel=1)
        return engine.outcome

    console._tell_of_cache.cache_clear()
    sys.modules["jaxclamp.solve.clamping"].clamp = clamp
    code, _, err = call(capsys, "run", "human-lad", *(["--quiet"] if quiet else []))
    assert (code, len(recwarn)) == (0, 0)
    said = [line for line in err.splitlines() if "cache" in line]
    assert len(said) == (0 if quiet else 1)


def test_a_mistake_of_the_program_is_not_hidden(engine, capsys):
    engine.outcome = ZeroDivisionError("a bug")
    with pytest.raises(ZeroDivisionError):
        main(["run", "human-lad", "--quiet"])


# ------------------------------------------------------------------------------------- wrong input

WRONG = {
    "unknown preset": (["run", "human-lat"], "human-lad"),
    "missing file": (["run", "nowhere.toml"], "nowhere.toml"),
    "a folder": (["run", "."], "."),
    "wrong value": (["run", "human-lad", "--set", "clamp.jaw.radius_mm=-1"], "clamp.jaw.radius_mm = -1"),
    "unknown key": (["run", "human-lad", "--set", "clamp.jaw.radios_mm=1"], "did you mean radius_mm?"),
    "no override": (["run", "human-lad", "--set", "clamp"], "KEY=VALUE"),
    "cannot close": (["run", "human-lad", "--set", "artery.layers[0].opening_angle_deg=340"], "close"),
    "unknown fidelity": (["run", "human-lad", "--fidelity", "fine"], "draft, standard, reference, seed"),
    "file for a folder": (["run", "human-lad", "--out", "file"], "'file'"),
    "file in the path": (["run", "human-lad", "--out", "file/a/b"], "'file/a/b'"),
    "long path": (["run", "human-lad", "--out", "a" * 300], "--out"),
    "null in the path": (["run", "human-lad", "--out", "a\0b"], "--out"),
    "no scene": (["run"], "SCENE"),
    "unknown option": (["run", "human-lad", "--jsn"], "--jsn"),
    "option without value": (["run", "human-lad", "--out"], "--out"),
    "unknown command": (["optimize", "human-lad"], "optimize"),
    "show, wrong value": (["show", "human-lad", "--set", "mesh.axial=0"], "mesh.axial = 0"),
    "show, unknown preset": (["show", "rabbit"], "rabbit-carotid"),
    "presets, unknown": (["presets", "flat-2m"], "flat-2mm"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_one_sentence_exit_2_and_nothing_written(engine, capsys, tmp_path, name):
    arguments, word = WRONG[name]
    (tmp_path / "file").write_text("precious")
    code, out, err = call(capsys, *arguments)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.startswith("jaxclamp: ")
    assert word in err
    assert engine.scenes == [], "nothing is solved"
    assert everything_below(tmp_path) == ["file"]
    assert (tmp_path / "file").read_text() == "precious"


SCENE = "# my notes\nartery = 'human-lad-wall'\nclamp.jaw = 'cylinder-3mm'\nstop.occlusion = 0.5\n"


@pytest.mark.parametrize("name", ["README.md", "result.json", "jaw.csv", "figures/sections.svg"])
def test_files_of_a_user_are_not_replaced(engine, capsys, tmp_path, name):
    """The scene itself never; others if no result of an earlier run is there."""
    (tmp_path / "scene.toml").write_text(SCENE)
    other = tmp_path / "other"
    (other / name).parent.mkdir(parents=True)
    (other / name).write_text("mine")
    here, there = (call(capsys, "run", "scene.toml", "--out", out) for out in (".", "other"))
    assert engine.scenes == [], "nothing is solved"
    assert here[:2] == there[:2] == (2, "")
    assert "scene.toml, the scene itself, would be replaced in '.': take another folder" in here[2]
    assert f"{name}, which is not of a run of jaxclamp" in there[2]
    assert len(here[2].splitlines()) == len(there[2].splitlines()) == 1
    assert everything_below(tmp_path) == sorted(
        {"scene.toml", "other", f"other/{name}", *(["other/figures"] if "/" in name else [])}
    )
    (other / "result.json").write_text('{"converged": false, "versions": {}}')
    assert call(capsys, "run", "scene.toml", "--out", "other")[0] == 0
    assert call(capsys, "run", "scene.toml", "--out", ".")[0] == 2
    assert (tmp_path / "scene.toml").read_text() == SCENE


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root and Windows may write anywhere")
def test_a_folder_without_permission_is_refused(engine, capsys, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    code, _, err = call(capsys, "run", "human-lad", "--out", "locked")
    assert code == 2
    assert "locked" in err
    assert engine.scenes == []


# ------------------------------------------------------------------------------------- show, presets


def test_show_describes_and_solves_nothing(engine, capsys, tmp_path):
    code, out, err = call(capsys, "show", "human-lad")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "Human LAD between two cylinders"
    assert all(
        word in out
        for word in ("symmetry: 1/8", "modelled: one eighth", "adventitia", "wall: always", "unknowns: 4266")
    )
    assert "predicted: 3 s" in out
    assert "warnings" not in out
    assert engine.scenes == []
    assert everything_below(tmp_path) == []


def test_show_json(engine, capsys):
    _, out, _ = call(capsys, "show", "human-lad", "--json")
    assert json.loads(out)["unknowns"] == 4266


def test_presets_are_listed_by_kind_name_and_title(capsys):
    code, out, err = call(capsys, "presets")
    assert (code, err) == (0, "")
    listed = [line.split(maxsplit=2) for line in out.splitlines()]
    assert listed == [[p.kind, p.name, p.title] for p in presets()]
    assert [kind for kind, *_ in listed] == sorted(
        (kind for kind, *_ in listed), key=["scene", "artery", "jaw", "clamp", "study"].index
    )
    assert json.loads(call(capsys, "presets", "--json")[1])[0]["name"] == "human-lad"


@pytest.mark.parametrize("name", [p.name for p in presets()])
def test_a_preset_is_printed_as_it_is(capsys, name):
    code, out, _ = call(capsys, "presets", name)
    assert code == 0
    assert out == next(p.text for p in presets() if p.name == name)


def test_a_printed_scene_is_a_scene_file(engine, capsys, tmp_path):
    (tmp_path / "copy.toml").write_text(call(capsys, "presets", "human-lad")[1])
    assert call(capsys, "show", "copy.toml")[0] == 0


# ------------------------------------------------------------------------------------- as a program


def test_help_names_the_commands(tmp_path):
    done = command("--help", cwd=tmp_path)
    assert done.returncode == 0
    assert all(name in done.stdout for name in ("show", "run", "presets"))
    assert done.stderr == ""
    assert "--fidelity" in command("run", "--help", cwd=tmp_path).stdout


def test_wrong_input_as_a_program(tmp_path):
    done = command("run", "human-lad", "--set", "artery.pressure_kPa=nan", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "artery.pressure_kPa = nan: expected a number at least 0 kPa" in done.stderr
    assert everything_below(tmp_path) == []


def test_a_reader_that_goes_away_is_no_error(tmp_path):
    root = Path(__file__).parents[2]
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run(
        [sys.executable, "-m", "jaxclamp", "presets"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(root)},
        stdout=write_end,
        stderr=subprocess.PIPE,
        text=True,
        timeout=120,
        check=False,
    )
    os.close(write_end)
    assert (done.returncode, done.stderr) == (0, "")


def test_plain_lines_break_a_long_silence(monkeypatch, capsys):
    """A line for each twentieth of a stage, and for the first news after five seconds."""
    now = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    tell = console.PlainLines()
    given = ((0.0, 100.0), (0.01, 104.0), (0.02, 106.0), (0.03, 110.0), (0.08, 110.1), (1.0, 110.2))
    for fraction, at in given:
        now[0] = at
        tell(types.SimpleNamespace(stage="accuracy", fraction=fraction, message=f"at {at:g} s"))
    assert capsys.readouterr().err.splitlines() == [
        "accuracy:   0%  at 100 s",
        "accuracy:   2%  at 106 s",
        "accuracy:   8%  at 110.1 s",
        "accuracy: 100%  at 110.2 s",
    ]
