"""What the camera's count and the clock say of the frames of a scan: frames that are lost, repeated or out of order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beamline.storage.readers.base import ScanSource
from beamline.storage.rules import Finding
from recon.base.arrays import I64


def time_order(source: ScanSource) -> Iterator[Finding]:
    """Frames are in the order of their times."""
    if source.table.times is not None and (back := np.flatnonzero(np.diff(source.table.times) < 0)).size:
        step = np.diff(source.table.times)[back[0]]
        yield Finding(
            "error", "time-order", f"Time goes back {back.size} times (first: frame {back[0] + 1}, by {-step:.6g} s)."
        )


def framestamp_order(source: ScanSource) -> Iterator[Finding]:
    """The camera's frame counter increases by one for each frame.

    It starts again where the camera was armed anew: with other frames, or for other triggers of the same ones, or with
    another part of a joined file. Not always at 0, for the first frame may be lost.
    """
    table = source.table
    stamps, triggers, key = table.framestamps, table.triggers, table.kinds
    if stamps.size < 2 or (stamps < 0).any():
        return
    steps, rows = np.diff(stamps), np.arange(key.size)
    passes = np.searchsorted(table.pass_ends, rows, "right")  # one may be repeated
    aside = np.zeros(key.size) if table.aside is None else table.aside  # offset views count on, as retakes do
    new = np.zeros(key.size, np.bool_)
    new[np.unique(np.stack([key, triggers, passes, aside]), axis=1, return_index=True)[1]] = True
    new[table.part_starts] = True
    armed = (np.diff(passes) > 0) | (new[1:] & ((steps < 0) | (stamps[1:] == 0)))
    same_block = (np.diff(key) == 0) & ~armed
    repeated = np.flatnonzero(same_block & (steps <= 0))
    if repeated.size:
        first = repeated[0]
        yield Finding(
            "error",
            "framestamps",
            f"{repeated.size} frames repeat or go back in the camera's count (first: frame {first + 1}, "
            f"framestamp {stamps[first + 1]} after {stamps[first]}).",
        )
    skipped = [i for i in np.flatnonzero(same_block & (steps > 1)).tolist() if not _taken_again(source, i, steps[i])]
    if skipped:
        yield Finding(
            "warning",
            "framestamps",
            f"The camera counted {sum(steps[skipped] - 1)} frames that are not in the file "
            f"(first gap before frame {skipped[0] + 1}).",
        )


def _taken_again(source: ScanSource, at: int, step: I64) -> bool:
    """Whether each trigger between a frame and the next has its frame elsewhere in the file."""
    triggers, key = source.table.triggers, source.table.kinds
    between = np.arange(triggers[at] + 1, triggers[at + 1])
    return between.size == step - 1 and bool(np.isin(between, triggers[key == key[at]]).all())
