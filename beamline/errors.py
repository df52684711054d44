"""Errors with an exit code: each class is one answer to "whose fault is it, and is the data safe?"."""

from __future__ import annotations


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
