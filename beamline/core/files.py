"""Files: read only where regular, written whole or not at all, never over another one unless asked; parts' folders."""

from __future__ import annotations

import errno
import math
import os
import platform
import shutil
import stat
import sys
import uuid
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beamline.core.errors import DataError

PART = "part-{}"
"""The folder of a later part of a scan that was resumed, in that of the run."""
OURS = 0o755
"""Mode of a run's folder: nobody else may put one file in the place of another there, whatever the umask."""
RUNS = "runs"
"""The folder for the folders of runs, where a configuration names no other."""
EVENTS = "events.jsonl"
"""What happened in a run, or in a later part of it, in its folder."""


def parts_of(run: Path) -> list[Path]:
    """The folders of a run's parts, in order: its own, and one for each time that it was resumed."""
    return [run, *(part for _, part in sorted(_numbered(run).items()))]


def create_part(run: Path) -> Path:
    """The folder of a new part, after the others."""
    folder = run / PART.format(max(_numbered(run), default=1) + 1)
    folder.mkdir(mode=OURS)
    return folder


def _numbered(run: Path) -> dict[int, Path]:
    found = {part.name.rpartition("-")[2]: part for part in run.glob(PART.format("*"))}
    return {int(number): part for number, part in found.items() if number.isdecimal()}


_NO_SUCH_CALL = (errno.EINVAL, errno.EBADF, errno.ENOTSUP)  # of systems and file systems that cannot tell


YAML_FAULTS = (ValueError, ArithmeticError, LookupError, TypeError, AttributeError)
"""What PyYAML stumbles over itself, beside its YAMLError: a 13th month, a number of 5000 digits, `!!bool x`."""
TEXT = 2**26
"""Bytes that a text file has at most which a user names: angles of a million views take 20 MB."""
SETTINGS = 2**20
"""Bytes that a text file of settings has at most: YAML of 1 MB takes seconds to read."""


def require_regular(path: Path, largest: float = math.inf) -> None:
    """Raise OSError where `path` is there and is no regular file, or has more bytes than `largest`.

    A pipe makes whoever opens it wait for ever, and a device may never end.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(found.st_mode):
        what = "It is a folder" if stat.S_ISDIR(found.st_mode) else "It is a device or a pipe"
        raise OSError(errno.EINVAL, f"{what}, and a regular file is expected", str(path))
    if found.st_size > largest:
        raise OSError(errno.EFBIG, f"It has {found.st_size} bytes, and at most {largest:.0f} are read", str(path))


def text_in(path: Path, largest: int = TEXT, encoding: str = "utf-8") -> str:
    """The content of a text file of so many bytes at most.

    Raises:
        OSError: as `require_regular`, or it cannot be read. UnicodeDecodeError: it is no such text.
    """
    require_regular(path, largest)
    return path.read_text(encoding=encoding)


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


if sys.platform == "darwin":
    import fcntl

    def _fsync(handle: int) -> None:
        os.fsync(handle)  # which does not wait for the cache in the disk
        fcntl.fcntl(handle, fcntl.F_FULLFSYNC)

else:

    def _fsync(handle: int) -> None:
        os.fsync(handle)


def to_disk(handle: int) -> None:
    """Wait until what was written to an open file is on the disk. OSError where the disk did not take it."""
    try:
        _fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SUCH_CALL:
            raise


def bring_to_disk(path: Path) -> None:
    """Wait until a file, or every file in a folder, is on the disk. OSError where the disk did not take it."""
    for part in path.rglob("*") if path.is_dir() else (path,):
        if part.is_file():
            with part.open("r+b") as file:  # Windows wants a file that may be written
                to_disk(file.fileno())


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """A temporary name beside `path` to write to, a file or a folder. It becomes `path` at the end of the block, when
    it is on the disk; an error removes it. One that a killed program left for the same `path` is removed first.

    Args:
        path: the file to write. Without `replace` it must not exist.
        replace: an existing file is replaced in one step; a reader sees either the old or the new file.

    Raises:
        DataError: `path` exists, the disk refuses, or the system does not allow to replace it.
    """
    if not replace:
        refuse_existing(path)
    _remove_left(path)
    partial = path.with_name(f".{path.name}.{_here()}-{os.getpid()}-{uuid.uuid4().hex[:4]}.partial")
    try:
        yield partial
        bring_to_disk(partial)
        if not replace:
            refuse_existing(path)
        try:
            partial.replace(path)
        except OSError as error:  # Windows replaces no file that another program holds open
            raise DataError(f"{path} could not be put in place ({error}); what was there is untouched.") from error
    except OSError as error:
        left = "what was there is untouched" if replace else "nothing is left of it"
        raise DataError(f"{path} could not be written ({error.strerror or error}). Check the disk; {left}.") from error
    finally:
        with suppress(PermissionError):  # Windows removes no file that is open, as it is after a full disk
            remove(partial)


def _here() -> str:
    """Where the numbers of processes are ours: this machine, and in it this container."""
    try:
        namespace = Path("/proc/self/ns/pid").readlink()
    except OSError:  # not Linux
        namespace = Path()
    return f"{zlib.crc32(f'{platform.node()} {namespace}'.encode()):08x}"


def _remove_left(path: Path) -> None:
    """Remove the hidden files that killed programs left beside `path`."""
    with suppress(OSError):
        for left in [entry for entry in path.parent.iterdir() if entry.name.startswith(f".{path.name}.")]:
            place, _, process = left.name.removeprefix(f".{path.name}.").rpartition("-")[0].partition("-")
            if left.suffix == ".partial" and place == _here() and process.isdecimal():
                import psutil  # here, as most commands find nothing

                if not psutil.pid_exists(int(process)):
                    remove(left)


def write_whole(path: Path, content: bytes | str, *, replace: bool = False) -> None:
    """Write a file that is in memory as `whole_file` does, and compare what is read back.

    Raises:
        DataError: as `whole_file`, or the disk holds something else.
    """
    data = content.encode() if isinstance(content, str) else content
    with whole_file(path, replace=replace) as partial:
        partial.write_bytes(data)
        bring_to_disk(partial)
        if partial.read_bytes() != data:
            raise OSError(errno.EIO, "what is read back is not what was written")


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
