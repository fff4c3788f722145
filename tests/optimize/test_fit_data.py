"""Files of test data: headers and units, and one sentence for whatever is wrong."""

from __future__ import annotations

import numpy as np
import pytest

import jaxclamp as jc
from optimize.fit_data import load_data, loads_data
from optimize.fit_header import understood
from optimize.fit_model import experiment, problem


@pytest.mark.parametrize(
    ("head", "quantity", "factor"),
    [
        ("pressure_mmHg", "pressure", 0.133322387415),
        ("Pressure (mmHg)", "pressure", 0.133322387415),
        ("outer_diameter_um", "outer_radius", 0.5e-3),
        ("radius_external [um]", "outer_radius", 1e-3),
        ("axial_force_g", "reduced_force", 9.80665),
        ("axial_force_wall_mN", "wall_force", 1.0),
        ("axial_stretch", "axial_stretch", 1.0),
        ("circ_cauchy_stress_kPa", "circumferential_cauchy_stress", 1.0),
        ("axial_nominal_stress_MPa", "axial_nominal_stress", 1e3),
    ],
)
def test_headers(head, quantity, factor):
    found = understood(head)
    assert (found.meaning.quantity, found.deviation) == (quantity, False)
    assert found.factor == pytest.approx(factor, rel=1e-12)


def test_a_diameter_is_halved_with_its_deviation():
    data = loads_data("pressure_kPa,outer_diameter_mm,outer_diameter_mm_sd\n1,2.0,0.02\n2,3.0,0.04\n")
    column = data.columns["outer_radius"]
    np.testing.assert_allclose(column.values, [1.0, 1.5])
    np.testing.assert_allclose(column.deviation, [0.01, 0.02])


def test_comments_blank_lines_empty_cells_and_semicolons():
    data = loads_data("# one mouse\npressure_kPa;outer_radius_mm;axial_force_mN\n\n1;1.0;\n2;1.1;3.5\n")
    assert data.rows == 2
    assert np.isnan(data.columns["reduced_force"].values[0])


def test_columns_by_another_name():
    text = "p,OD control\n1,500\n2,510\n"
    data = loads_data(text, "lpa.csv", {"p": "pressure_mmHg", "OD control": "outer_diameter_um"})
    np.testing.assert_allclose(data.columns["outer_radius"].values, [0.25, 0.255])
    assert data.columns["outer_radius"].name == "OD control"


def test_columns_of_groups_wait_to_be_named():
    text = "pressure_mmHg,outer_diameter_um_control,outer_diameter_um_hypoxic\n1,500,510\n2,510,512\n"
    data = loads_data(text, "lpa.csv", {"outer_diameter_um_control": "outer_diameter_um"})
    assert set(data.columns) == {"pressure", "outer_radius"}
    assert data.ignored == (
        "outer_diameter_um_hypoxic (to read it: --column 'outer_diameter_um_hypoxic=outer_diameter_um')",
    )


GOOD = "pressure_kPa,outer_radius_mm\n1,1.0\n2,1.1\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a line of headers"),
        ("pressure_kPa,outer_radius_mm\n", "expected a line of headers"),
        ("pressure,outer_radius_mm\n1,1\n", "a.csv, line 1, column 'pressure': expected a unit in the name"),
        (
            "pressure_mm,outer_radius_mm\n1,1\n",
            "expected the unit of a pressure .* found 'mm', which is of a length",
        ),
        ("pressure_torr,outer_radius_mm\n1,1\n", "expected the unit of a pressure .* found 'torr'"),
        ("pressure_kPa,pressure_mmHg\n1,1\n", "expected pressure once, it is in 'pressure_kPa' as well"),
        ("outer_radius_mm,outer_diameter_mm\n1,2\n", "expected outer radius once"),
        ("axial_stretch_mm,pressure_kPa\n1,1\n", "expected no unit behind axial stretch, found 'mm'"),
        ("time,comment\n1,1\n", "no column is known"),
        (GOOD + "3,abc\n", "a.csv, line 4, column 'outer_radius_mm': expected a number, found 'abc'"),
        (GOOD + "3,nan\n", "line 4, column 'outer_radius_mm': expected a number, found 'nan'"),
        (GOOD + "3\n", "line 4: expected 2 cells as in the headers, found 1"),
        (GOOD + "3,-1\n", "line 4, column 'outer_radius_mm': expected a number above 0"),
        ("pressure_kPa,outer_radius_mm,axial_force_mN_sd\n1,1,1\n", "deviations of what no other column has"),
        (
            "pressure_kPa,pressure_kPa_sd,outer_radius_mm\n1,0,1\n",
            "line 2, .* expected a standard deviation above 0",
        ),
    ],
)
def test_what_is_wrong_with_a_file(text, said):
    with pytest.raises(jc.SceneError, match=said) as found:
        loads_data(text, "a.csv")
    assert "\n" not in str(found.value)


def test_no_such_file(tmp_path):
    with pytest.raises(jc.SceneError, match=r"none\.csv: there is no such file"):
        load_data(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(jc.SceneError, match="expected UTF-8"):
        load_data(tmp_path / "bytes.csv")


def lad(*overrides):
    return jc.load_scene("human-lad", overrides)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("axial_stretch,pressure_kPa\n1,1\n", "expected something to compare beside pressure_kPa"),
        ("axial_stretch\n1\n", "expected pressure and a radius"),
        ("axial_stretch,axial_stress_kPa\n1.1,10\n", r"expected a column 'layer' .*\(media, adventitia\)"),
        (
            "layer,axial_stretch,axial_stress_kPa\nintima,1.1,10\n",
            "expected media or adventitia, found 'intima'",
        ),
        (
            "layer,axial_stretch,circumferential_stress_kPa\nmedia,1.1,1\n",
            "expected a column of the circumferential",
        ),
        ("pressure_kPa,outer_radius_mm\n1,\n2,1.0\n", "row 1 of numbers, column 'outer_radius_mm'"),
    ],
)
def test_what_cannot_be_compared(text, said):
    with pytest.raises(jc.SceneError, match=said):
        experiment(loads_data(text, "a.csv"), lad())


def test_what_a_tube_is_seen_at():
    heads = "pressure_kPa,inner_radius_mm,outer_radius_mm,axial_force_mN,axial_force_wall_mN"
    text = f"{heads}\n1,1,2,3,4\n2,1.1,2.1,3,4\n"
    data = loads_data(text)
    at_radius, at_pressure = (experiment(data, lad(), given) for given in ("radius", "pressure"))
    assert [c.quantity for c in at_radius.compared] == ["inner_radius", "pressure", "reduced_force"]
    assert [c.quantity for c in at_pressure.compared] == ["outer_radius", "inner_radius", "reduced_force"]
    assert at_radius.unused == ("axial_force_wall_mN",)


def test_residuals_leave_empty_cells_out_and_pool_columns_of_one_name():
    one = loads_data("pressure_kPa,outer_radius_mm,axial_force_mN\n1,2.8,\n5,2.9,30\n", "a.csv")
    two = loads_data("outer_radius_mm,pressure_kPa\n2.9,5\n", "b.csv")
    found = problem([experiment(data, lad()) for data in (one, two)])
    assert found.names == ("pressure_kPa", "axial_force_mN")
    np.testing.assert_allclose(found.measured, [1.0, 5.0, 30.0, 5.0])
    assert found.group.tolist() == [0, 0, 1, 0]
    assert found.predicted(lad()).shape == (4,)
