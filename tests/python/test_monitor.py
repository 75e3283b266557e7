"""Tests that a Monitor, given rows or frames, produces the same results as a replay, and that bad input raises an error
that names the fault."""

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from conftest import CELL, CONFIG, assert_same_estimates, interrupted, packwatch

import packwatch as pw
from packwatch._packwatch import float64

PAPER = CONFIG / "paper.toml"
PACK = """
[pack]
cells = 3
cell_model = "cells/example_nmc_2600.toml"

[[interface]]
name = "can0"

[input]
dbc = ["pack.dbc"]

[input.current]
signal = "Pack.Current"
positive = "discharge"

[input.cell_voltage]
signal = "Cells.Cell{n}"
first = 1

[[input.temperature]]
signal = "Pack.Temperature"
"""
PACK_DBC = """VERSION ""
NS_ :
BS_:
BU_: BMS
BO_ 256 Pack: 4 BMS
 SG_ Current : 0|16@1- (0.01,0) [-300|300] "A" Vector__XXX
 SG_ Temperature : 16|16@1- (0.1,0) [-40|100] "degC" Vector__XXX
BO_ 257 Cells: 6 BMS
 SG_ Cell1 : 0|16@1+ (0.001,0) [0|6] "V" Vector__XXX
 SG_ Cell2 : 16|16@1+ (0.001,0) [0|6] "V" Vector__XXX
 SG_ Cell3 : 32|16@1+ (0.001,0) [0|6] "V" Vector__XXX
"""


def columns(record):
    return record.time_s, record.current_a, record.voltage_v, record.temperature_c


def together(tables, name):
    return np.concatenate([np.asarray(table[name], dtype="float64") for table in tables])


def test_rows_equal_replay_bit_for_bit(record, tmp_path):
    csv = tmp_path / "estimates.csv"
    packwatch("replay", "-c", PAPER, record.csv, "--estimates", csv)
    monitor = pw.Monitor(PAPER)
    tables = [pa.table(monitor.rows(*columns(record)).estimates), pa.table(monitor.finish().estimates)]
    expected_rows = sum(map(len, tables))
    assert expected_rows == len(csv.read_text().splitlines()) - 1
    whole = pw.replay(PAPER, record.csv).estimates
    assert_same_estimates(whole, csv)
    for name in whole.column_names:
        np.testing.assert_array_equal(together(tables, name), np.asarray(whole[name], dtype="float64"), err_msg=name)


def test_rows_in_portions_equal_one_call(record):
    at_once, portions = pw.Monitor(PAPER), pw.Monitor(PAPER)
    whole = at_once.rows(*columns(record)).estimates
    parts = [portions.rows(*(column[start : start + 700] for column in columns(record))).estimates for start in range(0, 9000, 700)]
    np.testing.assert_array_equal(together(parts, "soc"), whole["soc"])


def test_frames_equal_replay_of_their_log(record, tmp_path):
    csv = tmp_path / "estimates.csv"
    packwatch("replay", "-c", PAPER, record.log, "--estimates", csv)
    frames = [line.split() for line in record.log.read_text().splitlines()]
    time_s = [float(stamp.strip("()")) for stamp, _, _ in frames]
    can_id = [int(frame.split("#")[0], 16) for _, _, frame in frames]
    payload = np.array([list(bytes.fromhex(frame.split("#")[1])) for _, _, frame in frames], dtype="uint8")
    monitor = pw.Monitor(PAPER)
    out = monitor.frames(time_s, can_id, payload)
    assert len(out.frames) > 0 and set(out.frames["interface"]) == {"vcan0"}
    soc = together([out.estimates, monitor.finish().estimates], "soc")
    expected = pw.replay(PAPER, record.log)
    assert_same_estimates(expected.estimates, csv)
    np.testing.assert_array_equal(soc, expected.estimates["soc"])


def test_text_configuration_takes_cells_as_columns(tmp_path):
    (tmp_path / "pack.dbc").write_text(PACK_DBC)
    monitor = pw.Monitor(text=PACK.replace("cells/", f"{CONFIG}/cells/"), folder=tmp_path)
    assert (monitor.cells, monitor.interfaces) == (3, ["can0"])
    time_s = np.arange(600.0)
    voltage_v = np.full((600, 3), [3.9, 3.8, 3.7])
    voltage_v[:, 1] = np.nan
    out = monitor.rows(time_s, np.full(600, 1.0), voltage_v, np.full(600, 25.0)).estimates
    assert set(out["cell"]) == {0, 2}, "a cell without a voltage must have no estimate"
    last = {cell: out["soc"][out["cell"] == cell][-1] for cell in (0, 2)}
    assert last[0] > last[2] > 0.0
    with pytest.raises(pw.DataError, match=r"voltage_v has 1 columns, must have 3 as in the configuration"):
        monitor.rows(time_s, time_s, time_s)


def test_unknown_value_is_null(record):
    out = pw.Monitor(PAPER).rows(record.time_s[:600], np.full(600, np.nan), record.voltage_v[:600]).estimates
    table = pa.table(out)
    assert table["current_a"].null_count == len(table), "no current was given"
    assert np.isnan(out["current_a"]).all() and out["soc_std"][-1] > 0.01
    assert pa.table(out)["u3_v"].null_count == len(table), "the model has fewer branches"


def test_at_most_one_estimate_per_period(record):
    every = pw.Monitor(PAPER).rows(*columns(record)).estimates
    thin = pw.Monitor(PAPER, estimates_period_s=60.0).rows(*columns(record)).estimates
    none = pw.Monitor(PAPER, estimates_period_s=None).rows(*columns(record)).estimates
    assert (len(none), len(thin)) == (0, -(-len(every) // 60))
    np.testing.assert_array_equal(thin["soc"], every["soc"][::60])


def test_time_running_backwards_is_refused(record):
    time_s = np.concatenate([record.time_s[:3000] + 5000.0, record.time_s[:3000]])
    columns = [np.concatenate([column[:3000]] * 2) for column in (record.current_a, record.voltage_v, record.temperature_c)]
    monitor = pw.Monitor(PAPER)
    with pytest.raises(pw.DataError, match=r"time_s\[3000\] = 0, must not be before time_s\[2999\] = 7999"):
        monitor.rows(time_s, *columns)
    monitor.rows(time_s[:3000], *[column[:3000] for column in columns])
    with pytest.raises(pw.DataError, match="must not be before the latest time of the call before = 7999"):
        monitor.rows(time_s[3000:], *[column[3000:] for column in columns])


def test_tables_are_zero_copy_arrow(record):
    out = pw.Monitor(cell=CELL).rows(*columns(record)).estimates
    table = pa.table(out)
    assert table.schema.field("soc").type == pa.float64()
    assert np.shares_memory(table["soc"].chunk(0).to_numpy(), out["soc"]) and np.shares_memory(out["soc"], out["soc"])
    assert list(out.to_pandas().columns) == out.column_names and "soc" in out
    with pytest.raises(KeyError, match="no column charge, found time_s,cell,soc"):
        out["charge"]


def test_arrays_lists_and_arrow_columns_are_equivalent(record):
    few = [column[:300] for column in columns(record)]
    expected = pw.Monitor(PAPER).rows(*few).estimates["soc"]
    objects = [lambda column: np.asarray(column, dtype=object), lambda column: pd.Series(column, dtype="Float64")]
    for form in (list, pa.array, lambda column: column[::-1][::-1], *objects):
        np.testing.assert_array_equal(pw.Monitor(PAPER).rows(*map(form, few)).estimates["soc"], expected)


def test_masked_readings_are_unknown(record):
    few = [column[:300] for column in columns(record)]
    holes = np.arange(300) % 7 == 3
    unknown = [few[0], *(np.where(holes, np.nan, column) for column in few[1:])]
    masked = [few[0], *(np.ma.array(column, mask=holes) for column in few[1:])]
    expected, found = (pw.Monitor(PAPER).rows(*arrays).estimates for arrays in (unknown, masked))
    assert 0 < len(expected) < 300
    for name in expected.column_names:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def test_unaligned_array_is_copied(record):
    few = [column[:300] for column in columns(record)]
    shifted = [np.frombuffer(b"x" + column.tobytes(), offset=1) for column in few]
    assert not shifted[0].flags.aligned
    np.testing.assert_array_equal(pw.Monitor(PAPER).rows(*shifted).estimates["soc"], pw.Monitor(PAPER).rows(*few).estimates["soc"])


@pytest.mark.parametrize("dtype", ["uint16", "int64", "float64", "object"])
def test_frames_accept_any_integer_type(dtype):
    time_s, can_id, data = np.arange(100.0), np.full(100, 0x100), np.full((100, 8), 0x42)
    frames = [pw.Monitor(PAPER).frames(time_s, can_id.astype(of), data.astype(of)) for of in ("uint32", dtype)]
    for name in frames[0].frames.column_names:
        np.testing.assert_array_equal(frames[0].frames[name], frames[1].frames[name])
    assert len(frames[0].frames) > 0


def test_label_alone_is_sufficient(record):
    out = pw.Monitor(chemistry="nmc-graphite", rated_ah=2.6).rows(*columns(record)).estimates
    error, std = abs(out["soc"][-1] - record.soc[-1]), out["soc_std"][-1]
    assert error < 0.15 and error < 4.0 * std, f"{error}, {std}"


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda m: m.rows([0.0, np.nan], [1, 1], [4, 4]), "time_s[1] = NaN, must be a finite number"),
        (lambda m: m.rows([0.0, 1.0], [1], [4, 4]), "current_a has 1 rows, must have 2, like time_s"),
        (lambda m: m.rows([0.0], [1], [4], [25, 26]), "temperature_c has 2 rows, must have 1, like time_s"),
        (lambda m: m.rows([[[0.0]]], [1], [4]), "time_s has 3 dimensions, must have 1 or 2"),
        (lambda m: m.rows(["x"], [1], [4]), "time_s is an array of <U1, must be an array of numbers"),
        (lambda m: m.rows(["1.0"], [1], [4]), "time_s is an array of <U3, must be an array of numbers"),
        (lambda m: m.rows(np.array(["1.0"], dtype=object), [1], [4]), "time_s is an array of str, must be an array of numbers"),
        (lambda m: m.rows([[0.0], [1.0, 2.0]], [1], [4]), "time_s: not an array of numbers: ValueError: "),
        (lambda m: m.rows(pd.Series(pd.date_range("2024-01-01", periods=1, tz="UTC")), [1], [4]), "time_s is an array of Timestamp, must be an array of numbers"),
        (lambda m: m.rows([0.0], [1j], [4]), "current_a is an array of complex128, must be an array of numbers"),
        (lambda m: m.rows([0.0], [[1, 2]], [4]), "current_a has 2 columns, must have 1"),
        (lambda m: m.frames([0.0], [2**32 + 0x100], [[1, 2]]), "can_id[0] = 4294967552, must be a whole number from 0 to 4294967295"),
        (lambda m: m.frames([0.0, 1.0], [1, np.nan], [[1], [2]]), "can_id[1] = NaN, must be a whole number from 0 to 4294967295"),
        (lambda m: m.frames([0.0], [0.5], [[1, 2]]), "can_id[0] = 0.5, must be a whole number from 0 to 4294967295"),
        (lambda m: m.frames([0.0], np.ma.masked_equal([1], 1), [[1, 2]]), "can_id[0] = NaN, must be a whole number from 0 to 4294967295"),
        (lambda m: m.frames([0.0], [[1, 2]], [[1, 2]]), "can_id has 2 columns, must have 1"),
        (lambda m: m.frames([0.0], [1], [[1, 300]]), "data[0, 1] = 300, must be a whole number from 0 to 255"),
        (lambda m: m.frames([0.0], [1], [[1, 2]], length=[-1]), "length[0] = -1, must be a whole number from 0 to 4294967295"),
        (lambda m: m.frames([0.0], [0x800], [[1, 2]]), "can_id[0] = 0x800, must be at most 0x7FF, or"),
        (lambda m: m.frames([0.0], [1], [[1, 2]], length=[3]), "length[0] = 3, must be at most 2, the number of columns of data"),
        (lambda m: m.frames([0.0], [1], [[1]], interface="can7"), 'interface "can7", must be one of vcan0'),
        (lambda m: m.gap(float("inf")), "time_s = inf, must be a finite number"),
        (lambda m: pw.Monitor(), "no configuration; give config, text, cell or chemistry"),
        (lambda m: pw.Monitor(PAPER, folder="config"), "folder needs text"),
        (lambda m: pw.Monitor(PAPER, rated_ah=2.6), "rated_ah needs chemistry"),
        (lambda m: pw.Monitor(cell=CELL, voltage_min_v=2.5), "voltage_min_v needs chemistry"),
        (lambda m: pw.Monitor(text="", chemistry="lfp-graphite", rated_ah=2.6), "text cannot be given with config, cell or chemistry"),
        (lambda m: pw.Monitor(PAPER, sleep_gap_s=0), "sleep_gap_s = 0, must be above 0"),
        (lambda m: pw.Monitor(PAPER, estimates_period_s=-1), "estimates_period_s = -1, must be 0 to 1e9, or None"),
    ],
)
def test_bad_input_names_its_fault(call, text):
    with pytest.raises(pw.DataError) as caught:
        call(pw.Monitor(PAPER))
    assert text in str(caught.value) and isinstance(caught.value, ValueError)


UNIX_S = 1_700_000_000


def test_datetimes_are_unix_times(record):
    seconds = record.time_s[:600] + UNIX_S
    expected = pw.Monitor(PAPER).rows(seconds, record.current_a[:600], record.voltage_v[:600]).estimates
    since = np.timedelta64(1, "ms") * np.round(record.time_s[:600] * 1000).astype(int)
    for unit in ("ms", "us", "ns"):
        stamps = np.datetime64(UNIX_S, "s").astype(f"datetime64[{unit}]") + since
        for given in (stamps, pd.Series(stamps), pd.DatetimeIndex(stamps)):
            found = pw.Monitor(PAPER).rows(given, record.current_a[:600], record.voltage_v[:600]).estimates
            np.testing.assert_allclose(found["time_s"], expected["time_s"], rtol=0, atol=1e-6)
            np.testing.assert_allclose(found["soc"], expected["soc"], rtol=0, atol=1e-6)
    with pytest.raises(pw.DataError, match=r"time_s\[1\] = NaN, must be a finite number"):
        pw.Monitor(PAPER).rows(np.array(["2026-01-01", "NaT"], "datetime64[s]"), [0, 0], [3.9, 3.9])


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds, divide by 1e3"), (1e6, "microseconds, divide by 1e6"), (1e9, "nanoseconds, divide by 1e9")])
def test_time_in_other_unit_names_the_unit(record, factor, unit):
    time_s = (record.time_s + UNIX_S) * factor
    with pytest.raises(pw.DataError, match=rf"time_s\[0\] = 1.*, must be seconds, at most 9.2e9: probably {unit}"):
        pw.Monitor(PAPER).rows(time_s, record.current_a, record.voltage_v)
    with pytest.raises(pw.DataError, match=unit):
        pw.Monitor(PAPER).gap(time_s[0])


def test_time_running_backwards_is_rejected_before_first_row(record):
    monitor, (time_s, current_a, voltage_v) = pw.Monitor(PAPER), columns(record)[:3]
    with pytest.raises(pw.DataError, match=r"time_s\[2\] = 1, must not be before time_s\[1\] = 3"):
        monitor.rows([0.0, 3.0, 1.0], [1.0] * 3, [3.9] * 3)
    soc = monitor.rows(time_s[:700], current_a[:700], voltage_v[:700]).estimates["soc"]
    np.testing.assert_array_equal(soc, pw.Monitor(PAPER).rows(time_s[:700], current_a[:700], voltage_v[:700]).estimates["soc"])
    with pytest.raises(pw.DataError, match=r"time_s\[0\] = .*, must not be before the latest time of the call before = "):
        monitor.rows(time_s[:10], current_a[:10], voltage_v[:10])


def test_readings_in_other_unit_name_the_unit(record):
    time_s, current_a, voltage_v = columns(record)[:3]
    for given, text in [
        ((current_a, voltage_v * 1000), "voltage_v[0] = "),
        ((np.full_like(current_a, 2600.0), voltage_v), "current_a[0] = 2600, must be "),
        ((current_a, voltage_v, np.full_like(current_a, 298.0)), "temperature_c[0] = 298, must be "),
    ]:
        with pytest.raises(pw.DataError) as caught:
            pw.Monitor(PAPER).rows(time_s, *given)
        assert text in str(caught.value) and re.search(": probably (mV|mA|K): ", str(caught.value))
    with pytest.raises(pw.DataError, match="time_s must be seconds, probably ms: the current moves"):
        pw.Monitor(PAPER).rows((time_s - time_s[0]) * 1000, current_a, voltage_v)


def test_monitor_continues_unchanged_after_fault(record):
    monitor = pw.Monitor(PAPER)
    with pytest.raises(pw.DataError):
        monitor.rows(record.time_s, record.current_a[1:], record.voltage_v)
    soc = monitor.rows(*columns(record)).estimates["soc"]
    np.testing.assert_array_equal(soc, pw.Monitor(PAPER).rows(*columns(record)).estimates["soc"])


def test_matching_arrays_are_not_copied():
    reals = np.arange(6.0).reshape(3, 2)
    assert np.shares_memory(float64("x", reals), reals)
    for other in (reals[:, ::-1], reals.astype("float32"), reals.astype(">f8"), np.ma.array(reals)):
        found = float64("x", other)
        assert found.dtype == "float64" and found.flags.c_contiguous and type(found) is np.ndarray
        np.testing.assert_array_equal(found, other)
    assert float64("x", 5).shape == (1,)
    for missing in ([None, 1.0], pd.Series([None, 1.0], dtype="Float64"), pd.Series([None, 1], dtype="Int64"), pa.array([None, 1])):
        np.testing.assert_array_equal(float64("x", missing), [np.nan, 1.0])


def test_empty_input_gives_empty_tables():
    out = pw.Monitor(PAPER).rows([], [], [])
    assert len(out.estimates) == len(out.estimates["soc"]) == len(out.events["event"]) == 0
    assert pa.table(out.frames).num_rows == 0


def long(rows):
    return np.arange(rows, dtype=float), np.full(rows, 0.1), np.full(rows, 3.7)


def test_other_threads_run_during_call():
    monitor, times = pw.Monitor(PAPER, estimates_period_s=None), []
    work = threading.Thread(target=lambda: monitor.rows(*long(400_000)))
    work.start()
    while work.is_alive():
        times.append(time.perf_counter())
        time.sleep(0.001)
    assert len(times) > 20 and max(np.diff(times)) < 0.5 * (times[-1] - times[0]), "the interpreter was blocked"


def test_waiting_call_blocks_no_thread():
    monitor, times = pw.Monitor(PAPER, estimates_period_s=None), []
    work = threading.Thread(target=lambda: monitor.rows(*long(150_000)))
    waits = threading.Thread(target=lambda: monitor.gap(2e5))
    work.start()
    time.sleep(0.1)
    waits.start()
    while waits.is_alive():
        times.append(time.perf_counter())
        time.sleep(0.001)
    work.join()
    assert len(times) > 20 and max(np.diff(times)) < 0.5 * (times[-1] - times[0]), "the interpreter was blocked"


def test_signal_ends_wait_for_other_call():
    monitor = pw.Monitor(PAPER, estimates_period_s=None)
    work = threading.Thread(target=lambda: monitor.rows(*long(200_000)))
    work.start()
    time.sleep(0.1)
    after_s = interrupted(lambda: monitor.gap(3e5), 0.1)
    assert work.is_alive() and after_s < 0.5
    work.join()
    monitor.gap(3e5)


def test_signal_handler_cannot_use_interrupted_monitor():
    monitor, rows = pw.Monitor(PAPER, estimates_period_s=None), long(10_000_000)
    before = signal.signal(signal.SIGALRM, lambda *_: monitor.uncarried_values)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    try:
        with pytest.raises(pw.DataError, match="the Monitor is in use by the call that this signal handler interrupts"):
            monitor.rows(*rows)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert monitor.uncarried_values == 0


def test_results_before_signal_come_with_next_call():
    time_s, current_a, voltage_v = long(20_000_000)
    monitor = pw.Monitor(PAPER, estimates_period_s=60.0)
    interrupted(lambda: monitor.rows(time_s, current_a, voltage_v), after_s=1.5)
    out = monitor.finish().estimates
    again = monitor.finish().estimates
    taken = int(out["time_s"][-1]) + 60
    assert 60 < taken < len(time_s) and len(again) == 0
    whole = pw.Monitor(PAPER, estimates_period_s=60.0).rows(time_s[:taken], current_a[:taken], voltage_v[:taken]).estimates
    np.testing.assert_array_equal(out["soc"], whole["soc"][: len(out)])


def test_monitor_is_unusable_after_internal_failure():
    script = textwrap.dedent(f"""
        import packwatch as pw
        monitor = pw.Monitor({str(PAPER)!r})
        try:
            monitor.rows([0.0], [0.1], [3.7])
        except BaseException as error:
            print(type(error).__name__)
        for call in (monitor.finish, lambda: monitor.uncarried_values, lambda: monitor.rows([0.0], [0.1], [3.7])):
            try:
                call()
            except pw.DataError as error:
                print(error)
    """)
    # No thread can have a stack of this size, so a call that starts a thread panics.
    environment = os.environ | {"RUST_MIN_STACK": str(2**62)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, env=environment)
    text = "an earlier call failed inside packwatch; create a new Monitor"
    assert done.stdout.splitlines() == ["PanicException", text, text, text], done.stderr


def test_progress_is_shown_with_tqdm(capsys):
    pw.Monitor(PAPER, estimates_period_s=None).rows(*long(50_000), progress=True)
    assert "50.0k" in capsys.readouterr().err.split("\r")[-1]


def test_ctrl_c_ends_call(tmp_path):
    script = textwrap.dedent(f"""
        import numpy as np, packwatch as pw
        monitor = pw.Monitor({str(PAPER)!r}, estimates_period_s=None)
        rows = 50_000_000
        columns = np.arange(rows, dtype=float), np.full(rows, 0.1), np.full(rows, 3.7)
        print("begins", flush=True)
        try:
            monitor.rows(*columns)
        except KeyboardInterrupt:
            monitor.rows([1e9], [0.1], [3.7])
            print("interrupted", flush=True)
    """)
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "begins\n"
    time.sleep(0.5)
    begin = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    assert process.communicate(timeout=60)[0] == "interrupted\n"
    assert process.returncode == 0 and time.monotonic() - begin < 10.0
