"""Battery health monitoring: the library of packwatch.

Names end with their units (``time_s``, ``current_a``). SOC is a fraction, and positive current is discharge. An unknown value is null in a
table and NaN in an array, never a default number. An error raises an exception with the message that the program ``packwatch`` prints.
"""

from ._errors import ConfigError, DataError, FileError, PackwatchError
from ._packwatch import (
    CellModel,
    Fit,
    GaussianProcess,
    Monitor,
    Outputs,
    Replay,
    Score,
    Table,
    __version__,
    fit,
    read,
    replay,
    rul,
    score,
)
from .bdf import from_bdf

gp = GaussianProcess

__all__ = [
    "CellModel",
    "ConfigError",
    "DataError",
    "FileError",
    "Fit",
    "GaussianProcess",
    "Monitor",
    "Outputs",
    "PackwatchError",
    "Replay",
    "Score",
    "Table",
    "__version__",
    "fit",
    "from_bdf",
    "gp",
    "read",
    "replay",
    "rul",
    "score",
]
