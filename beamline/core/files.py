"""Reads only regular files. Writes a file completely or not at all, and replaces an existing file only on request."""

from __future__ import annotations

import codecs
import errno
import math
import os
import platform
import shutil
import stat
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path, PurePosixPath
from typing import BinaryIO, TextIO

from beamline.core.errors import DataError
from beamline.core.text import csv_text

PART = "part-{}"  # The folder of a later part of a resumed scan, in the folder of the run
OURS = 0o755  # Mode of a run's folder: only the owner may replace files in it, whatever the umask is
RUNS = "runs"  # The default folder that contains the folders of runs
SCAN, RECON, REPORT = "scan.h5", "recon.h5", "report.html"  # Files in the folder of a run
JOINED = "joined.h5"  # The file with all parts of a run, next to the file of the first part
CONFIG = "config.resolved.yaml"
TABLE = ".csv"  # Suffix of a table of scans
EVENTS = "events.jsonl"  # The log of events of a run, or of a later part of it, in its folder
RECORD = "state.json"  # The state of a run, or of a later part of it, in its folder
USER_LOG, RECON_LOG = "user.log", "recon.log"
CONTROL, WATCHDOG_LOG = "control", "watchdog.log"
STAMP = "%Y-%m-%dT%H-%M-%S"  # The UTC time at the beginning of the name of a run's folder, before "_"


def create_run_folder(runs: Path, sample: str, seconds: float) -> Path:
    """Create a folder `<UTC time>_<sample>` in `runs`. If this name exists, a number is appended."""
    stem = f"{time.strftime(STAMP, time.gmtime(seconds))}_{sample}"
    runs.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        folder = runs / (stem if number == 1 else f"{stem}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(mode=OURS)
            break
    return folder


def parts_of(run: Path) -> list[Path]:
    """The folders of the parts of a run, in order: the folder of the run itself, and one folder for each time the run
    was resumed."""
    return [run, *(part for _, part in sorted(_numbered(run).items()))]


def run_of(folder: Path) -> Path:
    """The folder of the run to which a folder belongs: the folder itself, or its parent if it is the folder of a later
    part."""
    return folder.parent if folder in parts_of(folder.parent)[1:] else folder


def create_part(run: Path) -> Path:
    """Create the folder of a new part, numbered after the existing parts."""
    folder = run / PART.format(max(_numbered(run), default=1) + 1)
    folder.mkdir(mode=OURS)
    return folder


def _numbered(run: Path) -> dict[int, Path]:
    parts = {part.name.rpartition("-")[2]: part for part in run.glob(PART.format("*")) if not is_link(part)}
    return {int(number): part for number, part in parts.items() if number.isdecimal()}


_NO_SUCH_CALL = (errno.EINVAL, errno.EBADF, errno.ENOTSUP)  # errors of systems and file systems without this call
TEXT = 2**26  # Largest size in bytes of a text file that a user names: the angles of a million projections take 20 MB
_JUNCTION = 0xA0000003  # st_reparse_tag of a mount point of Windows
SETTINGS = 2**20  # Largest size in bytes of a text file of settings: YAML of 1 MB takes seconds to read


def require_regular(path: Path, largest: float = math.inf) -> None:
    """Raise OSError if `path` exists and is not a regular file, or has more bytes than `largest`.

    The reason: opening a pipe may wait for ever, and reading a device may never end.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode):
        kind_text = "It is a folder" if stat.S_ISDIR(status.st_mode) else "It is a device or a pipe"
        raise OSError(errno.EINVAL, f"{kind_text}, but a regular file is expected", str(path))
    if status.st_size > largest:
        raise OSError(errno.EFBIG, f"The file is too large ({status.st_size} bytes, at most {largest:.0f})", str(path))


_DATA = {b"\x89HDF": "an HDF5 file", b"II*\0": "a TIFF file", b"MM\0*": "a TIFF file", b"PK\3\4": "a .zip or .npz file"}


_SUBSTITUTES = {
    b"version https://git-lfs": "only a pointer of Git LFS: run `git lfs pull` to get the file",
    b"\x1f\x8b": "packed by gzip: `gunzip` unpacks it",
    b"<!doctype html": "a web page instead of the data, for example a login page: download the file again",
    b"<html": "a web page instead of the data, for example a login page: download the file again",
}


def refuse_substitute(path: Path) -> None:
    """Raise DataError for a file that does not contain the data itself: it is empty, compressed as a whole, a pointer
    to the data, or a web page."""
    with path.open("rb") as file:
        head = file.read(64).lower()
    reason = (
        "empty" if not head else next((reason for begin, reason in _SUBSTITUTES.items() if head.startswith(begin)), "")
    )
    if reason and not path.name.lower().endswith(".nii.gz"):  # a volume, which can be read in its compressed form
        raise DataError(f"{path} is {reason}. Nothing was read.")


def kind_of_data(path: Path) -> str | None:
    """The kind of data in a file, judged by its first bytes, as part of a sentence; None if the kind is unknown."""
    try:
        with path.open("rb") as file:
            return _DATA.get(file.read(4))
    except OSError:
        return None


def is_link(path: Path) -> bool:
    """True if the path is a symbolic link, or a junction of Windows."""
    try:
        status = path.lstat()
    except OSError:
        return False
    return stat.S_ISLNK(status.st_mode) or getattr(status, "st_reparse_tag", 0) == _JUNCTION


def require_below(folder: Path, name: str, largest: float = math.inf) -> Path:
    """The path of a regular file at a relative path below a folder. It can be given to a library that opens the file by
    its name.

    Use this function for files that other people wrote: the folder itself may be a link, but nothing below the folder.
    Raises OSError as `require_regular` does, or if the file does not exist.
    """
    parts, place = PurePosixPath(name).parts, folder
    for part in parts:
        place /= part
        if part == ".." or PurePosixPath(part).is_absolute() or is_link(place):
            raise OSError(errno.ELOOP, "The file is a link, but only files in the folder itself are read", str(place))
    place.stat()
    require_regular(place, largest)
    return place


def is_below(folder: Path, name: str) -> bool:
    """True if `require_below` accepts the file: the file is not a link, is not a pipe, and belongs to this user."""
    try:
        return require_below(folder, name).is_file()
    except OSError:
        return False


def open_below(folder: Path, name: str, largest: float = math.inf) -> BinaryIO:
    """Open the file that `require_below` finds for reading. A caller must read at most `largest` bytes, because the
    file may grow."""
    return require_below(folder, name, largest).open("rb")


def bytes_below(folder: Path, name: str, largest: int = TEXT) -> bytes:
    """The content of the file that `open_below` opens, but at most `largest` bytes."""
    with open_below(folder, name, largest) as file:
        return file.read(min(largest, os.fstat(file.fileno()).st_size))


def text_in(path: Path, largest: int = TEXT) -> str:
    """The content of a text file of at most `largest` bytes. Raises OSError as `require_regular` does, or if the text
    is not UTF-8.

    A byte-order mark, which some editors write, identifies UTF-16 and is not part of the text.
    """
    require_regular(path, largest)
    try:
        return decoded(path.read_bytes())
    except UnicodeDecodeError as error:
        raise OSError(
            errno.EILSEQ,
            f"The file is not UTF-8 text: byte {error.start} is not valid. Save the file as UTF-8",
            str(path),
        ) from error


def decoded(content: bytes, errors: str = "strict") -> str:
    """Decode the content of a text file, with \n for every kind of line end. A byte-order mark states the encoding.

    Args:
        errors: "replace": bytes that are not text are replaced; "strict": they raise UnicodeDecodeError.
    """
    utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if utf16 else "utf-8-sig", errors).replace("\r\n", "\n").replace("\r", "\n")


def broken_link(path: Path) -> str:
    """A sentence if `path`, or a folder that leads to it, is a link whose target does not exist; "" otherwise."""
    for place in (path, *path.parents):
        if place.is_symlink() and not place.exists():
            return f"{place} is a link to {place.readlink()}, which does not exist: is its disk mounted?"
    return ""


def no_file(path: Path) -> str:
    """A sentence that says that a path does not name a regular file."""
    kind = f"is {'a folder' if path.is_dir() else 'a device or a pipe'}, and a file is expected"
    return broken_link(path) or f"{path} {kind if path.exists() else 'does not exist'}."


# names of temporary files, and of files next to an output, are longer than the name of the output by this number of
# bytes
_BESIDE = 44


def refuse_existing(path: Path) -> None:
    """Raise DataError unless a new file or folder can be created at `path`.

    A result never replaces anything, not even a broken link, and the folder must exist.
    """
    longest = os.pathconf(path.parent, "PC_NAME_MAX") if hasattr(os, "pathconf") and path.parent.is_dir() else 255
    if len(os.fsencode(path.name)) > (most_bytes := longest - _BESIDE):
        n_bytes = len(os.fsencode(path.name))
        raise DataError(
            f"{path}: the name is too long: {n_bytes} bytes, at most {most_bytes} are allowed, because the program "
            "also writes files with longer names next to it (temporary files, the report). Use a shorter name. Nothing "
            "was written."
        )
    if link := broken_link(path):
        raise DataError(
            f"{link} Mount the disk, or name another output, because links are never replaced. Nothing was written."
        )
    if path.exists():
        raise DataError(
            f"{path} exists, and results are never overwritten. Name another output, or move the existing file away."
        )
    if not path.parent.is_dir():
        raise DataError(
            f"The folder {path.parent} does not exist, so {path.name} cannot be written there. Create this folder "
            "first."
        )


def refuse_not_utf8(path: Path | str) -> None:
    """Raise DataError for a path that is not UTF-8, because results could not state it."""
    try:
        str(Path(path).absolute()).encode()
    except UnicodeEncodeError as error:
        raise DataError(
            f"The path {path} contains bytes that are not UTF-8, and the results must state this path in UTF-8. "
            "Rename the file or folder. Nothing was read."
        ) from error


def same_file(first: Path, second: Path) -> bool:
    """Whether two paths name one file, even one that is still to be written.

    Two names that differ only in upper and lower case are one file on the disks of Windows and macOS, and on many USB
    disks. A short-lived file in the folder of `first` tells whether its disk is of that kind.
    """
    names = os.path.realpath(first), os.path.realpath(second)
    if names[0] == names[1] or names[0].casefold() != names[1].casefold():
        return names[0] == names[1]
    with suppress(OSError):
        if first.exists() or second.exists():
            return first.exists() and first.samefile(second)
        probe = first.with_name(f"aB-{uuid.uuid4().hex[:8]}")
        probe.touch(exist_ok=False)
        try:
            return probe.with_name(probe.name.swapcase()).exists()
        finally:
            probe.unlink()
    return os.path.normcase(names[0]) == os.path.normcase(names[1])  # no file can be made there


def replaceable(path: Path) -> Path:
    """The file to replace or create for `path`. If `path` is a link, this is the target of the link.

    Raises DataError if the target does not exist.
    """
    if link := broken_link(path):
        raise DataError(
            f"{link} Mount the disk, or remove the link, because links are never replaced. Nothing was written."
        )
    return path.resolve() if path.is_symlink() else path


def to_disk(handle: int) -> None:
    """Wait until all data written to an open file are on the disk. Raises OSError if the disk failed."""
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SUCH_CALL:
            raise


def bring_to_disk(path: Path) -> None:
    """Wait until a file, or every file in a folder, is on the disk. Raises OSError if the disk failed."""
    for part in path.rglob("*") if path.is_dir() else (path,):
        if part.is_file():
            with part.open("r+b") as file:  # Windows needs a file opened for writing
                to_disk(file.fileno())


@contextmanager
def atomic_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """A context that gives a temporary name next to `path`, for a file or a folder. At the end of the context the file
    is flushed to the disk and renamed to `path`. After an error the file is removed. Files that a killed program left
    for the same `path` are removed first.

    Args:
        path: the file to write. Without `replace` it must not exist. replace: True: an existing file is replaced in one
            step, so that a reader sees either the old or the new file. If `path` is a link, its target is replaced and
            the link stays.

    Raises:
        DataError: `path` exists, the disk fails, or the system does not allow replacing the file.
    """
    if replace:
        path = replaceable(path)
    else:
        refuse_existing(path)
    _remove_remaining(path)
    partial = path.with_name(f".{path.name}.{_here()}-{os.getpid()}-{uuid.uuid4().hex[:4]}.partial")
    try:
        yield partial
        bring_to_disk(partial)
        if not replace:
            refuse_existing(path)
        try:
            partial.replace(path)
        except OSError as error:  # Windows does not replace a file that another program holds open
            raise DataError(f"{path} could not be replaced ({error}); the existing file was not changed.") from error
    except OSError as error:
        what_remains = "the existing file was not changed" if replace else "no incomplete file was left behind"
        raise DataError(
            f"{path} could not be written ({error.strerror or error}). Check the disk; {what_remains}."
        ) from error
    finally:
        # Windows does not remove an open file, and after an error such as a full disk the file is still open
        with suppress(PermissionError):
            remove(partial)


def _here() -> str:
    """An identifier of this machine, on which process numbers are unique."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _remove_remaining(path: Path) -> None:
    """Remove the hidden files that killed programs left next to `path`."""
    with suppress(OSError):
        for entry in [entry for entry in path.parent.iterdir() if entry.name.startswith(f".{path.name}.")]:
            place, _, process = entry.name.removeprefix(f".{path.name}.").rpartition("-")[0].partition("-")
            if entry.suffix == ".partial" and place == _here() and process.isdecimal():
                import psutil  # imported here, because most commands find no such files

                if not psutil.pid_exists(int(process)):
                    remove(entry)


def write_whole(path: Path, content: bytes | str, *, replace: bool = False) -> None:
    """Write a file from memory as `atomic_file` does, and read the file back to verify it. Raises DataError if its
    content differs."""
    data = content.encode() if isinstance(content, str) else content
    with atomic_file(path, replace=replace) as partial:
        partial.write_bytes(data)
        bring_to_disk(partial)
        if partial.read_bytes() != data:
            raise OSError(errno.EIO, "the data that were read back differ from the written data")


def write_table(path: Path, rows: Sequence[Mapping[str, object]], names: Sequence[str] = ()) -> None:
    """Write rows of values by name as a CSV file, which replaces an earlier one; see `text.csv_text`.

    Args:
        names: names of the columns; empty: the names in the first row.
    """
    columns = names or list(rows[0])
    text = csv_text([columns, *([row[name] for name in columns] for row in rows)])
    write_whole(path, text.encode("utf-8", "surrogateescape"), replace=True)


def write_together(writes: Iterable[tuple[Path, Callable[[Path], object]]]) -> None:
    """Write several files, in order, each with its function. Either all files are written, or none."""
    with ExitStack() as undo:
        for path, write in writes:
            write(path)
            undo.callback(remove, path)
        undo.pop_all()


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content, if it exists."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def new_log(path: Path) -> Iterator[TextIO]:
    """A new text file. An error when the file is closed (full disk) is ignored, because it must not hide the error of
    the run itself."""
    file = path.open("x", encoding="utf-8")
    try:
        yield file
    finally:
        with suppress(OSError):
            file.close()
