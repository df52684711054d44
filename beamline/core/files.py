"""Files that are written whole or not at all, and never over another."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beamline.core.errors import DataError


def refuse_existing(path: Path) -> None:
    """Raise DataError where `path` exists (results are never overwritten) or its folder does not."""
    if path.exists():
        raise DataError(f"{path} exists and results are never overwritten. Name another output, or move it away.")
    if not path.parent.is_dir():
        raise DataError(
            f"The folder {path.parent} does not exist, so {path.name} cannot be written there. Make it first."
        )


@contextmanager
def named_on_failure(path: Path) -> Iterator[None]:
    """What the disk refuses while the block writes `path` is told with its name, which a full disk leaves out.

    Raises:
        DataError: instead of OSError.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path} could not be written ({error.strerror or error}). Check the disk.") from error


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """A temporary sibling to write to; it becomes `path` when the block ends well and vanishes when it does not.

    Args:
        path: the file to make. Without `replace` it must not exist.
        replace: put it in place of an older one, in one step; a reader sees either the old or the new file, whole.

    Raises:
        DataError: `path` is in the way, or the system does not let it be replaced.
    """
    if not replace:
        refuse_existing(path)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        if not replace:
            refuse_existing(path)
        try:
            partial.replace(path)
        except OSError as error:  # Windows replaces no file that another program holds open
            raise DataError(f"{path} could not be put in place ({error}); what was there is untouched.") from error
    finally:
        with suppress(PermissionError):  # Windows removes no file that is open, as it is after a full disk
            partial.unlink(missing_ok=True)
