"""Run the tube with every code, each in its own environment and process, and write a table of ratios.

    python compare.py --python jaxclamp=.venv/bin/python --python felupe=other/bin/python \\
        --mesh 10x15x8 --mesh 20x30x16 --out table.md

or with a TOML file of interpreters, `compare.py interpreters.toml`, one line `felupe = "/path/to/python"`
a code. Standard library only. Fails if the codes disagree.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
OURS = "jaxclamp"
WITH_JAX = ("jaxclamp", "tatva", "jax_fem")
COMPILED = (*WITH_JAX, "dolfinx")
"""codes that can keep compiled programs in a folder"""
RADIUS_TOLERANCE, GRADIENT_TOLERANCE = 5e-3, 5e-3
"""largest relative difference from jaxclamp"""
FASTER, GRADIENT_SHARE = 5.0, 0.3
"""goals: times faster than the fastest peer; one gradient in own Newton iterations"""
SLOPES = ("d_c", "d_k1", "d_k2", "d_p")

Row = dict[str, Any]


def run(name: str, python: str, mesh: str, options: list[str], cache: str | None, seconds: float) -> Row:
    """One script in a new process. Raises RuntimeError with the end of its output if it fails.

    cache: folder of compiled programs; None: everything is compiled in this process
    """
    variables = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    variables["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    if cache is not None:
        variables["JAX_COMPILATION_CACHE_DIR"] = cache
    if name == OURS:
        variables["PYTHONPATH"] = str(HERE.parents[2])
    command = [python, str(HERE / f"tube_{name}.py"), *mesh.split("x"), "--json", *options]
    with tempfile.TemporaryDirectory() as empty:
        variables["XDG_CACHE_HOME"] = cache or empty  # where FEniCSx keeps its compiled forms
        try:
            done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=seconds)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(f"not done in {seconds:g} s") from error
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not lines:
        raise RuntimeError((done.stderr or done.stdout).strip()[-500:])
    return json.loads(lines[-1])


def measure(name: str, python: str, mesh: str, seconds: float, cached: bool) -> Row:
    """Everything about one code on one mesh.

    cached: also the first solve with programs that another process compiled
    """
    row = run(name, python, mesh, [], None, seconds) | {"name": name}
    if cached and name in COMPILED:
        with tempfile.TemporaryDirectory() as cache:
            first_only = ["--first-only"]
            run(name, python, mesh, first_only, cache, seconds)  # fills the folder
            row["first_cached_s"] = run(name, python, mesh, first_only, cache, seconds)["first_s"]
    return row


def relative(value: float, base: float) -> float:
    """|value / base - 1|."""
    return abs(value / base - 1.0)


def disagreements(rows: list[Row]) -> list[str]:
    """What differs from jaxclamp by more than it should."""
    ours, found = rows[0], []
    for row in rows:
        radii = [row["radius_mm"], row["analytic_start"]["radius_mm"]]
        if max(relative(radius, ours["radius_mm"]) for radius in radii) > RADIUS_TOLERANCE:
            found.append(f"{row['code']}: radius {radii} mm, jaxclamp {ours['radius_mm']} mm")
        if row["gradient"] is None or ours["gradient"] is None:
            continue
        for name in SLOPES:
            value, base = row["gradient"][name], ours["gradient"][name]
            if relative(value, base) > GRADIENT_TOLERANCE:
                found.append(f"{row['code']}: {name} = {value}, jaxclamp {base}")
    return found


def number(value: float) -> str:
    """Three significant digits without an exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:#.3g}".rstrip(".")


def with_ratio(row: Row, ours: Row, *path: str, scale: float = 1.0) -> str:
    """A value and, in brackets, how many times jaxclamp's it is."""
    value, base = row, ours
    for key in path:
        value, base = (v.get(key) if v else None for v in (value, base))
    if value is None:
        return ""
    text = number(scale * value)
    return text if row is ours or not base else f"{text} (×{value / base:.2g})"


HEAD = (
    "code",
    "radius, mm",
    "import, s",
    "first solve, s",
    "the same, compiled before, s",
    "warm, s",
    "iterations",
    "one iteration, ms",
    "warm from the analytic field, s",
    "peak memory, MB",
)
GRADIENT_HEAD = (
    "code",
    "d/dc, mm/kPa",
    "d/dk1, mm/kPa",
    "d/dk2, mm",
    "d/dp, mm/kPa",
    "gradient, ms",
    "in own Newton iterations",
    "first call, s",
    "how",
)


def times_row(row: Row, ours: Row) -> list[str]:
    """One line of the table of times."""
    near = row["analytic_start"]
    return [
        f"{row['code']} {row['version']}",
        f"{row['radius_mm']:.6f}",
        with_ratio(row, ours, "import_s"),
        with_ratio(row, ours, "first_s"),
        with_ratio(row, ours, "first_cached_s"),
        with_ratio(row, ours, "warm_s"),
        str(row["iterations"]),
        with_ratio(row, ours, "iteration_s", scale=1e3),
        f"{with_ratio(row, ours, 'analytic_start', 'warm_s')} in {near['iterations']}",
        with_ratio(row, ours, "peak_memory_MB"),
    ]


def gradient_row(row: Row, ours: Row) -> list[str]:
    """One line of the table of gradients."""
    slope = row["gradient"]
    return [
        row["code"],
        *[f"{slope[name]:.7g}" for name in SLOPES],
        with_ratio(row, ours, "gradient", "seconds", scale=1e3),
        number(slope["seconds"] / row["iteration_s"]),
        number(slope["first_seconds"]),
        slope["by"],
    ]


def markdown(head: tuple[str, ...], lines: list[list[str]]) -> str:
    """A table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *lines])


def goals(rows: list[Row]) -> list[str]:
    """Each goal with its figure and whether it is met."""
    ours, peers = rows[0], rows[1:]
    found = []

    def add(goal: str, value: float, limit: float, at_least: bool) -> None:
        met = value >= limit if at_least else value <= limit
        sign = "at least" if at_least else "at most"
        found.append(f"{goal}: {value:.2f} ({sign} {limit:g}) - {'met' if met else 'MISSED'}")

    if peers:
        fastest = min(peers, key=lambda row: row["warm_s"])
        ratio = fastest["warm_s"] / ours["warm_s"]
        add(f"warm solve, {fastest['code']} over jaxclamp", ratio, FASTER, True)
        nearest = min(peers, key=lambda row: row["analytic_start"]["warm_s"])
        ratio = nearest["analytic_start"]["warm_s"] / ours["warm_s"]
        add(f"the same with the analytic field handed to {nearest['code']}", ratio, FASTER, True)
        quickest = min(peers, key=lambda row: row["iteration_s"])
        ratio = quickest["iteration_s"] / ours["iteration_s"]
        add(f"one iteration, {quickest['code']} over jaxclamp", ratio, FASTER, True)
    for key, note in (("first_s", ""), ("first_cached_s", ", compiled before")):
        with_jax = [row for row in peers if row["name"] in WITH_JAX and row.get(key)]
        if with_jax:
            soonest = min(with_jax, key=lambda row: row[key])
            ratio = ours[key] / soonest[key]
            add(f"first solve{note}, jaxclamp over {soonest['code']}", ratio, 1.0, False)
    if ours["gradient"]:
        share = ours["gradient"]["seconds"] / ours["iteration_s"]
        add("jaxclamp's gradient in own Newton iterations, at a new solution", share, GRADIENT_SHARE, False)
        share = ours["gradient"]["again_seconds"] / ours["iteration_s"]
        add("the same, a further gradient at that solution", share, GRADIENT_SHARE, False)
    return found


def report(mesh: str, rows: list[Row], failures: dict[str, str]) -> str:
    """Tables and goals for one mesh; ratios in brackets are to jaxclamp."""
    ours = rows[0]
    with_gradient = [gradient_row(row, ours) for row in rows if row["gradient"]]
    parts = [
        f"## {mesh} elements\n",
        markdown(HEAD, [times_row(row, ours) for row in rows]) + "\n",
        markdown(GRADIENT_HEAD, with_gradient) + "\n",
        *[f"- {line}" for line in goals(rows)],
        *[f"- {name} was not measured: {reason}" for name, reason in failures.items()],
    ]
    return "\n".join(parts) + "\n"


def interpreters(args: argparse.Namespace) -> dict[str, str]:
    """Interpreter of each code, jaxclamp first."""
    given = tomllib.loads(args.interpreters.read_text()) if args.interpreters else {}
    given |= dict(pair.split("=", 1) for pair in args.python)
    if OURS not in given:
        raise SystemExit(f"an interpreter for {OURS} is needed: ratios are to it")
    return {OURS: given.pop(OURS), **given}


def compare(
    mesh: str, codes: dict[str, str], seconds: float, cached: bool
) -> tuple[list[Row], dict[str, str]]:
    """Rows of the codes that finished, and why others did not."""
    rows, failures = [], {}
    for name, python in codes.items():
        print(f"{mesh}: {name}", file=sys.stderr, flush=True)
        try:
            rows.append(measure(name, python, mesh, seconds, cached))
        except RuntimeError as error:
            if name == OURS:
                raise
            failures[name] = str(error)
            print(f"    {error}", file=sys.stderr, flush=True)
    return rows, failures


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("interpreters", type=Path, nargs="?", help="TOML file: code = interpreter")
    parser.add_argument("--python", action="append", default=[], metavar="CODE=PATH")
    parser.add_argument("--mesh", action="append", metavar="NxNxN", help="default: 10x15x8")
    parser.add_argument("--timeout", type=float, default=1500.0, help="per process, s")
    parser.add_argument("--skip-cached", action="store_true", help="no first solves with compiled programs")
    parser.add_argument("--out", type=Path, help="Markdown file")
    parser.add_argument("--results", type=Path, help="JSON file of everything measured")
    args = parser.parse_args()
    machine = f"{os.cpu_count()} cores {platform.machine()}"
    texts, everything, wrong = [f"{datetime.date.today()}, {machine}\n"], {}, []
    for mesh in args.mesh or ["10x15x8"]:
        rows, failures = compare(mesh, interpreters(args), args.timeout, not args.skip_cached)
        texts.append(report(mesh, rows, failures))
        everything[mesh] = rows
        wrong += [f"{mesh}: {line}" for line in disagreements(rows)]
    text = "\n".join(texts)
    print(text)
    if args.out:
        args.out.write_text(text)
    if args.results:
        args.results.write_text(json.dumps(everything, indent=1))
    if wrong:
        raise SystemExit("the codes disagree:\n" + "\n".join(wrong))


if __name__ == "__main__":
    main()
