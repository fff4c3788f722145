"""README.md of a folder of results: what lies there, in which units, and how to read it."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxclamp.solve.results import Result

NAME = "README.md"


def about() -> str:
    """What every folder of results holds; `docs/outputs.md` has the same text."""
    return files("jaxclamp.show").joinpath("outputs.md").read_text(encoding="utf-8")


def readme(result: Result) -> str:
    """The text for a result's folder."""
    scene = result.scene
    names = ", ".join(f"{i} {layer.name}" for i, layer in enumerate(scene.artery.layers, 1))
    written = f"Written by jaxclamp {result.versions['jaxclamp']}. Layers, from inside: {names}."
    if not result.converged:
        written += " **The stop was not reached**: all of this is of the states that converged."
    return f"# {scene.title or 'Clamping of an artery'}\n\n{written}\n\n{about()}"
