"""The map of the box of extreme scenes: where it is solved, where refused, and why.

    python tests/benchmarks/extremes_map.py [--seconds 170]     from the folder of the project

appends to docs/extremes.csv, goes on where it stopped, and writes docs/extremes.md when all is judged.
It exits with 3 while scenes are left, so that it can be run in batches.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from extremes import AXES, COUNTS, Point, draw, judge, random_corners, random_points, row
from jaxclamp.solve.results import versions

STEPS = 7
"""values of a single axis"""
SETS = {
    "single axes": "one value changed, the others those of human-lad",
    "sensible, random": "every value drawn from its sensible part",
    "sensible, corners": "every value at one end of its sensible part, drawn at random",
    "box, random": "every value drawn from its whole range",
    "box, corners": "every value at one end of its range, drawn at random",
}
SIZES = {"sensible, random": 200, "sensible, corners": 100, "box, random": 80, "box, corners": 40}
TABLE, TEXT = Path("docs/extremes.csv"), Path("docs/extremes.md")

Row = dict[str, str]


def points(name: str) -> list[Point]:
    """The scenes of a set."""
    if name == "single axes":
        return [draw({axis: k / (STEPS - 1)}) for axis in AXES for k in range(STEPS)]
    choose = random_points if name.endswith("random") else random_corners
    return list(choose(SIZES[name], 1, name.startswith("sensible")))


def survey(seconds: float) -> bool:
    """Judge what the table lacks, for so long; True if it is complete."""
    start, done = time.perf_counter(), Counter(line["set"] for line in read())
    for name in SETS:
        for point in points(name)[done[name] :]:
            if time.perf_counter() - start > seconds:
                return False
            append({"set": name, **row(point, judge(point))})
    return True


def read() -> list[Row]:
    if not TABLE.is_file():
        return []
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def append(line: dict[str, object]) -> None:
    new = not TABLE.is_file()
    with TABLE.open("a", newline="") as file:
        writer = csv.DictWriter(file, line, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in line.items()})


# --- the text ---------------------------------------------------------------------------------------


def counts(lines: Iterable[Row]) -> list[str]:
    """Scenes, solved, refused, wrong, share solved."""
    found = Counter(line["outcome"] for line in lines)
    total = sum(found.values())
    share = f"{found['solved'] / total:.1%}" if total else "-"
    return [str(total), *(str(found[kind]) for kind in ("solved", "refused", "wrong")), share]


def cause(line: Row) -> str:
    """The cause that a refusal names, without its numbers."""
    middle = re.sub(r"^.*?mm: |^.*?(no load|first contact|stretch [\d.]+): ", "", line["reason"])
    stage = re.search(r"stage '([\w-]+)'", line["reason"])
    said = re.sub(r" \(residual.*?\)", "", middle).split(";")[0].split(": raise")[0].split(": refine")[0]
    return f"{stage[1]}: {said}" if stage else line["reason"][:90]


def table(head: list[str], body: list[list[str]]) -> str:
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *body))


def single(name: str, lines: list[Row]) -> list[str]:
    """One axis: its ranges, and what came of its values."""
    axis = AXES[name]
    signs = {"solved": "+", "refused": "-", "wrong": "!"}
    along = [line for line in lines if line["set"] == "single axes" and line[name]]
    seen = " ".join(f"{float(line[name]):.3g}{signs[line['outcome']]}" for line in along)
    return [
        f"`{name}`",
        axis.unit or "1",
        *(f"{low:g} to {high:g}" for low, high in (axis.range, axis.sensible)),
        seen,
        axis.why,
    ]


def fifths(name: str, lines: list[Row]) -> list[str]:
    """Share solved in each fifth of an axis, over the random scenes of the whole box."""
    found: list[list[Row]] = [[] for _ in range(5)]
    for line in lines:
        if line["set"] == "box, random":
            found[min(int(5 * AXES[name].share(float(line[name]))), 4)].append(line)
    return [f"`{name}`", *(f"{counts(part)[1]}/{len(part)}" if part else "-" for part in found)]


def text(lines: list[Row]) -> str:
    of = lambda name: [line for line in lines if line["set"] == name]
    sensible = [line for line in lines if line["sensible"] == "True"]
    refused = [line for line in lines if line["outcome"] == "refused"]
    refusals = Counter(cause(line) for line in refused)
    seconds = sorted(float(line["seconds"]) for line in lines)
    notes = Counter(note for line in lines for note in line["notes"].split(", ") if note)
    through = sum(COUNTS["radial"])
    cells = f"{COUNTS['circumferential']} x {COUNTS['axial']} x {through}"
    box = [single(name, lines) for name in AXES]
    sets = [[f"{name}: {what}", *counts(of(name))] for name, what in SETS.items()]
    sets += [["all of these that are sensible", *counts(sensible)], ["all", *counts(lines)]]
    missing = [f"{SIZES[name] - len(of(name))} of {name}" for name in SIZES if len(of(name)) < SIZES[name]]
    causes = [
        [said, str(n), str(sum(line["sensible"] == "True" and cause(line) == said for line in refused))]
        for said, n in refusals.most_common()
    ]
    unstable = ", ".join(f"{note} {n}" for note, n in notes.items()) or "none"
    longest = [seconds[len(seconds) // 2], seconds[int(0.95 * len(seconds))], seconds[-1]]
    return f"""# Where scenes are solved, and where they are refused

Written by `tests/benchmarks/extremes_map.py` on {datetime.date.today()}, jaxclamp {versions()["jaxclamp"]};
every scene is a line of `extremes.csv`. Scenes still to be judged: {", ".join(missing) or "none"}.

Every scene is human-lad on {cells} elements, with some of these quantities changed. A scene is *solved*
if it converged and passes the independent checks (forces balance to 1e-6, the jaws' work is the change of
energy, J > 0, penetration and overlap below half the wall, all numbers finite); *refused* if it ends with
one sentence that names the cause; anything else is *wrong*. Sensible is a scene whose values are all in the
sensible part of their range, whose mesh resolves its jaw (`jaxclamp show` does not warn), and whose artery
survives its loads: by the semi-analytic tube there is an equilibrium that widens the lumen to at most twice
its load-free size, with stresses below 2 MPa.

{table(["scenes", "count", "solved", "refused", "wrong", "solved"], sets)}

Lost stability among the solved: {unstable} (reported with each result).
Seconds a scene: half below {longest[0]:.2g}, 95 % below {longest[1]:.2g}, longest {longest[2]:.2g}.

## The box, and what came of single axes (+ solved, - refused, ! wrong)

{table(["axis", "unit", "range", "sensible", "values", "why sensible"], box)}

## Random scenes of the whole box: solved by fifths of each axis, low to high

{table(["axis", "1", "2", "3", "4", "5"], [fifths(name, lines) for name in AXES])}

## Causes of refusal

{table(["stage and cause", "count", "of these sensible"], causes)}
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so long")
    TABLE.parent.mkdir(exist_ok=True)
    complete = survey(parser.parse_args().seconds)
    lines = read()
    print(f"{len(lines)} scenes")
    TEXT.write_text(text(lines))
    return 0 if complete else 3


if __name__ == "__main__":
    sys.exit(main())
