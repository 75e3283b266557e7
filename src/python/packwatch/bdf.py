"""Tables of the Battery Data Format that are in memory already, as ``batterydf`` loads them."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ._errors import DataError
from ._packwatch import BDF_COLUMNS, float64

REQUIRED = ("time_s", "current_a", "voltage_v")
"""Columns that the format requires."""
SIGNED = ("current_a", "discharged_ah")
"""Columns whose sign differs where positive is charge."""


def from_bdf(table: Any, *, positive: Literal["charge", "discharge"] = "charge") -> dict[str, npt.NDArray[np.float64]]:
    """Columns of a table of the Battery Data Format with our names and signs.

    ``table`` is anything that gives a column by its name: a DataFrame of pandas or polars, a table of pyarrow, a dictionary.
    The format does not state the sign of the current; ``positive`` says which way it flows.

    Raises:
        DataError: a required column is missing, a column is no numbers, or ``positive`` is another word.
    """
    if positive not in ("charge", "discharge"):
        raise DataError(f"positive {positive!r}, must be charge or discharge")
    names = getattr(table, "column_names", None)
    present = list(names if names is not None else table.keys() if isinstance(table, dict) else table.columns)
    columns: dict[str, npt.NDArray[np.float64]] = {}
    for ours, label, name in BDF_COLUMNS:
        found = next((known for known in (label, name) if known in present), None)
        if found is not None and ours not in columns:
            column = float64(found, table[found])
            columns[ours] = 0.0 - column if positive == "charge" and ours in SIGNED else column
    for ours in REQUIRED:
        if ours not in columns:
            label = next(label for known, label, _ in BDF_COLUMNS if known == ours)
            raise DataError(f"no column {label}, found {','.join(map(str, present))}")
    return columns
