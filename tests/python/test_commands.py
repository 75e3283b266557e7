"""Tests the Python functions of the commands against the commands: bytes, files, and texts of exceptions."""

import errno
import json
import subprocess

import numpy as np
import pyarrow as pa
import pytest
from conftest import BINARY, CELL, CONFIG, assert_same_estimates, interrupted, packwatch

import packwatch as pw

PAPER = CONFIG / "paper.toml"


def test_score_equals_command(record):
    score = pw.score(record.csv, cell=CELL, settle_s=60)
    assert score.json() == packwatch("score", record.csv, "--cell", CELL, "--settle", "60", "--json")
    assert score.table() == packwatch("score", record.csv, "--cell", CELL, "--settle", "60")
    assert score.scores[0]["soc"]["samples"] == 8940


def test_every_score_case_has_a_plot(record, tmp_path):
    score = pw.score(
        record.csv, cell=CELL, start=["full", "middle"], soc_error_points=[None, -5.0], capacity_error_percent=[0.0, 5.0],
        plots=tmp_path / "plots",
    )  # fmt: skip
    arguments = f"--start full,middle --told none,-5 --capacity-error 0,5 --plot {tmp_path}/plots --json"
    assert score.json() == packwatch("score", record.csv, "--cell", CELL, *arguments.split())
    assert len(score.scores) == 8 and len(list((tmp_path / "plots").glob("*.svg"))) == 8


def assert_last_argument_counts(file, given, options, **known):
    """The result of the call must equal the result of the command. Without its last argument, the call must give
    another result."""
    files = [word for option, path in known.items() for word in (f"--{option}", path)]
    score = pw.score(file, **known, **given)
    assert score.json() == packwatch("score", file, *files, *options.split(), "--json")
    without = dict(list(given.items())[:-1])
    assert score.scores != pw.score(file, **known, **without).scores


@pytest.mark.parametrize(
    ("given", "options"),
    [
        ({"start": "middle"}, "--start middle"),
        ({"start": "middle", "remove": 0.15}, "--start middle --remove 0.15"),
        ({"soc_error_points": [None, -5.0]}, "--told none,-5"),
        ({"soc_error_points": -5.0, "soc_std_points": 6.0}, "--told -5 --soc-std 6"),
        ({"capacity_error_percent": [0.0, 5.0]}, "--capacity-error 0,5"),
        ({"capacity_error_percent": 5.0, "capacity_std_percent": 4.0}, "--capacity-error 5 --capacity-std 4"),
        ({"current_offset_a": 0.05}, "--current-offset 0.05"),
        ({"settle_s": 120.0}, "--settle 120"),
        ({"truth_capacity_ah": 2.5}, "--truth-capacity 2.5"),
        ({"sleep_gap_s": 1000.0}, "--sleep-gap 1000"),
        ({"learn": ["cell.csv"]}, "--learn cell.csv"),
    ],
)
def test_score_arguments_equal_options(record, tmp_path, monkeypatch, given, options):
    monkeypatch.chdir(tmp_path)
    rows = record.csv.read_text().splitlines(keepends=True)
    (tmp_path / "cell.csv").write_text("".join(rows[:3000] + rows[3200:]))  # a gap of 200 s
    assert_last_argument_counts("cell.csv", given, options, cell=CELL)


@pytest.mark.parametrize(
    ("given", "options"),
    [
        ({"load": (2.0, 24.0, 2.7), "threshold_ah": 1.6}, "--load 2,24,2.7 --threshold 1.6"),
        ({"load": (2.0, 24.0, 2.7), "skip_cycles": 50}, "--load 2,24,2.7 --skip-cycles 50"),
        ({"load": (2.0, 24.0, 2.7), "window": (0.4, 0.7)}, "--load 2,24,2.7 --window 0.4,0.7"),
        ({"load": (2.0, 24.0, 2.7), "window": (0.4, 0.7), "seeds": [5]}, "--load 2,24,2.7 --window 0.4,0.7 --seed 5"),
    ],
)
def test_life_arguments_equal_options(data, given, options):
    life, cycles = (data / "nasa_pcoe_aging" / name for name in ("B0005.csv.gz", "B0005_cycles.csv"))
    assert_last_argument_counts(life, given, options, cell=CONFIG / "cells/nasa_b0005.toml", cycles=cycles)


def test_score_of_panasonic_drive_equals_command(data):
    drive = sorted((data / "panasonic_18650pf/25C").glob("HWFTa*"))[0]
    model = CONFIG / "cells/panasonic_18650pf.toml"
    score = pw.score([drive], cell=model)
    assert score.json() == packwatch("score", drive, "--cell", model, "--json")
    assert score.scores[0]["soc"]["rmse_points"] < 2.0


def test_replay_equals_command_files(record, tmp_path):
    csv, events, frames = (tmp_path / name for name in ("estimates.csv", "events.jsonl", "frames.log"))
    printed = packwatch("replay", "-c", PAPER, record.log, "--estimates", csv, "--events", events, "--frames", frames, "--json")
    replay = pw.replay(PAPER, [record.log])
    assert_same_estimates(replay.estimates, csv)
    assert list(replay.events["document"]) == events.read_text().splitlines()
    assert [json.loads(document)["event"] for document in replay.events["document"]] == list(replay.events["event"])
    lines = [f"{interface} {can_id:03X}#{data.hex().upper()}" for interface, can_id, data in
             zip(*(replay.frames[name] for name in ("interface", "can_id", "data")))]  # fmt: skip
    assert lines == [line.split(maxsplit=1)[1] for line in frames.read_text().splitlines()]
    timed = ("wall_s", "times_real_time", "frames_per_s", "cell_steps_per_s", "peak_memory_kib", "estimates")
    without = lambda summary: {key: value for key, value in summary.items() if key not in timed}  # noqa: E731
    assert without(replay.summary) == without(json.loads(printed))


def test_replay_maps_column_names(record, tmp_path):
    csv = tmp_path / "other.csv"
    np.savetxt(csv, np.column_stack([record.time_s, -record.current_a, record.voltage_v]), fmt="%.6f", delimiter=",",
               header="t,I,U", comments="")  # fmt: skip
    replay = pw.replay(PAPER, csv, columns={"time": "t", "current": "I", "voltage": "U"}, csv_sign="charge")
    assert abs(replay.estimates["soc"][-1] - record.soc[-1]) < 0.03


def test_fit_model_equals_command(tmp_path, data):
    drives = sorted((data / "panasonic_18650pf/25C").glob("HWFT*"))
    packwatch("fit", *drives, "--name", "cell", "--capacity", "2.9", "--out", tmp_path / "command.toml")
    fit = pw.fit(drives, "cell", capacity_ah=2.9)
    fit.write(tmp_path / "python.toml")
    assert (tmp_path / "python.toml").read_bytes() == (tmp_path / "command.toml").read_bytes()
    assert fit.capacity_ah == 2.9 and 0.0 < fit.rmse_v < 0.1 and fit.document["converged"] in (True, False)
    assert pw.CellModel(tmp_path / "python.toml").name == "cell"


def histories(folder):
    path = folder / "life.csv"
    rows = "".join(f"{86400 * n},{2.0 - 0.003 * n - 0.00001 * n * n:.6f}\n" for n in range(120))
    path.write_text(f"date,capacity_ah\n{rows}")
    return path


def test_rul_equals_command(tmp_path):
    life = histories(tmp_path)
    assert pw.rul(life, "70 %") == json.loads(packwatch("rul", life, "--end-of-life", "70 %", "--json"))
    judged = pw.rul([life], [1.6, "85%"], at=[0.5, 0.7], alpha=0.1)
    assert judged == json.loads(packwatch("rul", life, "--end-of-life", "1.6,85%", "--at", "50,70", "--alpha", "0.1", "--json"))
    assert len(judged["files"]) == 2


def test_gp_model_equals_command(tmp_path):
    rows = np.random.default_rng(1).uniform(0.0, 6.0, (80, 1))
    output = np.sin(rows[:, 0]) + 0.5
    np.savetxt(tmp_path / "rows.csv", np.column_stack([rows, output]), delimiter=",", header="x,y", comments="", fmt="%.17g")
    packwatch("gpr", "train", tmp_path / "rows.csv", "--output", "y", "--inputs", "x", "--kernel", "matern52", "--out", tmp_path / "model.json")
    process = pw.gp.fit(rows, output, kernel="matern52")
    loaded = pw.gp.load(tmp_path / "model.json")
    assert (loaded.inputs, loaded.output) == (["x"], "y")
    assert process.hyperparameters == loaded.hyperparameters
    at = np.linspace(0.5, 5.5, 11)
    for name in ("mean", "std", "low_95", "high_95"):
        np.testing.assert_array_equal(process.predict(at)[name], loaded.predict(at)[name])
    assert np.abs(process.predict(at)["mean"] - np.sin(at) - 0.5).max() < 0.01
    process.save(tmp_path / "again.json")
    np.testing.assert_array_equal(pw.gp.load(tmp_path / "again.json").predict(at)["mean"], process.predict(at)["mean"])


def test_cell_models_read_evaluate_and_write(tmp_path):
    model = pw.CellModel(CELL)
    table = model.table(np.linspace(0.0, 1.0, 11))
    assert (np.diff(table["ocv_v"]) > 0).all() and (table["r0_ohm"] > 0).all() and "tau1_s" in table
    assert abs(model.soc_of_ocv(table["ocv_v"][3]) - 0.3) < 1e-9
    model.write(tmp_path / "model.toml")
    again = pw.CellModel(tmp_path / "model.toml")
    assert again.capacity_ah == model.capacity_ah == 2.6
    np.testing.assert_allclose(again.table([0.5])["ocv_v"], model.table([0.5])["ocv_v"], rtol=1e-6)
    label = pw.CellModel.of_label("nca-graphite", 2.9)
    assert label.rated_capacity_ah == 2.9 and pa.table(label.table([0.1, 0.9])).num_rows == 2


CSV_FAULT = "time_s,current_a,voltage_v,discharged_ah\n0,1,3.9,0\n1,x,3.9,0\n"


@pytest.mark.parametrize(
    ("kind", "bases", "call", "command"),
    [
        (pw.FileError, OSError, lambda f: pw.score(f / "no.csv", cell=CELL), ["score", "no.csv", "--cell", CELL]),
        (pw.FileError, OSError, lambda f: pw.replay(PAPER, f / "no.log"), ["replay", "-c", PAPER, "no.log"]),
        (pw.FileError, OSError, lambda f: pw.rul(f / "no.csv", 1.4), ["rul", "no.csv", "--end-of-life", "1.4"]),
        (pw.DataError, ValueError, lambda f: pw.fit(f / "bad.csv", "x", branches=4), ["fit", "bad.csv", "--name", "x", "--out", "m.toml", "--branches", "4"]),
        (pw.DataError, ValueError, lambda f: pw.fit(f / "bad.csv", "x", soc_nodes=[0.1, 1.0]), ["fit", "bad.csv", "--name", "x", "--out", "m.toml", "--soc-nodes", "0.1,1"]),
        (pw.FileError, OSError, lambda f: pw.fit(f / "no.csv", "x"), ["fit", "no.csv", "--name", "x", "--out", "m.toml"]),
        (pw.DataError, ValueError, lambda f: pw.score(f / "bad.csv", cell=CELL), ["score", "bad.csv", "--cell", CELL]),
        (pw.DataError, ValueError, lambda f: pw.score(f / "bad.csv", config=f / "pack.toml"), ["score", "bad.csv", "-c", "pack.toml"]),
        (pw.ConfigError, ValueError, lambda f: pw.score(f / "bad.csv", cell=f / "bad.toml"), ["score", "bad.csv", "--cell", "bad.toml"]),
        (pw.ConfigError, ValueError, lambda f: pw.Monitor(f / "bad.toml"), ["replay", "-c", "bad.toml", "no.log"]),
    ],
)
def test_error_text_equals_command(tmp_path, monkeypatch, kind, bases, call, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.csv").write_text(CSV_FAULT)
    (tmp_path / "bad.toml").write_text("[pack]\ncells = 0\n")
    pack = (CONFIG / "example.toml").read_text().replace('"pack96.dbc"', f'"{CONFIG}/pack96.dbc"')
    (tmp_path / "pack.toml").write_text(pack.replace('"cells/', f'"{CONFIG}/cells/'))
    done = subprocess.run([BINARY, *map(str, command)], capture_output=True, text=True, timeout=60)
    assert done.returncode == (78 if kind is pw.ConfigError else 1) and done.stdout == ""
    with pytest.raises(kind) as caught:
        call(type(tmp_path)())
    expected = done.stderr.replace("--branches", "branches").replace("--soc-nodes", "soc_nodes")
    assert isinstance(caught.value, kind) and f"{caught.value}\n" == expected != "\n"
    if kind is pw.FileError:
        assert isinstance(caught.value, FileNotFoundError) and caught.value.errno == errno.ENOENT
    assert issubclass(kind, bases) and issubclass(kind, pw.PackwatchError)
    if kind is pw.ConfigError:
        assert caught.value.faults == str(caught.value).splitlines()


def test_error_text_omits_origin(tmp_path):
    path = tmp_path / "a (os error 2).csv"
    path.write_text(CSV_FAULT)
    with pytest.raises(pw.DataError, match=r"\(os error 2\).csv:3"):
        pw.read(path)
    (tmp_path / "folder.csv").mkdir()
    for call in (pw.read, lambda path: pw.replay(PAPER, path), pw.gp.load):
        with pytest.raises(pw.FileError, match="folder.csv: .*Is a directory") as caught:
            call(tmp_path / "folder.csv")
        assert caught.value.errno == errno.EISDIR and not isinstance(caught.value, FileNotFoundError)


def test_control_bytes_are_escaped_in_exceptions(tmp_path):
    path = tmp_path / "\x1b[31m.csv"
    path.write_text(CSV_FAULT)
    with pytest.raises(pw.DataError) as caught:
        pw.read(path)
    assert "\x1b" not in str(caught.value) and r"\u001b[31m.csv:3" in str(caught.value)
    with pytest.raises(pw.DataError) as caught:
        pw.Monitor(PAPER).frames([0.0], [1], [[1]], interface="\x07")
    assert "\x07" not in str(caught.value)


def test_soc_of_impossible_voltage_is_rejected():
    model = pw.CellModel(CELL)
    assert 1.0 <= model.soc_of_ocv(model.voltage_max_v + 0.01) <= 1.1
    for voltage_v, text in [(9.0, "must be near"), (0.0, "must be near"), (3700.0, "V: probably mV")]:
        with pytest.raises(pw.DataError, match=f"voltage_v = {voltage_v:g}, must be .*{text.split()[-1]}"):
            model.soc_of_ocv(voltage_v)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: pw.score("a.csv"), "no cell: give a configuration, a cell model, or a chemistry with the rated capacity"),
        (lambda: pw.score(["a.csv", "a.csv"], cell=CELL), "a.csv: named twice"),
        (lambda: pw.score("a.csv", cell=CELL, start="end"), 'start "end", must be full or middle'),
        (lambda: pw.score("a.csv", cell=CELL, remove=1.5), "remove = 1.5, must be above 0 and below 1"),
        (lambda: pw.score("a.csv", cell=CELL, settle_s=float("nan")), "settle_s = NaN, must be 0 or more"),
        (lambda: pw.score("a.csv", cell=CELL, capacity_error_percent=-100.0), "capacity_error_percent = -100, must be above -100 and at most 100"),
        (lambda: pw.score("a.csv", cell=CELL, window=(0.7, 0.4)), "window = 0.7, 0.4, must be two parts above 0 and at most 1, the smaller first"),
        (lambda: pw.rul("a.csv", "soon"), 'end_of_life "soon": must be Ah above 0 like 1.4, or percent of the first capacity'),
        (lambda: pw.rul("a.csv", 1.4, at=[1.0]), "at or alpha = 1, must be above 0 and below 1"),
        (lambda: pw.rul("a.csv", 1.4, at=[]), "no at, must be one or more"),
        (lambda: pw.rul("a.csv", []), "no end_of_life, must be one or more"),
        (lambda: pw.rul([], 1.4), "no files, must be one or more"),
        (lambda: pw.replay(PAPER, []), "no logs, must be one or more"),
        (lambda: pw.score([], cell=CELL), "no files, must be one or more"),
        (lambda: pw.score("a.csv", cell=CELL, start=[]), "no start, must be one or more"),
        (lambda: pw.score("a.csv", cell=CELL, soc_error_points=[]), "no soc_error_points, must be one or more"),
        (lambda: pw.score("a.csv", cell=CELL, rated_ah=2.6), "rated_ah needs chemistry"),
        (lambda: pw.score("a.csv", cell=CELL, voltage_max_v=4.1), "voltage_max_v needs chemistry"),
        (lambda: pw.score("a.csv", cell=CELL, seeds=[2]), "seeds needs window"),
        (lambda: pw.score("a.csv", cell=CELL, learn="a.csv", cycles="b.csv"), "learn must not be given together with cycles"),
        (lambda: pw.fit([], "x"), "no files, must be one or more"),
        (lambda: pw.fit("a.csv", "x", tau_s=[10.0, 5.0]), "tau_s: 5 follows 10, must rise"),
        (lambda: pw.fit("a.csv", "x", tau_s=[]), "tau_s has 0 values, must have 1 to 3"),
        (lambda: pw.fit("a.csv", "x", tau_s=[10.0, np.nan]), "tau_s: NaN follows 10, must rise"),
        (lambda: pw.fit("a.csv", "x", tau_s=[-10.0]), "tau_s = -10, must be finite numbers above 0"),
        (lambda: pw.fit("a.csv", "x", branches=0), "branches = 0, must be 1 to 3"),
        (lambda: pw.fit("a.csv", "x", temperatures_c=[]), "temperatures_c has 0 values, must have 1 to 32"),
        (lambda: pw.fit("a.csv", "x", temperatures_c=[np.inf]), "temperatures_c = inf, must be -100 to 200 degrees C"),
        (lambda: pw.fit("a.csv", "x", soc_nodes=[0.0]), "soc_nodes has 1 values, must have 2 to 101"),
        (lambda: pw.fit("a.csv", "x", soc_nodes=[0.0, 0.5, 2.0]), "soc_nodes = 2, must be a list that ends with 1"),
        (lambda: pw.fit("a.csv", "x", ageing_shift=-0.1), "ageing_shift = -0.1, must be 0 to 1"),
        (lambda: pw.fit("a.csv", "x", voltage_min_v=np.nan), "voltage_min_v = NaN, must be a finite number above 0"),
        (lambda: pw.fit("a.csv", "x", voltage_max_v=-4.2), "voltage_max_v = -4.2, must be a finite number above 0"),
        (lambda: pw.fit("a.csv", "x", capacity_ah=0.0), "capacity_ah = 0, must be a finite number above 0"),
        (lambda: pw.fit("a.csv", "x", first_cycles=0), "first_cycles = 0, must be 1 or more"),
        (lambda: pw.fit("a.csv", "x", capacity_ah=2.0, first_cycles=3), "capacity_ah must not be given together with first_cycles"),
        (lambda: pw.gp.fit([[1.0]], [1.0, 2.0]), "output has 2 rows, must have 1, like inputs"),
        (lambda: pw.gp.fit([[1.0]], [[1.0, 2.0]]), "output has 2 columns, must have 1"),
        (lambda: pw.gp.fit([[1.0]], [1.0], basis="cubic"), 'basis "cubic", must be zero, constant or linear'),
        (lambda: pw.CellModel.of_label("lead", 60.0), 'chemistry "lead", must be one of'),
        (lambda: pw.CellModel(CELL).table([[0.1, 0.9]]), "soc has 2 columns, must have 1"),
        (lambda: pw.CellModel(CELL).table([1.5]), "soc contains 1.5, must be fractions from 0 to 1"),
    ],
)
def test_bad_arguments_name_their_fault(call, text):
    with pytest.raises(pw.DataError) as caught:
        call()
    assert text in str(caught.value)


def test_signal_ends_learning_score(record):
    learn = [record.csv] * 3000
    assert interrupted(lambda: pw.score(record.csv, cell=CELL, learn=learn)) < 3.0


def test_signal_ends_forecasts(tmp_path):
    rows = "".join(f"{86400 * n},{2.0 - 0.0002 * n:.6f}\n" for n in range(3000))
    (tmp_path / "life.csv").write_text(f"date,capacity_ah\n{rows}")
    parts = np.linspace(0.01, 0.99, 99)
    assert interrupted(lambda: pw.rul(tmp_path / "life.csv", [1.4 + 0.01 * n for n in range(30)], at=parts)) < 3.0
