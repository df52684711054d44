"""Atomic files: written completely or not at all, and never over an existing one unless asked; folders of parts."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beamline.core.errors import DataError

PART = "part-{}"
"""The folder of a later part of a scan that was resumed, in that of the run."""
EVENTS = "events.jsonl"
"""What happened in a run, or in a later part of it, in its folder."""


def parts_of(run: Path) -> list[Path]:
    """The folders of a run's parts, in order: its own, and one for each time that it was resumed."""
    return [run, *(part for _, part in sorted(_numbered(run).items()))]


def create_part(run: Path) -> Path:
    """The folder of a new part, after the others."""
    folder = run / PART.format(max(_numbered(run), default=1) + 1)
    folder.mkdir()
    return folder


def _numbered(run: Path) -> dict[int, Path]:
    found = {part.name.rpartition("-")[2]: part for part in run.glob(PART.format("*"))}
    return {int(number): part for number, part in found.items() if number.isdecimal()}


def refuse_existing(path: Path) -> None:
    """Raise DataError where `path` exists (results are never overwritten) or its folder does not."""
    if path.exists():
        raise DataError(f"{path} exists and results are never overwritten. Name another output, or move it away.")
    if not path.parent.is_dir():
        raise DataError(
            f"The folder {path.parent} does not exist, so {path.name} cannot be written there. Create it first."
        )


@contextmanager
def named_on_failure(path: Path) -> Iterator[None]:
    """An OSError while the block writes `path` becomes a DataError with the path, which the system leaves out.

    Raises:
        DataError: instead of OSError.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path} could not be written ({error.strerror or error}). Check the disk.") from error


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """A temporary name beside `path` to write to, a file or a folder. It becomes `path` at the end of the block; an
    error removes it.

    Args:
        path: the file to write. Without `replace` it must not exist.
        replace: an existing file is replaced in one step; a reader sees either the old or the new file.

    Raises:
        DataError: `path` exists, or the system does not allow to replace it.
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
            remove(partial)


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it, if it is there."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def result_folder(folder: Path) -> Iterator[Path]:
    """Make the folder of a result, and in it one to work in, which is gone at the end of the block.

    So is the folder itself where nothing was left in it: an empty one would refuse the next run.
    """
    folder.mkdir()
    work = folder / "work"
    work.mkdir()
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
