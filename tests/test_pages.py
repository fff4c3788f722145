"""What README and docs show, works: code blocks run, commands are commands, links lead somewhere."""

import itertools
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

import jaxclamp as jc
from jaxclamp.cli import app
from jaxclamp.scenes.presets import preset
from optimize.sweep_file import load_sweep

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
MESH = ["mesh.circumferential=4", "mesh.axial=6", "mesh.radial=[2, 1]"]
"""code blocks run on: they show how, not how accurately"""


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced blocks of a page in some languages."""
    return [text for language, text in BLOCK.findall(page.read_text()) if language in languages]


def commands() -> list[str]:
    """Every line of a shell block that calls jaxclamp, without its comment."""
    lines = [line for page in PAGES for text in blocks(page, "sh", "bash") for line in text.splitlines()]
    return sorted({line.split(" #")[0].strip() for line in lines if line.startswith("jaxclamp ")})


def with_code() -> list[Path]:
    return [page for page in PAGES if blocks(page, "python")]


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.slow
@pytest.mark.parametrize("page", with_code(), ids=lambda page: page.name)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    """The blocks of a page, one after the other, in a folder of their own and on a coarse mesh."""
    load = jc.load_scene
    monkeypatch.setattr(jc, "load_scene", lambda source, sets=(), **k: load(source, [*MESH, *sets], **k))
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for text in blocks(page, "python"):
        exec(compile(text, page.name, "exec"), names)


def test_there_are_commands():
    assert {line.split()[1] for line in commands()} >= {"run", "show", "optimise", "accuracy", "presets"}


@pytest.mark.parametrize("line", commands())
def test_commands_are_commands(line, tmp_path, monkeypatch):
    """`presets` runs; a scene is shown instead of solved, with the same settings; a study is a preset."""
    monkeypatch.chdir(tmp_path)
    command, *rest = shlex.split(line)[1:]
    assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0
    if command == "optimise":
        preset(rest[0])
        return
    if command == "sweep":
        page = Path(__file__).parents[1] / "docs" / "sweep.md"
        Path(rest[0]).write_text(next(text for text in blocks(page, "toml") if "[[vary]]" in text))
        assert len(load_sweep(rest[0]).jobs) == 100
        return
    if command == "fit":  # its files are the reader's own
        rest = rest[rest.index("--scene") + 1 :]
    if command != "presets":
        settings = [word for before, word in itertools.pairwise(rest) if before == "--set"]
        rest = [rest[0], *(part for setting in settings for part in ("--set", setting))]
        command = "show"
    found = CliRunner().invoke(app, [command, *rest])
    assert found.exit_code == 0, found.output
