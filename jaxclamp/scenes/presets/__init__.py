"""What ships with the package as TOML: whole scenes, and arteries, jaws and clamps to put into scenes.

A preset is a file `KIND/NAME.toml` below this folder. Its first line is a comment with its title;
the comments after it name the sources. Names are unique over all kinds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxclamp.core.failures import SceneError
from jaxclamp.scenes.wording import did_you_mean, shortened

FOLDER = Path(__file__).parent
"""where the presets are"""

KINDS = {
    "scene": ("scenes", "as SCENE"),
    "artery": ("arteries", "as the value of artery"),
    "jaw": ("jaws", "as the value of clamp.jaw"),
    "clamp": ("clamps", "as the value of clamp"),
    "study": ("studies", "as STUDY of jaxclamp optimise"),
}
"""kind -> its folder, and what a preset of that kind is used for"""


@dataclass(frozen=True)
class Preset:
    """One shipped TOML file."""

    name: str
    """its file's name without .toml"""
    kind: str
    """a key of `KINDS`"""
    path: Path
    """where the file is"""

    @property
    def text(self) -> str:
        """What is in the file."""
        return self.path.read_text(encoding="utf-8")

    @property
    def title(self) -> str:
        """Its first line, without the #."""
        return self.text.partition("\n")[0].removeprefix("#").strip()


def presets(kind: str | None = None) -> list[Preset]:
    """All presets (of one kind), sorted by kind and name."""
    return [
        Preset(path.stem, each, path)
        for each, (folder, _) in KINDS.items()
        if kind in (None, each)
        for path in sorted((FOLDER / folder).glob("*.toml"), key=lambda path: path.stem)
    ]


def preset(name: str, kind: str | None = None) -> Preset:
    """The preset called `name`; SceneError if there is none (of that kind), naming the nearest."""
    found = {each.name: each for each in presets()}.get(name)
    if found is None:
        wanted = [each.name for each in presets(kind)]
        sought = f"preset {kind}" if kind else "preset"
        raise SceneError(f"there is no {sought} called {shortened(name)!r}; {did_you_mean(name, wanted)}")
    if kind not in (None, found.kind):
        raise SceneError(f"the preset {name!r} is no {kind}: it is to be used {KINDS[found.kind][1]}")
    return found
