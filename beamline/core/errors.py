"""Errors with an exit code: each class is one answer to "whose fault is it, and is the data safe?"."""

from __future__ import annotations

import errno

from drivers.errors import DeviceError


class BeamlineError(Exception):
    """A failure the operator can act on: what happened, what was expected, what to do, what is untouched."""

    exit_code = 1


class ConfigError(BeamlineError):
    """Usage or configuration; nothing was started."""

    exit_code = 2


class InstrumentError(BeamlineError):
    """A device failed; what was acquired is in the file."""

    exit_code = 3


class ScanStopped(BeamlineError):  # noqa: N818 - an outcome, not a defect
    """Stopped by the operator with reduced data; the file is complete as far as it goes."""

    exit_code = 4


class DataError(BeamlineError):
    """Bad data or disk: unreadable input, lost frames, no space."""

    exit_code = 5


class QualityError(BeamlineError):
    """Finished, but a quality limit failed; results were written."""

    exit_code = 6


INTERRUPTED = 130


def exit_code(error: BaseException) -> int:
    """The code that a command ends with for `error`; 1 is a defect, whose traceback is wanted."""
    if isinstance(error, BeamlineError):
        return error.exit_code
    if isinstance(error, DeviceError):
        return InstrumentError.exit_code
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    # A closed pipe (`beamline info x | head`) is click's to handle; an OSError without a number is a defect.
    if isinstance(error, OSError) and error.errno not in (None, errno.EPIPE):
        return DataError.exit_code
    return BeamlineError.exit_code


def in_words(error: BaseException) -> str:
    """What the operator is told of `error`."""
    if isinstance(error, OSError) and error.strerror:
        where = "" if error.filename is None else f"{error.filename}: "
        return f"{where}{error.strerror}. Check the path, the permissions and the disk."
    return "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or repr(error)
