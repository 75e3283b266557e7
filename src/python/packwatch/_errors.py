"""Exceptions of packwatch. Each carries the error message that the command line prints."""

import errno
import re


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
    """A file cannot be read or written. ``errno`` is the number of the operating system's error, if it reported one."""


class MissingFileError(FileError, FileNotFoundError):
    """A file does not exist."""


def file_error(text: str) -> FileError:
    """Returns the exception for a message that ends with the number of the operating system's error."""
    found = re.search(r"\(os error (\d+)\)$", text)
    number = int(found[1]) if found else None
    error = MissingFileError(text) if number == errno.ENOENT else FileError(text)
    error.errno = number
    return error
