"""Structure: the objects of an HDF5 file and the other files that it draws on, looked at before any of them is opened.

HDF5 opens whatever a link names: it waits for ever for a pipe, and for names of deeply nested groups.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py

from beamline.core.errors import DataError
from beamline.core.files import require_regular
from beamline.storage.header import PACKED

MOST_OBJECTS, DEEPEST, FILES = 50_000, 64, 64
CLAIMED = 1e9  # bytes
_HEAD = 4096  # bytes that tell text
_DAMAGED = (OSError, RuntimeError, LookupError, TypeError, ValueError)  # as h5py says it: nobody can follow that


def require_harmless(file: h5py.File) -> None:
    """DataError for a file with more objects or deeper groups than any scan. Also for one that draws on a path without
    a file, or that claims more data than it has.

    Files that it draws on are looked at, too, and those that they draw on.
    """
    path = Path(file.filename)
    seen, waiting = {path.resolve()}, _looked_at(file, path)
    while waiting:
        path = waiting.pop()
        if path.resolve() in seen:
            continue
        seen.add(path.resolve())
        if len(seen) > FILES:
            raise DataError(
                f"{file.filename} links to more than {FILES} files, directly or through others. Nothing was read."
            )
        with suppress(*_DAMAGED), h5py.File(path, "r", locking=False) as other:
            waiting += _looked_at(other, path)


def require_inside(file: h5py.File) -> None:
    """Raise DataError if a file links to one outside of its folder."""
    path = Path(file.filename)
    for other in _looked_at(file, path):
        if path.resolve().parent not in other.resolve().parents:
            raise DataError(
                f"{path} links to {other}, outside of its folder. Name the file itself to have that read, too."
            )


def _places(name: str, path: Path) -> Iterator[Path]:
    """Where HDF5 looks for a file that another names: as it is named, beside that, and by its last part beside it."""
    for place in (Path(name), path.parent / name, path.parent / Path(name).name):
        with suppress(ValueError):  # a name that no file can have
            if os.path.lexists(place):
                yield place


def _looked_at(file: h5py.File, path: Path) -> list[Path]:
    """The regular files that a file draws on; DataError where one is something else."""
    files = dict[Path, None]()
    for name in dict.fromkeys(_names(file, path)):
        for place in _places(name, path):
            with suppress(ValueError):
                if place.is_dir():
                    continue
                try:
                    require_regular(place)
                except OSError as error:
                    raise DataError(
                        f"{path} links to {name}, which no scan does ({error.strerror}). Nothing was read."
                    ) from error
                files[place] = None
    return [*files]


def _names(file: h5py.File, path: Path) -> Iterator[str]:
    """The other files that links and datasets name."""
    groups, known = [(h5py.h5g.open(file.id, b"/"), 0)], set[tuple[int, int]]()
    while groups:
        group, depth = groups.pop()
        links: list[tuple[bytes, int]] = []
        with suppress(*_DAMAGED):
            _list(group, links)
        if len(known) + len(links) > MOST_OBJECTS or depth > DEEPEST:
            raise DataError(
                f"{path} has more than {MOST_OBJECTS} objects, or groups more than {DEEPEST} deep: it is no scan or "
                "volume. Nothing was read."
            )
        for name, kind in links:
            with suppress(*_DAMAGED):
                if kind == h5py.h5l.TYPE_EXTERNAL:
                    yield os.fsdecode(group.links.get_val(name)[0])
                elif kind == h5py.h5l.TYPE_HARD:
                    info = h5py.h5o.get_info(group, name)
                    if (info.fileno, info.addr) in known:
                        continue
                    known.add((info.fileno, info.addr))
                    if info.type == h5py.h5o.TYPE_GROUP:
                        groups.append((h5py.h5g.open(group, name), depth + 1))
                    elif info.type == h5py.h5o.TYPE_DATASET:
                        dataset = h5py.h5d.open(group, name)
                        _refuse_empty_claim(dataset, f"{path}: {name.decode('utf-8', 'replace')}")
                        _refuse_foreign_bytes(dataset, path, name.decode("utf-8", "replace"))
                        yield from _drawn_on(dataset)


def _list(group: Any, links: list[tuple[bytes, int]]) -> None:
    def take(name: bytes, info: Any) -> bool | None:
        links.append((name, info.type))
        return True if len(links) > MOST_OBJECTS else None

    group.links.iterate(take, info=True)


def _refuse_empty_claim(dataset: Any, what: str) -> None:
    """DataError for a dataset of more bytes than any compression makes of what is stored of it."""
    n = math.prod(dataset.shape or ()) * dataset.dtype.itemsize
    if n < CLAIMED or dataset.get_create_plist().get_layout() == h5py.h5d.VIRTUAL:
        return
    if n > PACKED * (stored := dataset.get_storage_size()):
        raise DataError(f"{what} claims {n / 1e9:.3g} GB, but only {stored} bytes are there. Nothing was read.")


def _refuse_foreign_bytes(dataset: Any, path: Path, name: str) -> None:
    """DataError for values in a file of any kind (HDF5's external storage), unless they are numbers, and that file is
    below the folder of this one, is not hidden and is no text: so it may hold images, and it is no file of others."""
    made = dataset.get_create_plist()
    for i in range(made.get_external_count()):
        other, root = os.fsdecode(made.get_external(i)[0]), path.resolve().parent
        for place in _places(other, path):
            within = place.resolve()
            inside = root in within.parents and not any(part.startswith(".") for part in within.relative_to(root).parts)
            if dataset.dtype.kind not in "uif" or not inside or _is_text(within):
                raise DataError(
                    f"{path} keeps the values of {name} in the file {other}. Only numbers are read from such a file, "
                    "one that lies below the folder of the scan and is no text. Nothing was read."
                )


def _is_text(path: Path) -> bool:
    """Whether a regular file begins as text does; pixels hardly ever do."""
    try:
        require_regular(path)
        with path.open("rb") as file:
            head = file.read(_HEAD)
        text = head.decode("utf-8") if len(head) < _HEAD else head[: head.rfind(b"\n") + 1].decode("utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    return bool(text) and all(c.isprintable() or c.isspace() for c in text)


def _drawn_on(dataset: Any) -> Iterator[str]:
    made = dataset.get_create_plist()
    if made.get_layout() == h5py.h5d.VIRTUAL:
        for i in range(min(made.get_virtual_count(), MOST_OBJECTS)):
            if (name := made.get_virtual_filename(i)) != ".":
                yield name
    for i in range(made.get_external_count()):
        yield os.fsdecode(made.get_external(i)[0])
