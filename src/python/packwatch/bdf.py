"""Converts tables of the Battery Data Format in memory, as loaded by ``batterydf``."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ._errors import DataError
from ._packwatch import BDF_COLUMNS, float64

REQUIRED = ("time_s", "current_a", "voltage_v")
"""Columns that the format requires."""
SIGNED = ("current_a", "discharged_ah")
"""Columns whose sign is reversed if a positive current in the table is a charge."""


def from_bdf(table: Any, *, positive: Literal["charge", "discharge"] = "charge") -> dict[str, npt.NDArray[np.float64]]:
    """Returns the columns of a Battery Data Format table with packwatch's names and signs.

    ``table`` is anything that returns a column by its name: a pandas or polars DataFrame, a pyarrow table, a dictionary. The format does
    not state the sign of the current, so ``positive`` states what a positive current means.

    Raises:
        DataError: a required column is missing, a column has no numbers, or ``positive`` is invalid.
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
