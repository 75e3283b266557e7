"""The compiled part: see ``packwatch``."""

from collections.abc import Sequence
from os import PathLike
from typing import Any, Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

_Path: TypeAlias = str | PathLike[str]
_Paths: TypeAlias = _Path | Sequence[_Path]
_Numbers: TypeAlias = Any
"""Anything that NumPy takes as numbers: arrays, Arrow arrays, columns of a table, lists. Masked and missing reals are NaN."""

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
    """Columns of equal length, by name: an Arrow table by the PyCapsule interface, without a copy."""

    @property
    def column_names(self) -> list[str]:
        """Names of the columns."""
    def __len__(self) -> int: ...
    def __contains__(self, name: str, /) -> bool: ...
    def __getitem__(self, name: str, /) -> npt.NDArray[Any]:
        """A column: without a copy where no value is null; null reads as NaN."""
    def to_pyarrow(self) -> Any:
        """A ``pyarrow.Table``, without a copy."""
    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame``; null reads as NaN."""
    def __arrow_c_schema__(self) -> Any: ...
    def __arrow_c_stream__(self, requested_schema: Any | None = None) -> Any: ...

@final
class Outputs:
    """What a monitor has put out."""

    @property
    def estimates(self) -> Table:
        """An estimate per cell and voltage, with the columns of ``packwatch replay --estimates``."""
    @property
    def events(self) -> Table:
        """``time_s``, ``event`` (its name) and ``document`` (JSON, as ``packwatch replay --events`` writes it)."""
    @property
    def frames(self) -> Table:
        """Frames that would be sent: ``time_s``, ``interface``, ``can_id`` (bit 31: extended), ``data``."""

@final
class Monitor:
    """The monitor of a pack: rows or frames in, estimates out.

    The configuration is a file (``config``), a text (``text``, whose files are in ``folder``), or the built-in one of a single cell
    with a cell model (``cell``) or what is on a label (``chemistry``, ``rated_ah``). Of each cell, at most one estimate per
    ``estimates_period_s`` is kept: 0 = every one, ``None`` = none; periods begin again where the clock goes back.

    Calls from several threads take turns. After Ctrl-C, the rows or frames that were taken stay taken, and their outputs come with those
    of the next call. After a failure inside packwatch (``PanicException``), every call raises :class:`DataError`.
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
        sleep_gap_s: float = 30.0,
        estimates_period_s: float | None = 0.0,
    ) -> Monitor: ...
    @property
    def cells(self) -> int:
        """Cells in series."""
    @property
    def interfaces(self) -> list[str]:
        """Names of the interfaces."""
    @property
    def uncarried_values(self) -> int:
        """Values of rows that no configured frame can carry, so far."""
    def rows(
        self,
        time_s: _Numbers,
        current_a: _Numbers,
        voltage_v: _Numbers,
        temperature_c: _Numbers | None = None,
        *,
        progress: bool = False,
    ) -> Outputs:
        """Takes rows: positive current is discharge, NaN is unknown; a column of ``voltage_v`` per cell, of ``temperature_c`` per sensor."""
    def frames(
        self,
        time_s: _Numbers,
        can_id: _Numbers,
        data: _Numbers,
        *,
        length: _Numbers | None = None,
        interface: str | None = None,
        progress: bool = False,
    ) -> Outputs:
        """Takes frames of one interface: bit 31 of ``can_id`` marks an extended one; ``data`` has a row of bytes per frame."""
    def gap(self, time_s: float) -> Outputs:
        """The record continues at ``time_s`` after a gap of unknown length."""
    def finish(self) -> Outputs:
        """Ends the record: its last samples become estimates."""

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
        """The summary that ``packwatch replay --json`` prints."""
    def json(self) -> str:
        """The same as text."""

@final
class Score:
    """Scores of files in cases."""

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``packwatch score --json`` prints."""
    @property
    def scores(self) -> list[dict[str, Any]]:
        """Its part per file and case."""
    def json(self) -> str:
        """The bytes that ``packwatch score --json`` prints."""
    def table(self) -> str:
        """The bytes that ``packwatch score`` prints."""

@final
class Fit:
    """A fitted cell model."""

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``packwatch fit --json`` prints."""
    @property
    def capacity_ah(self) -> float: ...
    @property
    def rmse_v(self) -> float: ...
    @property
    def notes(self) -> list[str]: ...
    @property
    def verdict(self) -> list[str]:
        """What the model is good for."""
    def text(self) -> str:
        """The cell model file."""
    def write(self, path: _Path) -> None:
        """Writes the cell model file, completely or not at all."""

@final
class CellModel:
    """A cell model: open-circuit voltage and resistances over SOC and temperature."""

    def __new__(cls, path: _Path) -> CellModel: ...
    @staticmethod
    def of_label(
        chemistry: str, rated_ah: float, *, voltage_min_v: float | None = None, voltage_max_v: float | None = None
    ) -> CellModel:
        """The model of a cell of which only the label is known."""
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
        """Temperature breakpoints."""
    def table(self, soc: _Numbers, temperature_c: float = 25.0) -> Table:
        """``ocv_v``, ``r0_ohm`` and of each branch ``r1_ohm``, ``tau1_s`` ... at these SOC."""
    def soc_of_ocv(self, voltage_v: float, temperature_c: float = 25.0) -> float:
        """The SOC of an open-circuit voltage."""
    def text(self) -> str:
        """The file's text."""
    def write(self, path: _Path) -> None:
        """Writes the file, completely or not at all."""

@final
class GaussianProcess:
    """A Gaussian process, as ``packwatch gpr`` fits it."""

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
        """Fits a process; ``inputs`` has a row per row of ``output``."""
    @staticmethod
    def load(path: _Path, *, threads: int | None = None) -> GaussianProcess:
        """Loads a model of ``packwatch gpr train`` or of :meth:`save`."""
    def save(self, path: _Path) -> None:
        """Writes the model, completely or not at all."""
    def predict(self, inputs: _Numbers) -> Table:
        """``mean``, ``std`` of a measurement, and its 95 % interval ``low_95``, ``high_95``."""
    @property
    def inputs(self) -> list[str]: ...
    @property
    def output(self) -> str: ...
    @property
    def log_marginal_likelihood(self) -> float: ...
    @property
    def hyperparameters(self) -> list[tuple[str, float]]: ...

def float64(name: str, values: _Numbers) -> npt.NDArray[np.float64]:
    """Values as a contiguous array; masked ones are NaN. ``name`` is for the text of a :class:`packwatch.DataError`."""

def read(path: _Path, *, bdf_positive: Literal["charge", "discharge"] = "charge") -> Table:
    """Reads a measured file, in our CSV or in the Battery Data Format.

    The table has ``time_s``, ``current_a`` (positive = discharge), ``voltage_v``, ``temperature_c``, ``discharged_ah``, ``part``, ``type``.
    """

def replay(
    config: _Path,
    logs: _Paths,
    *,
    columns: dict[str, str] | None = None,
    csv_sign: Literal["discharge", "charge"] = "discharge",
    start_times: _Path | None = None,
    strict: bool = False,
    sleep_gap_s: float = 30.0,
    estimates_period_s: float | None = 0.0,
    progress: bool = False,
) -> Replay:
    """Replays logs, one after another, as ``packwatch replay`` does."""

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
    """Scores measured files against truth, as ``packwatch score`` does; what is not given is as there.

    ``rated_ah``, ``voltage_min_v`` and ``voltage_max_v`` go with ``chemistry``, ``seeds`` with ``window``.
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
    """Fits a cell model to measured files, as ``packwatch fit`` does.

    ``branches`` is 1 to 3; ``tau_s`` has a value per branch. ``tau_s`` and ``temperatures_c`` rise, ``soc_nodes`` from 0 to 1.
    ``first_cycles`` goes without ``ocv`` and ``capacity_ah``.
    """

def rul(
    files: _Paths,
    end_of_life: float | str | Sequence[float | str],
    *,
    at: Sequence[float] | None = None,
    alpha: float = 0.2,
) -> dict[str, Any]:
    """The document of ``packwatch rul --json``; ``at`` are parts of the life, fractions."""
