"""Tests `read` on packwatch's CSV and on files of the Battery Data Format, written by that format's own package. In
these files, a positive current is a charge."""

import bdf
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from conftest import CELL

import packwatch as pw


def as_bdf(record) -> pd.DataFrame:
    return pd.DataFrame({
        "Test Time / s": record.time_s,
        "Voltage / V": record.voltage_v,
        "Current / A": -record.current_a,
        "Ambient Temperature / degC": record.temperature_c,
    })  # fmt: skip


def test_own_csv_reads_as_table(record):
    table = pw.read(record.csv)
    assert table.column_names == ["time_s", "current_a", "voltage_v", "temperature_c", "discharged_ah", "part", "type"]
    np.testing.assert_array_equal(table["current_a"], record.current_a)
    assert pa.table(table)["part"].null_count == len(table) == 9000


@pytest.mark.parametrize("ending", ["bdf.csv", "bdf", "bdf.gz"])
def test_bdf_file_gives_same_estimates(record, tmp_path, ending):
    path = tmp_path / f"cell.{ending}"
    bdf.validate(as_bdf(record))
    if ending == "bdf.gz":
        as_bdf(record).to_csv(path, index=False, compression="gzip")
    else:
        as_bdf(record).to_csv(path, index=False)
    table = pw.read(path)
    np.testing.assert_allclose(table["current_a"], record.current_a, atol=1e-12)
    assert np.isnan(table["discharged_ah"]).all()
    columns = [table[name] for name in ("time_s", "current_a", "voltage_v", "temperature_c")]
    soc = pw.Monitor(cell=CELL).rows(*columns).estimates["soc"]
    assert abs(soc[-1] - record.soc[-1]) < 0.05


def test_table_in_memory_has_own_names_and_signs(record):
    frame = as_bdf(record)
    for form in (frame, pa.table(frame), frame.to_dict("list")):
        columns = pw.from_bdf(form)
        assert list(columns) == ["time_s", "current_a", "voltage_v", "temperature_c"]
        np.testing.assert_array_equal(columns["current_a"], record.current_a)
    np.testing.assert_array_equal(pw.from_bdf(frame, positive="discharge")["current_a"], -record.current_a)


def test_masked_column_is_unknown_and_text_is_rejected():
    table = {"Test Time / s": [0.0, 1.0], "Voltage / V": np.ma.array([3.9, 9.9], mask=[False, True]), "Current / A": [1, 2]}
    columns = pw.from_bdf(table)
    np.testing.assert_array_equal(columns["voltage_v"], [3.9, np.nan])
    with pytest.raises(pw.DataError, match="Current / A is an array of <U1, must be an array of numbers"):
        pw.from_bdf(table | {"Current / A": ["1", "2"]})


def test_caller_overrides_sign_of_file(record, tmp_path):
    as_bdf(record).to_csv(tmp_path / "cell.bdf", index=False)
    np.testing.assert_allclose(pw.read(tmp_path / "cell.bdf", bdf_positive="discharge")["current_a"], -record.current_a, atol=1e-12)
    with pytest.raises(pw.DataError, match='bdf_positive "in", must be charge or discharge'):
        pw.read(tmp_path / "cell.bdf", bdf_positive="in")


def test_missing_column_is_named(record, tmp_path):
    with pytest.raises(pw.DataError, match="no column Voltage / V, found Test Time / s,Current / A"):
        pw.from_bdf(as_bdf(record)[["Test Time / s", "Current / A"]])
    (tmp_path / "x.bdf").write_text("Test Time / s,Voltage / V\n0,3.9\n")
    with pytest.raises(pw.DataError, match=r"x.bdf:1: no column for current, found Test Time / s,Voltage / V"):
        pw.read(tmp_path / "x.bdf")
