"""Errors with exit codes. The class of an error says which part failed and whether data are safe. A defect of the
program leaves a traceback."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from beamline.core.installed import installation_problem, version
from drivers.base.errors import DeviceError


class BeamlineError(Exception):
    """An error for the operator. The message says what happened, what was expected, what to do, and what is
    unchanged."""

    exit_code = 1

    __reduce__ = DeviceError.__reduce__


class ConfigError(BeamlineError):
    """An argument or the configuration is wrong. Nothing was started.

    Args:
        faults: the single errors; each error is a pair of the place of the wrong value (`my.yaml:12`) and a sentence
            without a full stop. The list of faults is empty if the message alone describes the error.
    """

    exit_code = 2

    def __init__(self, message: str = "", faults: Sequence[tuple[str, str]] = ()) -> None:
        super().__init__(message)
        self.faults = tuple(faults)


class InstrumentError(BeamlineError):
    """A device failed; the frames acquired so far are in the file."""

    exit_code = 3


class ScanStopped(BeamlineError):  # noqa: N818 - an outcome, not a defect
    """The operator or a check of the monitor stopped the scan before all frames were taken; the file is readable."""

    exit_code = 4


class ReferencesError(ScanStopped):
    """The scan stopped before its first projection, because the darks or flats cannot be used."""

    exit_code = 6


class DataError(BeamlineError):
    """The cause is in the data or on the disk: a file is unreadable, frames are lost, or the disk is full."""

    exit_code = 5


class QualityError(BeamlineError):
    """The work is finished and its result is written, but a quality limit was exceeded."""

    exit_code = 6


class AlarmError(BeamlineError):
    """The work is finished and its result is written, but the monitor raised alarms, because some frames are bad."""

    exit_code = 7


def refuse_wrong_arguments(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Raise ConfigError for an argument whose type differs from the declared one.

    Args:
        values: by name, such as `locals()` in the function's first line.
    """
    from recon.base.declared_types import check_arguments  # imported here, because most commands do not need it

    try:
        check_arguments(function, values)
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was started.") from error


INTERRUPTED = 130


def exit_code(error: BaseException) -> int:
    """The exit code of a command that ends with `error`; 1 means a defect of the program."""
    if isinstance(error, BeamlineError):
        return error.exit_code
    if isinstance(error, DeviceError):
        return InstrumentError.exit_code
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if out_of_memory(error) or damaged(error):
        return DataError.exit_code
    # an OSError without an error number is a defect
    if isinstance(error, OSError) and error.errno not in (None, errno.EPIPE):
        return DataError.exit_code
    return ConfigError.exit_code if installation_problem(error) else BeamlineError.exit_code


def out_of_memory(error: BaseException) -> bool:
    """Whether memory or address space ran out."""
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)


def damaged(error: BaseException) -> bool:
    """Whether HDF5 could not read or follow the content of a file; h5py has no error class for this."""
    message = str(error)
    return isinstance(error, OSError | RuntimeError | KeyError) and "ynchronously" in message and "exist" not in message


def is_defect(error: BaseException) -> bool:
    """Whether the error is a defect of the program rather than of its input."""
    return exit_code(error) == BeamlineError.exit_code and not isinstance(error, BeamlineError)


def user_message(error: BaseException) -> str:
    """The message of `error` for the operator."""
    if out_of_memory(error):
        details = " ".join(str(error).split()) or "no details"
        return (
            f"Out of memory ({details}). Use fewer --rows or --views, a larger --bin, or a smaller --memory (the "
            "volume is then made in slabs). No incomplete result was kept, and existing files were not changed."
        )
    if isinstance(error, OSError) and error.strerror:
        file_text = "" if error.filename is None else f"{error.filename}: "
        return f"{file_text}{error.strerror}. Check the path, the permissions and the disk."
    if damaged(error):
        hdf5_reason = str(error).strip(chr(39))
        return f"The file is damaged: HDF5 says {hdf5_reason!r}. Use a copy of the file, or the original."
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted"
    if not isinstance(error, BeamlineError | DeviceError) and (problem := installation_problem(error)):
        return problem
    if is_defect(error):
        details = " ".join(str(error).split()) or "Python states no reason"
        return f"a defect in this program: {type(error).__name__}: {details}"
    return str(error) or repr(error)


def leave_traceback(error: BaseException, folder: Path) -> Path | None:
    """Write the traceback of a defect to a new file, in `folder` or in the folder for temporary files; None if neither
    folder is writable. If the error already has such a file, this file is kept.
    """
    if (traceback_file := getattr(error, "traceback_file", None)) is not None:
        return Path(traceback_file)
    text = "".join(traceback.format_exception(error))
    for place in (folder, Path(tempfile.gettempdir())):
        with suppress(OSError):
            number, name = tempfile.mkstemp(".log", "beamline-traceback-", place)
            with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(f"splatline {version()}, {sys.version}, {sys.platform}\n{sys.argv}\n{text}")
            error.traceback_file = name  # type: ignore[attr-defined]
            return Path(name)
    return None
