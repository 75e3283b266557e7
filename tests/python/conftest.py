"""What the tests share: the program, its configurations, a simulated record, and measured data if available.

PACKWATCH_BIN: the program, default target/debug/packwatch. PACKWATCH_DATA: measured data. Without it, some tests are
skipped.
"""

import os
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
BINARY = Path(os.environ.get("PACKWATCH_BIN", ROOT / "target/debug/packwatch"))
CONFIG = ROOT / "config"
CELL = CONFIG / "cells/example_nmc_2600.toml"
START_S = 1_700_000_000


@dataclass(frozen=True)
class Record:
    """The record of a simulated cell (config/paper.toml)."""

    log: Path
    csv: Path
    time_s: np.ndarray
    current_a: np.ndarray
    voltage_v: np.ndarray
    temperature_c: np.ndarray
    soc: np.ndarray


def packwatch(*arguments, code: int = 0) -> str:
    """Returns the program's standard output. If it is expected to fail, returns its standard error."""
    done = subprocess.run([BINARY, *map(str, arguments)], capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


@pytest.fixture(scope="session")
def record(tmp_path_factory) -> Record:
    folder = tmp_path_factory.mktemp("record")
    log, truth, csv = folder / "paper.log", folder / "truth.csv", folder / "cell.csv"
    packwatch("simulate", "paper", "-c", CONFIG / "paper.toml", "-o", log, "--truth", truth, "--duration", 9000)
    table = np.genfromtxt(truth, delimiter=",", names=True)
    time_s = table["time_s"] - table["time_s"][0]
    discharged_ah = 2.6 * (1.0 - table["soc"])
    columns = [time_s, table["current_a"], table["voltage_v"], table["temperature_c"], discharged_ah]
    head = "time_s,current_a,voltage_v,temperature_c,discharged_ah"
    np.savetxt(csv, np.column_stack(columns), fmt="%.6f", delimiter=",", header=head, comments="")
    read = np.genfromtxt(csv, delimiter=",", names=True)
    return Record(log, csv, *(read[name] for name in ("time_s", "current_a", "voltage_v", "temperature_c")), table["soc"])


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of measured data."""
    if "PACKWATCH_DATA" not in os.environ:
        pytest.skip("no measured data (PACKWATCH_DATA)")
    return Path(os.environ["PACKWATCH_DATA"])


class Interrupt(Exception):
    """Raised by the signal handler of :func:`interrupted`."""


def interrupted(call: Callable[[], object], after_s: float = 0.3) -> float:
    """Calls `call` and interrupts it with a signal whose handler raises an exception. Returns the seconds from the signal
    to the end of the call."""

    def handle(*_):
        raise Interrupt

    before = signal.signal(signal.SIGALRM, handle)
    signal.setitimer(signal.ITIMER_REAL, after_s)
    begin = time.monotonic()
    try:
        with pytest.raises(Interrupt):
            call()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    return time.monotonic() - begin - after_s


def read_csv(path: Path) -> dict[str, list]:
    """Columns of a CSV of estimates that the program wrote. An empty field is NaN."""
    lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    value = lambda text: {"": float("nan"), "true": True, "false": False}.get(text) if text in ("", "true", "false") else float(text)  # noqa: E731
    return {name: [value(row[column]) for row in rows] for column, name in enumerate(lines[0].split(","))}


def assert_same_estimates(table, path: Path) -> None:
    """Checks that the table equals a CSV that the program wrote, in every bit."""
    expected = read_csv(path)
    assert table.column_names == list(expected)
    assert len(table) == len(expected["time_s"]) > 0
    for name, column in expected.items():
        np.testing.assert_array_equal(np.asarray(table[name], dtype="float64"), np.asarray(column, dtype="float64"), err_msg=name)
