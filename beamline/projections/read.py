"""Reading: pixels of a scan, binned while they are read, and the means of its reference frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Warn
from beamline.core.text import count, spans
from beamline.projections.corrections.defects import Defects
from beamline.projections.corrections.flags import Flags
from beamline.projections.corrections.flats import Flats
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules.references import ReferenceGroups
from drivers.base.frame import FrameKind
from recon.prep.correct import References
from recon.prep.defects import dead_pixels
from recon.prep.dynamic_flats import find_dynamic_flats

_BATCH_BYTES = 64 * 2**20  # raw pixels read at a time


def read_binned(
    source: ScanSource,
    frames: NDArray[np.int64],
    rows: slice,
    binning: int,
    progress: Callable[[int, int], None] = lambda n, total: None,
) -> NDArray[Any]:
    """Frames [frame, row, col], binned by averaging while they are read; NaN stays out of the averages.

    Whole counts that are not binned keep their type (half the memory), everything else becomes float32. Trailing
    columns that do not fill a bin go.
    """
    height, width = (rows.stop - rows.start) // binning, source.shape[1] // binning
    whole = binning == 1 and source.dtype.kind in "ui"
    out = np.empty((len(frames), height, width), source.dtype.newbyteorder("=") if whole else np.float32)
    frame_bytes = (rows.stop - rows.start) * source.shape[1] * source.dtype.itemsize
    batch = max(1, _BATCH_BYTES // max(1, frame_bytes))
    for start in range(0, len(frames), batch):
        raw = read_known(source, frames[start : start + batch], rows)
        if binning > 1:
            raw = _mean_bins(raw[:, : height * binning, : width * binning].astype(np.float32), binning)
        out[start : start + batch] = raw
        progress(min(start + batch, len(frames)), len(frames))
    return out


def reading_memory(source: ScanSource, frames: int, rows: slice, binning: int) -> int:
    """Bytes that `read_binned` takes, with what it returns."""
    pixels, itemsize = (rows.stop - rows.start) * source.shape[1], source.dtype.itemsize
    at_once = min(frames, max(1, _BATCH_BYTES // max(1, pixels * itemsize))) * pixels
    if binning == 1:
        return frames * pixels * (itemsize if source.dtype.kind in "ui" else 4) + at_once * itemsize
    return 4 * frames * pixels // binning**2 + at_once * (itemsize + 4 + 2)  # as float32, with a mask


def _mean_bins(raw: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    k, rows, cols = raw.shape
    blocks = raw.reshape(k, rows // n, n, cols // n, n)
    finite = np.isfinite(blocks)
    if finite.all():
        return blocks.mean(axis=(2, 4), dtype=np.float32)
    count = finite.sum(axis=(2, 4))
    total = np.where(finite, blocks, 0).sum(axis=(2, 4), dtype=np.float32)
    return np.where(count > 0, total / np.maximum(count, 1), np.float32(np.nan)).astype(np.float32)


def read_references(source: ScanSource, groups: ReferenceGroups, rows: slice, selection: Selection) -> References:
    """Mean dark, and the mean of each group of flats with its place in the scan; both kinds must be there.

    Frames that are damaged (see ScanSource) are left out, unless the selection uses all. The light of flats with an
    exposure of their own is scaled to the projections': dark + (flat - dark) * t / t_flat, where both are known. The
    dark is one for all: the file's rules tell where it was exposed otherwise.

    Raises:
        DataError: all frames of a kind are damaged.
    """
    binning, use_damaged = selection.binning, not selection.step(Flags).used
    dark = _mean(source, np.concatenate(groups.darks), rows, binning, None, use_damaged)
    scale = light_scale(source, use_current(selection))
    flats = []
    for group in groups.flats:
        mean = _mean(source, group, rows, binning, scale[group], use_damaged)
        if dark is not None and mean is not None:
            used = np.setdiff1d(group, spoilt_frames(source, use_damaged))
            flats.append((float(used.mean()), (mean + (1 - scale[used].mean()) * dark).astype(np.float32)))
    if dark is None or not flats:
        raise DataError(
            f"{source.path}: all {'darks' if dark is None else 'flats'} are damaged: they cannot be read, or are not "
            "what was written, by their checksums. Use a good copy, or --flags ignore, which takes the latter."
        )
    return References(dark.astype(np.float32), tuple(flats), part_starts=tuple(source.part_starts.tolist()))


def with_dynamic_flats(
    source: ScanSource, groups: ReferenceGroups, references: References, rows: slice, selection: Selection
) -> References:
    """The same references with the components of all flats of these groups, which are read three times.

    Raises:
        ConfigError: there are too few flats.
    """
    frames = np.concatenate(groups.flats)
    frames = np.setdiff1d(frames, spoilt_frames(source, not selection.step(Flags).used))
    scale = light_scale(source, use_current(selection))

    def flats() -> Iterator[NDArray[np.float32]]:
        for frame in frames:
            image = read_binned(source, np.array([frame]), rows, selection.binning)[0]
            yield ((image - references.dark) * np.float32(scale[frame])).astype(np.float32)

    masked = dead_pixels(references.dark, [flat for _, flat in references.flats], selection.step(Defects).hot_threshold)
    try:
        found = find_dynamic_flats(flats, np.random.default_rng(selection.seed), masked)
    except ValueError as error:
        raise ConfigError(f"--flat-fields dynamic: {source.path}: {error}. Leave it out.") from error
    return replace(references, dynamic=found)


def tell_damaged(source: ScanSource, selection: Selection, frames: NDArray[np.int64], warn: Warn) -> NDArray[np.bool_]:
    """Which of the frames are left out: those that could not be read, and, by the selection, those that are not what
    was written. Warnings name them."""
    lost = np.isin(frames, sorted(source.unreadable))
    if lost.any():
        first = int(frames[lost].min())
        warn(
            f"{count(int(lost.sum()), 'frame')} cannot be read: {spans(np.sort(frames[lost]).tolist())}, left out. "
            f"{source.unreadable[first]}"
        )
    damaged = np.isin(frames, sorted(source.damaged)) & ~lost
    used = selection.step(Flags).used
    if damaged.any():
        taken = "left out" if used else "used as they are (--flags ignore)"
        warn(
            f"Frames {spans(np.sort(frames[damaged]).tolist())} do not have the pixels that were written, by their "
            f"checksums: {taken}. Look for a good copy of {source.path}."
        )
    return lost | damaged if used else lost


def spoilt_frames(source: ScanSource, use_damaged: bool) -> list[int]:
    """Rows read so far that cannot be used: those that the file does not give, and those that are not as written."""
    return sorted({*source.unreadable} | (set() if use_damaged else source.damaged))


def light_scale(source: ScanSource, by_current: bool = False) -> NDArray[np.float64]:
    """By how much the light of each frame grows from its own exposure to the projections'; 1 where one is unknown.

    If projections differ, the median counts. With `by_current` also from its own ring current.
    """
    scale = _to_median(source.exposures, source.image_key)
    return scale * current_scale(source) if by_current else scale


def _to_median(values: NDArray[np.float64], image_key: NDArray[np.int32]) -> NDArray[np.float64]:
    """The median of the projections over each frame's own; 1 where one is unknown."""
    views = values[image_key == FrameKind.PROJECTION]
    views = views[np.isfinite(views)]
    if views.size == 0:
        return np.ones(values.size)
    return np.where(np.isfinite(values), np.median(views) / values, 1.0)


def use_current(selection: Selection) -> bool:
    """Views and flats are divided by the ring current."""
    return selection.step(Flats).ring_current == "use"


def current_scale(source: ScanSource) -> NDArray[np.float64]:
    """By how much the light of each frame grows from its own ring current to the median of the projections'.

    Raises:
        ConfigError: the file has none for some view or flat.
    """
    used = np.isin(source.image_key, (FrameKind.PROJECTION, FrameKind.FLAT))
    currents = source.currents
    if currents is None or not np.isfinite(currents[used]).all():
        lacking = "no ring current" if currents is None else "no ring current for some views or flats"
        raise ConfigError(f"--ring-current use: {source.path} has {lacking} (control/data of NXtomo). Leave it out.")
    return _to_median(currents, source.image_key)


def _mean(
    source: ScanSource,
    frames: NDArray[np.int64],
    rows: slice,
    binning: int,
    weights: NDArray[np.float64] | None,
    use_damaged: bool,
) -> NDArray[np.float64] | None:
    """Mean of the frames that may be used, each times its weight; float64 [row, col], binned; None where none may."""
    total, n = np.zeros(((rows.stop - rows.start) // binning, source.shape[1] // binning), np.float64), 0
    for i, frame in enumerate(frames):
        image = read_binned(source, np.array([frame]), rows, binning)[0]
        if int(frame) not in spoilt_frames(source, use_damaged):
            total += image if weights is None else weights[i] * image
            n += 1
    return total / n if n else None
