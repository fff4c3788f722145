"""What ships with the package as TOML: whole scenes, and arteries and jaws to put into scenes.

A preset is a file `KIND/NAME.toml` below this folder. Its first line is a comment with its title;
the comments after it name the sources. Names are unique over all kinds.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from jaxclamp.core.failures import SceneError

FOLDER = Path(__file__).parent

# kind -> its folder, and what a preset of that kind is used for
KINDS = {
    "scene": ("scenes", "as SCENE"),
    "artery": ("arteries", "as the value of artery"),
    "jaw": ("jaws", "as the value of clamp.jaw"),
    "study": ("studies", "as STUDY of jaxclamp optimise"),
}


@dataclass(frozen=True)
class Preset:
    """One shipped TOML file."""

    name: str
    kind: str
    path: Path

    @property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @property
    def title(self) -> str:
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
        raise SceneError(
            f"there is no preset {f'{kind} ' if kind else ''}called {name!r}; {did_you_mean(name, wanted)}"
        )
    if kind not in (None, found.kind):
        raise SceneError(f"the preset {name!r} is no {kind}: it is to be used {KINDS[found.kind][1]}")
    return found


def nearest(word: str, known: list[str]) -> str | None:
    """What was probably meant: the same word with a unit, or one that differs by a slip."""
    same = [k for k in known if k.lower() == word.lower() or k.startswith(f"{word}_")]
    return next(iter(same + difflib.get_close_matches(word, known, n=1, cutoff=0.5)), None)


def did_you_mean(word: str, known: list[str]) -> str:
    """'did you mean X?', or the list of what is known where nothing is near."""
    near = nearest(word, known)
    return f"did you mean {near}?" if near else f"known here: {', '.join(known)}"
