"""The compiled part of ``packwatch``."""

from collections.abc import Sequence
from os import PathLike
from typing import Any, Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

_Path: TypeAlias = str | PathLike[str]
_Paths: TypeAlias = _Path | Sequence[_Path]
_Numbers: TypeAlias = Any
"""Anything that NumPy reads as numbers: arrays, Arrow arrays, columns of a table, lists. Masked and missing reals become NaN."""
_Times: TypeAlias = Any
"""Seconds, or ``datetime64``, which becomes Unix time. Times must not run backwards."""

__all__ = [
    "BDF_COLUMNS",
    "CellModel",
    "Fit",
    "GaussianProcess",
    "Monitor",
    "Outputs",
    "Replay",
    "Score",
    "Table",
    "__version__",
    "fit",
    "float64",
    "read",
    "replay",
    "rul",
    "score",
]

__version__: str
BDF_COLUMNS: list[tuple[str, str, str]]

@final
class Table:
    """Columns of equal length by name: an Arrow table that other libraries read without a copy (PyCapsule interface)."""

    @property
    def column_names(self) -> list[str]:
        """Names of the columns."""
    def __len__(self) -> int: ...
    def __contains__(self, name: str, /) -> bool: ...
    def __getitem__(self, name: str, /) -> npt.NDArray[Any]:
        """Returns a column, without a copy if it has no nulls; null becomes NaN."""
    def to_pyarrow(self) -> Any:
        """Returns a ``pyarrow.Table`` without a copy."""
    def to_pandas(self) -> Any:
        """Returns a ``pandas.DataFrame``; null becomes NaN."""
    def __arrow_c_schema__(self) -> Any: ...
    def __arrow_c_stream__(self, requested_schema: Any | None = None) -> Any: ...

@final
class Outputs:
    """The outputs of a monitor."""

    @property
    def estimates(self) -> Table:
        """Estimates per cell and voltage, with the columns of ``packwatch replay --estimates``."""
    @property
    def events(self) -> Table:
        """Events: ``time_s``, ``event`` (its name) and ``document`` (JSON, as in ``packwatch replay --events``)."""
    @property
    def frames(self) -> Table:
        """Frames to be sent: ``time_s``, ``interface``, ``can_id`` (bit 31: extended), ``data``."""

@final
class Monitor:
    """The monitor of a pack. It processes rows or frames, and returns estimates.

    The configuration is a file (``config``), or a text (``text``; files that it names are relative to ``folder``). For a single cell it may
    also be built in; the cell is then described by a cell model (``cell``) or by a label (``chemistry``, ``rated_ah``).

    In each period of ``estimates_period_s``, at most one estimate per cell is kept. 0 keeps all estimates, ``None`` keeps no estimates.
    Periods start again if the clock goes back.

    Calls from several threads wait for each other. After Ctrl-C, rows or frames already processed stay processed, and their outputs come
    with the next call. After a failure inside packwatch (``PanicException``), every call raises :class:`DataError`.
    """

    def __new__(
        cls,
        config: _Path | None = None,
        *,
        text: str | None = None,
        folder: _Path | None = None,
        cell: _Path | None = None,
        chemistry: str | None = None,
        rated_ah: float | None = None,
        voltage_min_v: float | None = None,
        voltage_max_v: float | None = None,
        sleep_gap_s: float | None = None,
        estimates_period_s: float | None = 0.0,
    ) -> Monitor: ...
    @property
    def cells(self) -> int:
        """Number of cells in series."""
    @property
    def interfaces(self) -> list[str]:
        """Names of the interfaces."""
    @property
    def uncarried_values(self) -> int:
        """Number of values, in all rows already processed, that no configured frame can carry."""
    def rows(
        self,
        time_s: _Times,
        current_a: _Numbers,
        voltage_v: _Numbers,
        temperature_c: _Numbers | None = None,
        *,
        progress: bool = False,
    ) -> Outputs:
        """Processes rows. Positive current is discharge, NaN is unknown. ``voltage_v`` has a column per cell, ``temperature_c`` per sensor."""
    def frames(
        self,
        time_s: _Times,
        can_id: _Numbers,
        data: _Numbers,
        *,
        length: _Numbers | None = None,
        interface: str | None = None,
        progress: bool = False,
    ) -> Outputs:
        """Processes frames of one interface. Bit 31 of ``can_id`` marks an extended identifier; ``data`` has a row of bytes per frame."""
    def gap(self, time_s: float) -> Outputs:
        """Continues the record at ``time_s`` after a gap of unknown length."""
    def finish(self) -> Outputs:
        """Ends the record, so that the last samples become estimates."""

@final
class Replay:
    """Results of a replay."""

    @property
    def outputs(self) -> Outputs: ...
    @property
    def estimates(self) -> Table: ...
    @property
    def events(self) -> Table: ...
    @property
    def frames(self) -> Table: ...
    @property
    def summary(self) -> dict[str, Any]:
        """The summary of ``packwatch replay --json``."""
    def json(self) -> str:
        """The summary as JSON text."""

@final
class Score:
    """Scores of files and cases."""

    @property
    def document(self) -> dict[str, Any]:
        """The document of ``packwatch score --json``."""
    @property
    def scores(self) -> list[dict[str, Any]]:
        """The scores in the document, one dictionary per file and case."""
    def json(self) -> str:
        """The output of ``packwatch score --json``."""
    def table(self) -> str:
        """The output of ``packwatch score``."""

@final
class Fit:
    """A fitted cell model."""

    @property
    def document(self) -> dict[str, Any]:
        """The document of ``packwatch fit --json``."""
    @property
    def capacity_ah(self) -> float: ...
    @property
    def rmse_v(self) -> float: ...
    @property
    def notes(self) -> list[str]: ...
    @property
    def verdict(self) -> list[str]:
        """Statements on the accuracy of the model, as ``packwatch fit`` prints them at the end."""
    def text(self) -> str:
        """Returns the text of the cell model file."""
    def write(self, path: _Path) -> None:
        """Writes the cell model file atomically."""

@final
class CellModel:
    """A cell model: open-circuit voltage and resistances over SOC and temperature."""

    def __new__(cls, path: _Path) -> CellModel: ...
    @staticmethod
    def of_label(
        chemistry: str, rated_ah: float, *, voltage_min_v: float | None = None, voltage_max_v: float | None = None
    ) -> CellModel:
        """Returns the model of a cell from its label alone."""
    @property
    def name(self) -> str: ...
    @property
    def capacity_ah(self) -> float: ...
    @property
    def rated_capacity_ah(self) -> float: ...
    @property
    def voltage_min_v(self) -> float: ...
    @property
    def voltage_max_v(self) -> float: ...
    @property
    def soc(self) -> list[float]:
        """SOC breakpoints, fractions."""
    @property
    def temperature_c(self) -> list[float]:
        """Temperature breakpoints, degrees C."""
    def table(self, soc: _Numbers, temperature_c: float = 25.0) -> Table:
        """Returns a row per SOC: ``ocv_v``, ``r0_ohm``, and ``r1_ohm``, ``tau1_s`` and so on for the branches."""
    def soc_of_ocv(self, voltage_v: float, temperature_c: float = 25.0) -> float:
        """Returns the SOC at an open-circuit voltage, a fraction."""
    def text(self) -> str:
        """Returns the text of the cell model file."""
    def write(self, path: _Path) -> None:
        """Writes the cell model file atomically."""

@final
class GaussianProcess:
    """A Gaussian process, as fitted by ``packwatch gpr``."""

    @staticmethod
    def fit(
        inputs: _Numbers,
        output: _Numbers,
        *,
        kernel: str = "exponential",
        basis: Literal["zero", "constant", "linear"] = "constant",
        ard: bool = False,
        restarts: int = 0,
        max_iterations: int = 60,
        seed: int = 1,
        names: Sequence[str] | None = None,
        output_name: str = "output",
        threads: int | None = None,
        progress: bool = False,
    ) -> GaussianProcess:
        """Fits a process. ``inputs`` has as many rows as ``output``."""
    @staticmethod
    def load(path: _Path, *, threads: int | None = None) -> GaussianProcess:
        """Loads a model written by ``packwatch gpr train`` or :meth:`save`."""
    def save(self, path: _Path) -> None:
        """Writes the model atomically."""
    def predict(self, inputs: _Numbers) -> Table:
        """Returns ``mean`` and ``std`` of a measurement at each row, and the 95 % interval from ``low_95`` to ``high_95``."""
    @property
    def inputs(self) -> list[str]: ...
    @property
    def output(self) -> str: ...
    @property
    def log_marginal_likelihood(self) -> float: ...
    @property
    def hyperparameters(self) -> list[tuple[str, float]]: ...

def float64(name: str, values: _Numbers) -> npt.NDArray[np.float64]:
    """Returns a contiguous array; masked values become NaN. Error messages call the array ``name``."""

def read(path: _Path, *, bdf_positive: Literal["charge", "discharge"] = "charge") -> Table:
    """Reads a measured file, in packwatch's CSV or in the Battery Data Format.

    The table has ``time_s``, ``current_a`` (positive = discharge), ``voltage_v``, ``temperature_c``, ``discharged_ah``, ``part``, ``type``.
    """

def replay(
    config: _Path,
    logs: _Paths,
    *,
    columns: dict[str, str] | None = None,
    csv_sign: Literal["discharge", "charge"] | None = None,
    start_times: _Path | None = None,
    strict: bool = False,
    sleep_gap_s: float | None = None,
    estimates_period_s: float | None = 0.0,
    progress: bool = False,
) -> Replay:
    """Replays logs as one record, like ``packwatch replay``."""

def score(
    files: _Paths,
    *,
    config: _Path | None = None,
    cell: _Path | None = None,
    chemistry: str | None = None,
    rated_ah: float | None = None,
    voltage_min_v: float | None = None,
    voltage_max_v: float | None = None,
    learn: _Paths | None = None,
    start: str | Sequence[str] | None = None,
    remove: float | None = None,
    soc_error_points: float | Sequence[float | None] | None = None,
    soc_std_points: float | None = None,
    capacity_error_percent: float | Sequence[float] | None = None,
    capacity_std_percent: float | None = None,
    current_offset_a: float | Sequence[float] | None = None,
    settle_s: float | None = None,
    truth_capacity_ah: float | None = None,
    sleep_gap_s: float | None = None,
    cycles: _Paths | None = None,
    load: Sequence[float] | None = None,
    threshold_ah: float | None = None,
    skip_cycles: int | None = None,
    window: tuple[float, float] | None = None,
    seeds: Sequence[int] | None = None,
    plots: _Path | None = None,
    progress: bool = False,
) -> Score:
    """Scores measured files against the truth, like ``packwatch score``; defaults are the same.

    ``rated_ah``, ``voltage_min_v`` and ``voltage_max_v`` need ``chemistry``; ``seeds`` needs ``window``.
    """

def fit(
    files: _Paths,
    name: str,
    *,
    ocv: _Paths | None = None,
    capacity_ah: float | None = None,
    rated_ah: float | None = None,
    voltage_min_v: float | None = None,
    voltage_max_v: float | None = None,
    ageing_shift: float | None = None,
    branches: int | None = None,
    tau_s: Sequence[float] | None = None,
    temperatures_c: Sequence[float] | None = None,
    soc_nodes: Sequence[float] | None = None,
    first_cycles: int | None = None,
    progress: bool = False,
) -> Fit:
    """Fits a cell model to measured files, like ``packwatch fit``.

    ``branches`` is 1 to 3; ``tau_s`` has a value per branch. ``tau_s`` and ``temperatures_c`` are ascending, ``soc_nodes`` ascends from
    0 to 1. ``first_cycles`` cannot be given with ``ocv`` or ``capacity_ah``.
    """

def rul(
    files: _Paths,
    end_of_life: float | str | Sequence[float | str],
    *,
    at: Sequence[float] | None = None,
    alpha: float = 0.2,
) -> dict[str, Any]:
    """Returns the document of ``packwatch rul --json``. ``at`` contains points of the life, as fractions."""
