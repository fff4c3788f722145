"""Random sensible arteries closed all the way, and pressed on: solved, or refused with the cause.

    python tests/benchmarks/closure_survey.py [COUNT]   survey (goes on where it stopped), then a summary

Writes docs/closure.csv, a row for each artery: the arteries, jaws and meshes of `contact_survey`, with more
elements towards the fold.
"""

from __future__ import annotations

import csv
import dataclasses
import sys
import time
from typing import Any

import numpy as np
from contact_survey import DOCS, sensible

import jaxclamp as jc
from jaxclamp.observe.stops import PressedStop
from jaxclamp.scenes.files import loads_scene

TABLE = DOCS / "closure.csv"
PRESSED = 2.0
"""closing forces to press on to"""
OF_THE_SCENE = ("artery", "layers", "lumen_mm", "wall_mm", "jaw")
READ = ("closing_force_N", "lumen_area_share", "lumen_opening_mm", "lumen_overlap_mm", "intima_force_share")
READ += ("J_min_away_from_fold", "J_max_away_from_fold", "force_balance_error")
HEAD = (*OF_THE_SCENE, "stop", "solved", "closed", "said", "seconds", "iterations", *READ)


def closed_scene(number: int) -> tuple[jc.Scene, float, float]:
    """An artery of the other survey with its jaw, to be closed."""
    scene, radius, wall = sensible(number)
    text = jc.dump_scene(jc.replace(scene, "mesh.circumferential_grading", 2.0))
    lines = ["closed = true" if line.startswith("occlusion =") else line for line in text.splitlines()]
    return loads_scene("\n".join(lines)), radius, wall


def closed(scene: jc.Scene, guess: jc.Result | None = None) -> tuple[dict[str, Any], jc.Result | None]:
    """What a clamping comes to."""
    start = time.perf_counter()
    try:
        result = jc.clamp(scene, guess=guess)
    except jc.EquilibriumError as error:
        said = {"solved": False, "said": str(error), "seconds": round(time.perf_counter() - start, 2)}
        return said, None
    final = result.final
    return {
        "solved": True,
        "closed": final["closed"],
        "said": result.solver["branch"],
        "seconds": round(time.perf_counter() - start, 2),
        "iterations": result.solver["newton_iterations"],
        **{key: final[key] for key in READ},
    }, result


def rows(number: int) -> list[dict[str, Any]]:
    """Of one artery: closed, and pressed on."""
    scene, radius, wall = closed_scene(number)
    jaw = scene.clamp.jaw.shape
    drawn = (number, len(scene.artery.layers), radius, wall, jaw)
    row = dict(zip(OF_THE_SCENE, drawn, strict=True))
    found, result = closed(scene)
    both = [row | {"stop": "closed"} | found]
    if result is not None:
        force = PRESSED * 1e3 * result.final["closing_force_N"]
        stop = PressedStop(kind="pressed", closed=True, force=np.float64(force))
        both.append(row | {"stop": "pressed"} | closed(dataclasses.replace(scene, stop=stop))[0])
    return both


def survey(count: int) -> None:
    """Rows that are missing, appended to the table."""
    if not TABLE.exists():
        TABLE.write_text(",".join(HEAD) + "\n", encoding="utf-8")
    known = {int(row["artery"]) for row in read()}
    for number in range(count):
        if number in known:
            continue
        with TABLE.open("a", newline="", encoding="utf-8") as file:
            for row in rows(number):
                csv.DictWriter(file, HEAD).writerow(row)
                print(number, row["stop"], row["solved"], row["said"], row["seconds"], flush=True)


def read() -> list[dict[str, str]]:
    """The rows so far."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def summary() -> None:
    """How many of each were solved, and the worst figures of those."""
    for stop in ("closed", "pressed"):
        of_stop = [row for row in read() if row["stop"] == stop]
        solved = [row for row in of_stop if row["solved"] == "True"]
        overlap = max(float(row["lumen_overlap_mm"]) / float(row["wall_mm"]) for row in solved)
        balance = max(float(row["force_balance_error"]) for row in solved)
        shut = sum(row["closed"] == "True" for row in solved)
        print(f"{stop}: {len(solved)} of {len(of_stop)} solved, {shut} closed, ", end="")
        print(f"overlap up to {overlap:.2%} of the wall, balance of forces to {balance:.0e}")


if __name__ == "__main__":
    survey(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
    summary()
