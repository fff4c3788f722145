"""The price list: extrapolation, fronts, the variants, and what is written."""

from __future__ import annotations

import csv
import io
import json
import math

import pytest

import jaxclamp as jc
from jaxclamp.cli import main
from jaxclamp.core.progress import Progress
from jaxclamp.show.price_report import lines, markdown, write_prices
from jaxclamp.trust import price_list as accuracy
from jaxclamp.trust.price_list import GRADIENT, Price, PriceList, ladder, richardson, scaled

SIZES = [1.0, 2 / 3, 0.5]
TINY = ["mesh.circumferential=3", "mesh.axial=4", "mesh.radial=[1, 1]"]


@pytest.mark.parametrize("order", [1.0, 1.7, 2.0, 3.0])
def test_a_power_law_is_extrapolated_exactly(order):
    limit = richardson(SIZES, [5.0 + 0.3 * h**order for h in SIZES])
    assert limit.believed
    assert limit.order == pytest.approx(order)
    assert limit.value == pytest.approx(5.0)
    assert limit.spread == pytest.approx(0.3 * 0.5**order)


def test_without_an_order_the_elements_is_assumed():
    """Values that turn round have no order."""
    limit = richardson(SIZES, [5.0, 5.2, 5.1])
    assert not limit.believed
    assert limit.order == 2.0
    assert limit.value == pytest.approx(5.1 - 0.1 * 0.25 / (4 / 9 - 0.25))


def listed() -> PriceList:
    """Three variants of one figure that is exactly 10."""
    keys = ("physiological.lumen_radius_mm", "smooth_peak_axial_stress_kPa.media")

    def price(setting: str, value: float, seconds: float) -> Price:
        return Price("mesh", setting, dict.fromkeys(keys, value), None, 8, 20, 30, seconds, 500.0)

    prices = [price("coarse", 11.0, 1.0), price("fine", 10.1, 5.0), price("poor", 12.0, 3.0)]
    prices.append(Price("bulk", "x 100", None, "no equilibrium"))
    limit = richardson(SIZES, [10.0 + h**2 for h in SIZES])
    source = {"value": 11.0, "error": 1.0, "discretisation": 1.0, "bulk": 0.0}
    source |= {"contact_stiffness": 0.0, "contact_smoothing": 0.0}
    return PriceList(
        "A tube",
        "media",
        prices,
        dict.fromkeys(keys, limit),
        dict.fromkeys(keys, 10.0),
        dict.fromkeys(keys, source),
        [{"part": "Soft", "from": "parts.py", "sha256": "0" * 64}],
    )


def test_errors_and_the_front():
    prices, key = listed(), "physiological.lumen_radius_mm"
    errors = [prices.error(price, key) for price in prices.prices]
    assert errors[:3] == pytest.approx([0.1, 0.01, 0.2])
    assert errors[3] is None
    assert [price.setting for price in prices.front(key)] == ["coarse", "fine"]


def test_tables_and_files(tmp_path):
    prices = listed()
    assert any("10.00%*" in line for line in lines(prices))
    assert any("bulk x 100: no equilibrium" in line for line in lines(prices))
    assert "| mesh | fine | 8 | 5.00 | 500 | 1.00%* | 1.00%* |" in markdown(prices)
    names = {path.name for path in write_prices(prices, tmp_path / "new")}
    assert names == {"accuracy.md", "accuracy.csv", "accuracy.json", "accuracy.png", "accuracy.svg"}
    table = list(csv.DictReader(io.StringIO((tmp_path / "new" / "accuracy.csv").read_text())))
    assert float(table[1]["error of physiological.lumen_radius_mm"]) == pytest.approx(0.01)
    assert table[3]["seconds"] == "nan"
    written = json.loads((tmp_path / "new" / "accuracy.json").read_text())
    reference = written["reference"]["physiological.lumen_radius_mm"]
    assert reference["exact"] == 10.0
    assert written["own_parts"] == prices.own_parts
    assert reference["limit_of_meshes"]["order"] == pytest.approx(2.0)
    assert written["front"]["physiological.lumen_radius_mm"] == ["mesh: coarse", "mesh: fine"]
    assert (tmp_path / "new" / "accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_the_ladder_varies_one_thing_at_a_time():
    scene = jc.load_scene("human-lad")
    rungs = ladder(scene)
    groups = {rung.group for rung in rungs}
    assert {"mesh", "circumferential", "axial", "radial", "element", "bulk"} <= groups
    assert {"contact stiffness", "contact smoothing", "tolerance", "linear solver", "precision"} <= groups
    assert sum(rung.scene == scene for rung in rungs if rung.group == "mesh") == 1
    assert len({(rung.group, rung.setting) for rung in rungs}) == len(rungs)
    assert scaled(scene.mesh, 2.0).radial == (10, 6)


@pytest.mark.slow
def test_a_variant_is_solved_with_its_price():
    scene = jc.load_scene("human-lad", [*TINY, "stop.occlusion=0.5"])
    price = accuracy.solve(accuracy.Rung("mesh", "tiny", scene))
    assert price.figures is not None
    assert price.elements == 24
    assert 0.0 < price.seconds < 60.0
    result = jc.clamp(scene)
    assert price.figures["clamp_force_N"] == pytest.approx(result.final["clamp_force_N"], rel=1e-6)
    # the slope, against a jaw one part in a thousand larger and smaller
    peak = jc.smooth_peak_axial_stress("media")
    ends = [
        jc.clamp(jc.replace(scene, "clamp.jaw.radius", 3.0 * factor)).measure(peak)
        for factor in (1.001, 0.999)
    ]
    assert price.figures[GRADIENT] == pytest.approx((ends[0] - ends[1]) / 0.002, rel=1e-3)


@pytest.mark.slow
def test_single_precision_is_judged_at_the_solution():
    scene = jc.load_scene("human-lad", [*TINY, "stop.occlusion=0.5"])
    price = accuracy.solve(accuracy.Rung("precision", "float32", scene, single_precision=True))
    assert price.figures is None
    assert "not admissible" in price.failure or "not finite" in price.failure


def test_what_is_refused_has_no_figures():
    scene = jc.replace(jc.load_scene("human-lad", TINY), "artery.pressure", 1e3)
    price = accuracy.solve(accuracy.Rung("mesh", "tiny", scene))
    assert price.figures is None
    assert "no equilibrium" in price.failure
    assert math.isnan(price.seconds)


def test_what_is_done_is_told_before_the_first_variant(monkeypatch):
    """The scene itself is solved first: what it tells is passed on, and counts as one of the variants."""
    told: list[Progress] = []

    def clamp(scene, *, progress):
        assert told[0].message.startswith("the scene itself, then ")
        progress(Progress("load-free", 0.7, "closing the open sectors"))
        return "solved"

    def measure(rungs, tell):
        tell(Progress("accuracy", 0.5, "half of them"))
        raise NotImplementedError

    monkeypatch.setattr(accuracy, "clamp", clamp)
    monkeypatch.setattr(accuracy, "estimate", lambda result: {})
    monkeypatch.setattr(accuracy, "measure", measure)
    scene = jc.load_scene("human-lad", TINY)
    with pytest.raises(NotImplementedError):
        accuracy.price_list(scene, told.append)
    assert {event.stage for event in told} == {"accuracy"}
    assert told[1].message == "the scene itself, load-free: closing the open sectors"
    count = 1 + len(accuracy.ladder(scene))
    assert [event.fraction for event in told[1:]] == pytest.approx([0.0, 0.0, 0.5 + 0.5 / count])


@pytest.mark.slow
def test_no_reference_is_exit_code_3(tmp_path, capsys, monkeypatch):
    """A finer mesh without a solution leaves nothing to compare with."""
    refused = lambda rungs, tell: [Price(r.group, r.setting, None, "no equilibrium") for r in rungs]
    monkeypatch.setattr(accuracy, "measure", refused)
    overrides = [part for text in (*TINY, "stop.occlusion=0.5") for part in ("--set", text)]
    assert main(["accuracy", "human-lad", *overrides, "--out", str(tmp_path / "out"), "--quiet"]) == 3
    assert "no reference for the errors" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_price_list_of_a_small_scene(tmp_path, capsys):
    overrides = [part for text in (*TINY, "stop.occlusion=0.5") for part in ("--set", text)]
    assert main(["accuracy", "human-lad", *overrides, "--out", str(tmp_path), "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    solved = [v for v in found["variants"] if v["figures"] is not None]
    assert len(solved) > 20
    assert all(v["memory_MB"] > 100.0 for v in solved)
