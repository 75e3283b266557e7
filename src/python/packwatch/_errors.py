"""Exceptions of packwatch. Each carries the error message that the command line prints."""


class PackwatchError(Exception):
    """Base of all exceptions of packwatch."""


class ConfigError(PackwatchError, ValueError):
    """A configuration or a cell model is invalid."""

    faults: list[str]
    """The faults, one per line: ``pack.toml:14: pack.cells = 0, must be 1 to 1024``."""

    def __init__(self, text: str, faults: list[str]) -> None:
        super().__init__(text)
        self.faults = faults


class DataError(PackwatchError, ValueError):
    """Data or arguments cannot be used."""


class FileError(PackwatchError, OSError):
    """A file cannot be read or written."""
