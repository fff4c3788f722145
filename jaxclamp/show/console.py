"""What the command line says: progress while it works, figures and files when it is done."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from jaxclamp.observe.figures import shown_in

IN_BODY = ("lumen_radius_mm", "axial_stress_at_P_kPa", "circumferential_stress_at_P_kPa")
"""keys of the artery without the clamp, block "physiological" of result.json, that a summary shows"""
UNITS = {"mm": "mm", "mm2": "mm2", "kPa": "kPa", "N": "N", "mN": "mN", "s": "s", "seconds": "s", "MB": "MB"}
OPEN_FIRST = (".html", ".pvd", ".xdmf", ".csv", ".json")
"""files that a reader opens, the report first; pictures and the states' own files are found there"""


@contextmanager
def progress(quiet: bool) -> Iterator[Callable[[Any], None] | bool]:
    """A receiver of progress events (`stage`, `fraction` of the stage, `message`).

    A bar on a terminal, plain lines elsewhere, both on standard error; False if quiet.
    """
    with cache_in_a_line(quiet), _progress(quiet) as tell:
        yield tell


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[Any], None] | bool]:
    if quiet:
        yield False
    elif not sys.stderr.isatty():
        yield PlainLines()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        stage, said = TextColumn("{task.description:<14}"), TextColumn("{task.fields[said]}", markup=False)
        columns = (stage, BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), said)
        with Progress(*columns, console=Console(stderr=True)) as bars:
            tasks: dict[str, Any] = {}

            def draw(event: Any) -> None:
                if event.stage not in tasks:
                    tasks[event.stage] = bars.add_task(event.stage, total=1.0, said="")
                bars.update(tasks[event.stage], completed=event.fraction, said=event.message)

            yield draw


DAMAGED_CACHE = "Error reading persistent compilation cache entry"
"""how JAX begins the warning that it gives for each of its compiled programs that it cannot read"""


@contextmanager
def cache_in_a_line(quiet: bool) -> Iterator[None]:
    """Have JAX's warnings of a damaged compilation cache make one line of this process, none if quiet.

    Processes that are started meanwhile say nothing of it.
    """
    before, others = os.environ.get("PYTHONWARNINGS", ""), warnings.showwarning

    def show(message: Any, *about: Any, **more: Any) -> None:
        if not str(message).startswith(DAMAGED_CACHE):
            others(message, *about, **more)
        elif not quiet:
            _tell_of_cache()

    os.environ["PYTHONWARNINGS"] = f"{before},ignore:{DAMAGED_CACHE}".removeprefix(",")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("always", message=DAMAGED_CACHE)
            warnings.showwarning = show
            yield
    finally:
        os.environ["PYTHONWARNINGS"] = before


@cache
def _tell_of_cache() -> None:
    """Once in a process."""
    sys.stderr.write("note: JAX's compilation cache is damaged: programs are compiled anew; empty it\n")


LONGEST_SILENCE = 5.0
"""s after which news of a stage are told however little of it is done meanwhile"""


class PlainLines:
    """A line on standard error for each stage, its every twentieth, its end, and after `LONGEST_SILENCE`."""

    def __init__(self) -> None:
        self.stage, self.fraction, self.told = "", 0.0, 0.0

    def __call__(self, event: Any) -> None:
        gained = event.fraction - self.fraction
        finished = event.fraction >= 1.0 and gained > 0.0
        silent = time.monotonic() - self.told < LONGEST_SILENCE
        if event.stage == self.stage and gained < 0.05 and silent and not finished:
            return
        self.stage, self.fraction, self.told = event.stage, event.fraction, time.monotonic()
        sys.stderr.write(f"{event.stage}: {event.fraction:4.0%}  {event.message}".rstrip() + "\n")
        sys.stderr.flush()


def summary(result: dict[str, Any], files: list[Path]) -> list[str]:
    """The key figures of a result, and the files to open, as lines."""
    done = "" if result.get("converged") else " (NOT CONVERGED: the last state that did)"
    output = [f"{result.get('title') or 'Clamping'}{done}"]
    blocks = {"physiological": IN_BODY, "final": tuple(figure.key for figure in shown_in("summary"))}
    for block, keys in blocks.items():
        output += ["", f"  {block}"]
        for key in keys:
            value = (result.get(block) or {}).get(key)
            parts = value if isinstance(value, dict) else {"": value}
            for layer, number in parts.items():
                label, unit = label_and_unit(key)
                named = f"{label}, {layer}" if layer else label
                error = _error(result, block, f"{key}.{layer}" if layer else key)
                output.append(f"    {named:<36}{figure(number):>10} {error}{unit}".rstrip())
    if rows := thresholds(result.get("final") or {}):
        output += ["", "  above your thresholds"]
        output += [
            f"    {what}: {share} above {least}, peak {peak} of it ({said})"
            for what, least, share, peak, said in rows
        ]
    if branch := branch_of(result):
        output += ["", f"  equilibrium: {branch}"]
    to_open = sorted((f for f in files if f.suffix in OPEN_FIRST), key=lambda f: OPEN_FIRST.index(f.suffix))
    return output + ["", *(f"  open {path}" for path in to_open)] if to_open else output


def thresholds(final: dict[str, Any]) -> list[list[str]]:
    """Of each `[[injury]]` what it is of, the threshold, the share above it, the peak over it, the source."""
    rows = []
    for given in final.get("injury") or []:
        what = given["measure"].replace("_", " ")
        where = f", {given['layer']}" if given["layer"] else ", under the jaws"
        share, peak = given["share_above"], given["peak_over_threshold"]
        said = f"{share:.2%} of the {'volume' if given['layer'] else 'area'}"
        rows.append([what + where, f"{given['threshold_kPa']:.4g} kPa", said, f"{peak:.3g}", given["source"]])
    return rows


def branch_of(result: dict[str, Any]) -> str:
    """Which equilibrium a result is, in words; blank if nothing was clamped."""
    return str((result.get("solver") or {}).get("branch") or "")


def _error(result: dict[str, Any], block: str, key: str) -> str:
    """'± 0.0099 ' for a figure whose error was estimated, blank otherwise; aligned where there are any."""
    errors = result.get("errors") or {}
    known = errors.get(key if block == "final" else f"{block}.{key}", {}).get("error")
    text = "" if known is None else f"± {known:.2g}"
    return f"{text:<10} " if errors else ""


def label_and_unit(key: str) -> tuple[str, str]:
    """'lumen_height_mm' -> ('lumen height', 'mm')."""
    name, _, unit = key.rpartition("_")
    return (name.replace("_", " "), UNITS[unit]) if name and unit in UNITS else (key.replace("_", " "), "")


def name_and_unit(key: str) -> tuple[str, str]:
    """'physiological.lumen_radius_mm' -> ('lumen radius, in the body', 'mm'); a layer's name goes behind."""
    name, _, layer = key.removeprefix("physiological.").partition(".")
    label, unit = label_and_unit(name)
    in_body = "in the body" if key.startswith("physiological.") else ""
    return ", ".join(part for part in (label, in_body, layer) if part), unit


def figure(value: Any) -> str:
    """A number to four digits, '-' for none."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


def lines(described: dict[str, Any], indent: str = "  ") -> list[str]:
    """A nested description as indented lines; what is empty is left out."""
    output: list[str] = []
    for key, value in described.items():
        label, unit = label_and_unit(str(key))
        if isinstance(value, dict):
            output += [f"{indent}{label}", *lines(value, indent + "  ")]
        elif isinstance(value, list | tuple):
            output += (
                [f"{indent}{label}", *(f"{indent}  {one_line(item)}" for item in value)] if value else []
            )
        else:
            output.append(f"{indent}{label}: {figure(value)} {unit}".rstrip())
    return output


def one_line(item: Any) -> str:
    """An item of a list on one line."""
    if isinstance(item, dict):
        return ", ".join(text.strip() for text in lines(item))
    return ": ".join(map(figure, item)) if isinstance(item, list | tuple) else figure(item)


def as_json(content: Any) -> str:
    """JSON text, with null for the numbers that JSON does not have."""
    return json.dumps(_finite(content), indent=2, allow_nan=False)


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
