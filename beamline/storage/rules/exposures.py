"""Frames of several exposures: which darks go with them, and how they compare with frames of another exposure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.references import ReferenceFrame
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.transforms import in_words, of_energies
from beamline.storage.rules import Finding
from drivers.base.frame import FrameKind
from recon.base.arrays import F32
from recon.prep.references import dark_at

EXPOSURE_TOLERANCE = 1e-3  # cameras round an exposure
LookAtRow = Callable[[int], ReferenceFrame]


def usual_exposure(source: ScanSource) -> float:
    """The median exposure of the projections in s; NaN if it is unknown."""
    known = source.exposures[(source.image_key == FrameKind.PROJECTION) & (source.exposures > 0)]
    return float(np.median(known)) if known.size else np.nan


def views_differ(source: ScanSource) -> bool:
    """Whether the exposures of the projections differ, and that of each is known."""
    views = source.exposures[source.image_key == FrameKind.PROJECTION]
    return bool(views.size and (views > 0).all() and np.ptp(views) > EXPOSURE_TOLERANCE * np.median(views))


def by_exposure(source: ScanSource, rows: NDArray[np.int64]) -> list[tuple[float, NDArray[np.int64]]]:
    """The rows of each exposure among these frames; one group, of NaN, if one is unknown or all are alike."""
    seconds = source.exposures[rows]
    if not rows.size or not (seconds > 0).all() or np.ptp(seconds) <= EXPOSURE_TOLERANCE * seconds.min():
        return [(np.nan, rows)]
    order = np.argsort(seconds, kind="stable")
    edges = np.flatnonzero(np.diff(seconds[order]) > EXPOSURE_TOLERANCE * seconds[order][:-1]) + 1
    return [(float(np.median(source.exposures[part])), np.sort(part)) for part in np.split(rows[order], edges)]


# The darks of each exposure in blocks and in cells, and what they depend on.
Darks = list[tuple[float, F32]]
_darks: WeakKeyDictionary[ScanSource, tuple[bytes, Darks, Darks]] = WeakKeyDictionary()


def levelled(source: ScanSource, frame: ReferenceFrame, seen: LookAtRow) -> ReferenceFrame:
    """A frame corrected to the dark of the shortest exposure and, for projections that differ, to the usual exposure.

    Args:
        seen: the frame of a row as it is.
    """
    darks, cells = _dark_levels(source, seen)
    if not frame.exposure > 0:
        return frame
    if len(darks) > 1:
        frame = replace(frame, blocks=frame.blocks - (dark_at(frame.exposure, darks) - darks[0][1]))
        if frame.cells is not None:
            frame = replace(frame, cells=frame.cells - (dark_at(frame.exposure, cells) - cells[0][1]))
    if frame.kind is FrameKind.PROJECTION and darks and views_differ(source):
        usual = usual_exposure(source)
        longer = np.float32(usual / frame.exposure)
        frame = replace(frame, blocks=darks[0][1] + (frame.blocks - darks[0][1]) * longer, exposure=usual)
        if frame.cells is not None:
            frame = replace(frame, cells=cells[0][1] + (frame.cells - cells[0][1]) * longer)
    return frame


def _dark_levels(source: ScanSource, seen: LookAtRow) -> tuple[Darks, Darks]:
    key = source.image_key.tobytes() + source.exposures.tobytes()
    if (known := _darks.get(source)) is None or known[0] != key:
        groups = by_exposure(source, np.flatnonzero(source.image_key == FrameKind.DARK))
        needed = len(groups) > 1 or (views_differ(source) and groups[0][1].size > 0)
        frames = [(seconds, [seen(int(row)) for row in rows]) for seconds, rows in groups] if needed else []
        blocks = [(seconds, np.mean([frame.blocks for frame in some], axis=0)) for seconds, some in frames]
        cells = [
            (seconds, np.mean([frame.cells for frame in some if frame.cells is not None], axis=0))
            for seconds, some in frames
        ]
        _darks[source] = known = key, blocks, cells
    return known[1:]


def one_energy(source: ScanSource) -> Iterator[Finding]:
    """All views were taken at one energy, as a volume requires."""
    if (energies := source.energies) is None:
        return
    of_views = energies[source.image_key == FrameKind.PROJECTION]
    if len(parts := of_energies(of_views)) > 1:
        yield Finding(
            "error",
            "energies",
            f"The views were taken at {len(parts)} energies: {in_words(of_views)}; a volume is of one. Choose it, such "
            f"as --frames energy={parts[0][0]:.6g}, which leaves out all frames of others.",
        )
