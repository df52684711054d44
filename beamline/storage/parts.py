"""Parts: a resumed scan has several files. Finds which projections each file contains, and joins the files in one file.

The joined file is an NXtomo of this program whose pixels are virtual (HDF5 virtual datasets, as in the /exchange
view). The joined file contains no frame itself, so it can be made again at any time. The files with the frames are
never changed. The joined file records the name and the number of frames of each part, so that a reader can check that
no part is missing.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.event_lines import LARGEST_LOG, LONGEST
from beamline.core.files import EVENTS, JOINED, SCAN, atomic_file, open_below, parts_of, run_of, same_file
from beamline.core.process import json_object
from beamline.monitor.digest import has_checksum
from beamline.storage import datasets, hdf5
from beamline.storage.frame_table import FrameTable
from beamline.storage.recorded_frames import altered_rows, frames_in, pass_ends_in, record_checksums
from beamline.storage.superblock import superblock
from beamline.storage.writers import layout
from beamline.storage.writers.rows import (
    add_exchange_view,
    ending_in,
    state_ending,
)
from drivers.base.frame import FrameKind

_VIRTUAL = (layout.DATA, layout.PREVIEW)
_READINGS = (f"{layout.BEAM}/time", f"{layout.BEAM}/value")
_MADE_ANEW = (layout.EXCHANGE, layout.IMAGE_KEY_CONTROL, layout.FIELD_OF_VIEW)


def views_planned(file: h5py.File) -> int | None:
    """Number of planned projections of the scan; None if the file does not contain its plan."""
    angles = plan_in(file).get("angles_deg")
    return None if angles is None else len(angles)


def offset_planned(file: h5py.File) -> int:
    """Number of planned offset projections of the scan."""
    plan = plan_in(file)
    kind = "wide" if "wide_views" in plan else "offset"  # name in the files of earlier versions
    return int(plan.get(f"{kind}_views", 0)) * len(plan.get(f"{kind}_places_mm", ()))


def plan_in(file: h5py.File) -> dict[str, Any]:
    """The plan of the scan; empty if the file does not hold it."""
    return json_object(file["/entry/record/plan"].asstr()[()]) or {}


def gaps_in(path: Path, file: h5py.File) -> tuple[int, ...]:
    """Triggers before the last projection that have no frame, found from the frames of the file. This is for files
    whose process was killed.

    None for a file without a plan, and for a later part of a run, because a later part takes the projections that are
    missing in the earlier parts.
    """
    table = frames_in(file)
    views = table.views
    if not views.size or views_planned(file) is None or run_of(path.resolve().parent) != path.resolve().parent:
        return ()
    references = table.of_kind(FrameKind.DARK, FrameKind.FLAT)
    first = references[references < views[0]].max(initial=-1) + 1
    seen = table.triggers[first : views[-1] + 1]
    # triggers of offset projections, and of projections taken again, have higher numbers
    seen = seen[seen < (views_planned(file) or 0)]
    gaps = np.setdiff1d(np.arange(seen.max(initial=0)), seen)
    return tuple((sum(_planned(file, "start").values()) + gaps).tolist())


def end_references_missing(files: Sequence[h5py.File]) -> frozenset[FrameKind]:
    """The kinds of frames (darks, flats) that are planned after the projections, and that are completely or partly
    missing in the files of a scan.

    Args:
        files: all files of the scan, in the order of acquisition.
    """
    taken = _after_views(files)
    return frozenset(kind for kind, n in _planned(files[0], "end").items() if len(taken[kind]) < n)


def _planned(file: h5py.File, when: str) -> dict[FrameKind, int]:
    """Planned numbers of darks and of flats at the "start" or at the "end" of the projections, in the order of
    acquisition at the end.
    """
    plan = plan_in(file)
    fields = {FrameKind.FLAT: plan.get("flats", {}), FrameKind.DARK: plan.get("darks", {})}
    return {kind: int(field["count"]) for kind, field in fields.items() if field.get("at") in (when, "both")}


def _after_views(files: Sequence[h5py.File]) -> dict[FrameKind, set[int]]:
    """Triggers, counted within their block, of the references after the last projection of all files."""
    table = FrameTable.concat([frames_in(file) for file in files])
    after = table.views[-1] if table.views.size else len(table)
    rows = {kind: table.of_kind(kind) for kind in (FrameKind.FLAT, FrameKind.DARK)}
    return {
        kind: set(table.triggers[rows_of_kind[rows_of_kind > after]].tolist()) for kind, rows_of_kind in rows.items()
    }


def join(parts: Sequence[Path], joined: Path) -> int:
    """Create or replace the file that joins the frames of all parts, in this order. Returns the number of frames.

    Args:
        parts: closed files of one scan, each with at least one frame. They are only read.

    Raises:
        DataError: a part cannot be read or was not closed, or the disk failed. An existing joined file is then
            unchanged.
    """
    for part in parts:  # HDF5 reads nothing through a virtual dataset from a file that is marked as being written
        if (head := superblock(part)) is not None and head.open_for_writing:
            raise DataError(
                f"{joined} could not be made, because the file {part} was not closed. The parts were not changed."
            )
    with atomic_file(joined, replace=True) as partial, ExitStack() as opened:
        files = [opened.enter_context(hdf5.open_hdf5(part)) for part in parts]
        try:
            with hdf5.created(partial, layout.LIBVER) as file:
                names = [Path(os.path.relpath(part, joined.parent)).as_posix() for part in parts]
                return _join(files, names, file)
        except hdf5.ALTERED as error:
            raise DataError(
                f"{joined} could not be made ({hdf5.reason(error)}). The parts were not changed."
            ) from error


def other_parts(part: Path) -> list[Path]:
    """The files of the other parts of the same run that may contain frames, whether they are joined or not."""
    part = part.resolve()
    return [file for file in files_with_frames(run_of(part.parent), part.name) if not same_file(file, part)]


def files_with_frames(run: Path, name: str = SCAN) -> list[Path]:
    """The files with this name in the folders of the parts of a run that may contain frames."""
    return [folder / name for folder in parts_of(run) if may_hold_frames(folder / name)]


def may_hold_frames(part: Path) -> bool:
    """True if a part may have frames: its file contains a frame, or its event log, which may be incomplete, mentions
    one.

    A part that ended before its first frame does not count.
    """
    if not part.is_file():
        return False
    with suppress(DataError), hdf5.open_hdf5(part) as file, hdf5.readable(part):
        if file[layout.COMMITTED][()]:
            return True
    with suppress(OSError), open_below(part.parent, EVENTS, LARGEST_LOG) as log:
        return any(b'"event": "frame"' in line for line in iter(lambda: log.readline(LONGEST), b""))
    return True


def joined_file_of(part: Path) -> tuple[Path, int] | None:
    """The file that joins this file with the other parts of the scan, and the number of joined parts. None if no file
    joins them.
    """
    part = part.resolve()
    for folder in (part.parent, part.parent.parent):  # the joined file of the run, or the joined file in a later part
        with suppress(DataError, *hdf5.ALTERED), hdf5.open_hdf5(folder / JOINED) as file:
            names = [source.file_name for source in file[layout.DATA].virtual_sources()]
            if any(same_file(folder / name, part) for name in names):
                return folder / JOINED, len(names)
    return None


def to_join(run: Path) -> str:
    """The end of a sentence that names the command that joins the parts of a run."""
    return f"`beamline recover {run}` joins the existing parts"


def require_joined(file: h5py.File) -> None:
    """Raise DataError if a part to which a joined file refers has changed or is missing.

    A file that contains the frames itself, such as a repacked copy, always passes.
    """
    if layout.PART_STARTS not in file or not file[layout.DATA].is_virtual:
        return
    joined = Path(file.filename)
    if reason := _disagreement(file, joined.parent):
        raise DataError(
            f"{joined} does not have all frames of its scan: {reason}. {to_join(joined.parent)}. If parts "
            "are in another place, copy the whole folder of the run. Nothing was changed."
        )


def is_joined(joined: Path) -> bool:
    """True if this file exists and joins the frames of all parts of its scan."""
    with suppress(DataError), hdf5.open_hdf5(joined) as file, hdf5.readable(joined):
        require_joined(file)
        return True
    return False


def _disagreement(joined: h5py.File, folder: Path) -> str:
    if layout.PARTS not in joined:
        return "it does not list its parts"
    names, frames = (joined[f"{layout.PARTS}/{column}"][()] for column in ("name", "frames"))
    parts = [folder / datasets.text(name) for name in names]
    for part, n in zip(parts, frames, strict=True):
        if not part.is_file():
            return f"its part {part} does not exist"
        with hdf5.open_hdf5(part) as file, hdf5.readable(part):
            committed = int(file[layout.COMMITTED][()])
            if committed != n:
                return f"the part {part} has {committed} frames, but had {n} when the parts were joined"
    others = [other for other in other_parts(parts[0]) if not any(same_file(other, part) for part in parts)]
    return f"the frames of {others[0]} are missing" if others else ""


def _join(files: Sequence[h5py.File], names: Sequence[str], joined: h5py.File) -> int:
    rows = [int(file[layout.COMMITTED][()]) for file in files]
    firsts = np.cumsum([0, *rows])
    grown = layout.growing(files[0])
    values = {path: [file[path][:n] for file, n in zip(files, rows, strict=True)] for path in grown}
    for i, (file, n, first) in enumerate(zip(files, rows, firsts[:-1], strict=True)):
        record = {path: values[path][i] for path in layout.RECORDED}
        replacing = np.setdiff1d(np.flatnonzero(record[layout.REPLACES] >= 0), altered_rows(file, n))
        record[layout.REPLACES][replacing] += first
        values[layout.RECORD_CHECKSUM][i][replacing] = record_checksums(record)[replacing]
    values |= {path: [file[path][()] for file in files] for path in _READINGS if path in files[-1]}
    if layout.PASS_ENDS in files[0]:
        values[layout.PASS_ENDS] = [pass_ends_in(file) + first for file, first in zip(files, firsts, strict=False)]
        values[layout.DECISIONS] = [file[layout.DECISIONS][()] for file in files]
    _copy(files[0]["/"], joined, {path: np.concatenate(parts) for path, parts in values.items()})
    for path in _VIRTUAL:
        item = files[0][path]
        virtual = h5py.VirtualLayout((firsts[-1], *item.shape[1:]), item.dtype)
        for file, name, first, n in zip(files, names, firsts[:-1], rows, strict=True):
            virtual[first : first + n] = h5py.VirtualSource(name, path, file[path].shape)[:n]
        datasets.copy_attributes(item, joined.create_virtual_dataset(path, virtual))
    del joined[layout.END_TIME]
    files[-1].copy(layout.END_TIME, joined, layout.END_TIME)
    state_ending(joined, replace(ending_in(files[-1]), missing=_missing(files)))
    joined[layout.PART_STARTS] = firsts[:-1].astype(np.int64)
    group, text = joined.create_group(layout.PARTS), h5py.string_dtype("utf-8")
    group.attrs["NX_class"] = "NXcollection"
    group.create_dataset("name", data=list(names), dtype=text)
    group.create_dataset("frames", data=np.array(rows, np.int64))
    _complete(files[0], joined, int(firsts[-1]))
    return int(firsts[-1])


def copy_rows(file: h5py.File, n: int, target: hdf5.NewFile) -> tuple[int, ...]:
    """Copy the first `n` rows of a scan file, and everything that is not stored by rows, to a new, closed file.

    Returns:
        the rows whose pixels differ from their checksum. Pixels that cannot be read become zeros.
    """
    _copy(file["/"], target, {path: file[path][:n] for path in layout.growing(file)})
    for path in _VIRTUAL:
        item = file[path]
        maxshape, chunks = (None, *item.shape[1:]), (1, *item.shape[1:])
        copy = target.create_dataset(path, (n, *item.shape[1:]), item.dtype, chunks=chunks, maxshape=maxshape)
        datasets.copy_attributes(item, copy)
        for row in range(n):
            with suppress(*hdf5.ALTERED):
                copy[row] = item[row]
            target.require_taken()
    _complete(file, target, n)
    return tuple(row for row in range(n) if not is_whole(target, row))


def is_whole(file: h5py.File, row: int) -> bool:
    """True if the pixels of a row are as they were written, by their checksum."""
    with suppress(*hdf5.ALTERED):
        return has_checksum(file[layout.DATA][row], int(file["/entry/digest/checksum"][row]))
    return False


def _complete(source: h5py.File, target: h5py.File, n: int) -> None:
    """Add the links of the source file, and the entries that a writer adds after the last of `n` frames."""
    for name, item in source["/entry/data"].items():
        if linked := datasets.attribute(item, "target"):
            target[f"/entry/data/{name}"] = target[linked]
    target[layout.COMMITTED][()], target[layout.FINISHED][()] = n, 1
    target[layout.IMAGE_KEY_CONTROL] = target[layout.KIND]
    layout.state_field_of_view(target)
    add_exchange_view(target)


def _copy(source: h5py.Group, target: h5py.Group, values: dict[str, NDArray[Any]]) -> None:
    """Copy a group. The named datasets get these values. Virtual datasets, datasets made anew, and links are not
    copied.
    """
    datasets.copy_attributes(source, target)
    for name in source:
        path = f"{source.name.rstrip('/')}/{name}"
        if (
            path in _MADE_ANEW
            or path in _VIRTUAL
            or datasets.attribute(item := source[name], "target") not in ("", path)
        ):
            continue
        if isinstance(item, h5py.Group):
            _copy(item, target.create_group(name), values)
        elif path in values:
            datasets.copy_attributes(item, target.create_dataset(name, data=values[path], dtype=item.dtype))
        else:
            source.copy(name, target)


def _missing(files: Sequence[h5py.File]) -> tuple[int, ...]:
    """Triggers that gave no frame, neither in this part nor in a later part."""
    before = sum(_planned(files[0], "start").values())
    stored = {before + view for file in files for view in frames_in(file).numbers_taken()}
    taken, first = _after_views(files), before + (views_planned(files[0]) or 0)
    for kind, n in _planned(files[0], "end").items():
        stored |= {first + trigger for trigger in taken[kind]}
        first += n
    return tuple(sorted({trigger for file in files for trigger in ending_in(file).missing} - stored))
