"""Parts of a scan between jumps of its sample: which view is in which."""

from __future__ import annotations

import numpy as np

from recon.base.arrays import I64


def part_numbers(jumps: I64, rows: I64) -> I64:
    """Number [row] of the part to which each of these rows of the file belongs; jumps ascend."""
    return np.searchsorted(jumps, rows, side="right").astype(np.int64)


def longest_part(frames: I64, jumps: I64) -> I64:
    """The rows of the largest part."""
    parts = part_numbers(jumps, frames)
    return frames[parts == np.bincount(parts).argmax()] if frames.size else frames
