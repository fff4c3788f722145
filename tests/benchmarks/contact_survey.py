"""Random sensible arteries clamped with three contact laws: what each costs, and how far it gives way.

    python tests/benchmarks/contact_survey.py [COUNT]   survey (goes on where it stopped), then the page

Writes docs/contact.csv, a row for each artery and law, and the table of docs/contact.md.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import jaxclamp as jc
from jaxclamp.scenes.files import loads_scene
from jaxclamp.scenes.fitting import fitting_contact
from jaxclamp.scenes.schema import toml_value
from jaxclamp.solve.inflation import inflated_radius

DOCS = Path(__file__).parents[2] / "docs"
PAGE, TABLE = DOCS / "contact.md", DOCS / "contact.csv"
HARDER = 3.0
"""times the stiffness, to see what is left of the penalty"""
COUNTS = {1: [3], 2: [2, 1], 3: [1, 2, 1]}
"""elements through the layers, by their number"""
FIXED, STIFFEST, MEAN = "2000 kPa/mm, 0.01 mm", "100 (c + p) / H, 1 % of H", "the same, c the wall's mean"
HEAD = ("artery", "law", "layers", "lumen_mm", "wall_mm", "jaw", "occlusion", "solved", "said", "seconds")
MEASURED = ("iterations", "stiffness", "penetration_share", "force_off", "peak_off")


def artery(rng: np.random.Generator) -> tuple[dict[str, Any], float, float]:
    """An artery's table as in files, its closed lumen radius and the thickness of its wall, mm."""
    count, radius = int(rng.integers(1, 4)), float(np.exp(rng.uniform(np.log(0.3), np.log(12.0))))
    wall, inner, layers = radius * rng.uniform(0.08, 0.45), radius, []
    shares = {1: [1.0], 2: [0.65, 0.35], 3: [0.15, 0.5, 0.35]}[count]
    c = float(np.exp(rng.uniform(np.log(3.0), np.log(40.0))))
    names = ["media", "adventitia"][:count] if count < 3 else ["intima", "media", "adventitia"]
    for name, share in zip(names, shares, strict=True):
        soft = rng.uniform(0.1, 0.6) if name == "adventitia" else 1.0
        thickness, opening = wall * share, rng.uniform(0.0, 170.0)
        open_inner = (inner + 0.5 * thickness) / (1.0 - opening / 360.0) - 0.5 * thickness
        material = {"law": "hgo", "c_kPa": c * soft, "k1_kPa": c * rng.uniform(0.05, 1.5), "bulk_kPa": 1e4}
        material |= {"k2": float(np.exp(rng.uniform(-1.0, 2.5)))}
        material |= {"fibre_angle_deg": rng.uniform(5.0, 60.0)}
        layers.append(
            {"name": name, "inner_radius_mm": open_inner, "thickness_mm": thickness}
            | {"opening_angle_deg": opening, "material": material}
        )
        inner += thickness
    loads = {"axial_stretch": rng.uniform(1.05, 1.5), "pressure_kPa": rng.uniform(8.0, 18.0)}
    return {"length_mm": 10.0 * inner} | loads | {"layers": layers}, radius, wall


def jaw(rng: np.random.Generator, outer: float) -> dict[str, Any]:
    """A jaw's table, of any shape."""
    shape = str(rng.choice(["cylinder", "flat", "spline"]))
    if shape == "cylinder":
        return {"shape": shape, "radius_mm": outer * rng.uniform(0.4, 1.5)}
    width, edge = outer * rng.uniform(0.4, 1.0), outer * rng.uniform(0.2, 0.6)
    if shape == "flat":
        return {"shape": shape, "half_width_mm": width, "edge_radius_mm": edge}
    slopes = np.sort(rng.uniform(0.0, 0.5, 4)).tolist()
    return {"shape": shape, "half_width_mm": width, "slopes": slopes, "edge_radius_mm": edge}


def sensible(number: int) -> tuple[jc.Scene, float, float]:
    """The scene of an artery: drawn again until pressure widens it by no more than a half."""
    rng = np.random.default_rng(number)
    while True:
        drawn, radius, wall = artery(rng)
        mesh = {"circumferential": 6, "axial": 8, "radial": COUNTS[len(drawn["layers"])]}
        tables = {"artery": drawn, "clamp": {"jaw": jaw(rng, radius + wall)}, "mesh": mesh}
        tables |= {"stop": {"occlusion": rng.uniform(0.5, 0.9)}}
        try:
            scene = loads_scene("\n".join(f"{key} = {toml_value(value)}" for key, value in tables.items()))
        except jc.SceneError:
            continue
        in_body = inflated_radius(scene.artery, radius)
        if in_body is not None and in_body < 1.5 * radius:
            return scene, radius, wall


def with_law(scene: jc.Scene, law: str) -> jc.Scene:
    """The scene with one of the contact laws."""
    contact = fitting_contact(scene.artery)
    stiffness, smoothing = contact.stiffness, contact.smoothing
    if law == FIXED:
        stiffness, smoothing = 2000.0, 0.01
    if law == MEAN:
        thickness = np.array([float(layer.thickness) for layer in scene.artery.layers])
        c = np.array([float(layer.material.c) for layer in scene.artery.layers])
        stiffness *= (np.average(c, weights=thickness) + scene.artery.pressure) / (
            np.max(c) + scene.artery.pressure
        )
    return jc.replace(jc.replace(scene, "contact.stiffness", stiffness), "contact.smoothing", smoothing)


def measured(scene: jc.Scene, wall: float) -> dict[str, Any]:
    """What a clamping comes to, and how far force and peak move with a harder contact."""
    start = time.perf_counter()
    try:
        result = jc.clamp(scene)
    except jc.EquilibriumError as error:
        return {"solved": False, "said": str(error), "seconds": time.perf_counter() - start}
    found = {
        "solved": True,
        "said": result.solver["branch"],
        "seconds": time.perf_counter() - start,
        "iterations": result.solver["newton_iterations"],
        "stiffness": float(scene.contact.stiffness),
        "penetration_share": result.final["max_penetration_mm"] / wall,
    }
    harder = jc.replace(scene, "contact.stiffness", HARDER * scene.contact.stiffness)
    try:
        other = jc.clamp(harder, guess=result).final
    except jc.EquilibriumError:
        return found
    name = "smooth_peak_axial_stress_kPa"
    peaks = [max(final[name].values()) for final in (result.final, other)]
    return found | {
        "force_off": result.final["clamp_force_N"] / other["clamp_force_N"] - 1.0,
        "peak_off": peaks[0] / peaks[1] - 1.0,
    }


def survey(count: int) -> None:
    """Rows that are missing, appended to the table."""
    if not TABLE.exists():
        TABLE.write_text(",".join(HEAD + MEASURED) + "\n", encoding="utf-8")
    known = {(row["artery"], row["law"]) for row in read()}
    for number in range(count):
        for law in (FIXED, STIFFEST, MEAN):
            if (str(number), law) in known:
                continue
            scene, radius, wall = sensible(number)
            row = {"artery": number, "law": law, "layers": len(scene.artery.layers), "lumen_mm": radius}
            row |= {"wall_mm": wall, "jaw": scene.clamp.jaw.shape, "occlusion": float(scene.stop.occlusion)}
            row |= measured(with_law(scene, law), wall)
            rounded = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}
            with TABLE.open("a", encoding="utf-8", newline="") as file:
                csv.DictWriter(file, HEAD + MEASURED, lineterminator="\n").writerow(rounded)
            print(number, law, rounded.get("solved"), rounded.get("penetration_share"), flush=True)


def read() -> list[dict[str, str]]:
    """The rows at hand."""
    with TABLE.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def lines(rows: list[dict[str, str]]) -> list[str]:
    """The page's table."""
    head = "| law | arteries | solved | penetration / wall | force off | peak off | iterations |"
    output = [head, "|---" * 7 + "|"]
    for law in (FIXED, STIFFEST, MEAN):
        here = [row for row in rows if row["law"] == law]
        good = [row for row in here if row["solved"] == "True"]
        cells = [law, str(len(here)), str(len(good))]
        for key in ("penetration_share", "force_off", "peak_off"):
            values = np.abs([float(row[key]) for row in good if row[key]])
            cells.append(f"{np.median(values):.1%} ({np.max(values):.1%})")
        cells.append(f"{np.median([float(row['iterations']) for row in good]):.0f}")
        output.append(f"| {' | '.join(cells)} |")
    return output


def main() -> None:
    """Survey, then put the table into the page."""
    survey(int(sys.argv[1]) if len(sys.argv) > 1 else 36)
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition("<!-- table -->\n")
    _, _, after = rest.partition("<!-- end of table -->\n")
    table = "\n".join(lines(read()))
    PAGE.write_text(f"{before}<!-- table -->\n{table}\n<!-- end of table -->\n{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
