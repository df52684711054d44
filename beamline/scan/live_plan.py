"""Plan of the live volume of a scan: binning, number of projections, and memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beamline.core.text import count, size
from beamline.plan.plan import Mode, ScanPlan, one_way

# Measured bytes per value for line integrals, fit and voxel refinement, with 128 x 256 pixels and 300 projections.
_A_RAY, _A_VOXEL = 40, 50
_WIDEST = 512  # largest number of columns: no processor can reconstruct a wider volume as fast as projections arrive
_FEWEST = 90  # smallest number of projections
_SHARE = 0.5  # share of the free memory that is used
_PASSES = range(8, 1, -1)  # possible numbers of passes of an interlaced scan, the best first
_SEQUENTIAL, _INTERLACED, _GOLDEN = "15.0, 19.6, 22.7", "22.0, 25.6, 27.6", "22.9, 26.0, 28.1"
"""PSNR in dB of the live volume after a quarter, half and three quarters of a scan of particles with 90 projections."""


@dataclass(frozen=True)
class LivePlan:
    """The part of a scan that its live volume uses."""

    binning: int = 1  # binning of rows and columns
    one_in: int = 1  # one projection in N is used, in the order of acquisition
    bytes: int = 0  # approximate memory in bytes

    @property
    def whole(self) -> bool:
        return self.binning == self.one_in == 1


def live_plan(shape: tuple[int, int], n_views: int, free: int) -> LivePlan:
    """Choose binning and omitted projections so that the live volume has at most 512 columns and fits into half of the
    free memory.

    First, projections are left out, as long as at least 90 are used. Then the binning is increased.

    Args:
        shape: rows and columns of a frame.
        free: bytes of memory.
    """
    binning = 1
    while shape[1] > _WIDEST * binning:
        binning *= 2
    while True:
        volume_bytes = live_bytes(shape, 0, binning)
        view_bytes, free_for_views = live_bytes(shape, 1, binning) - volume_bytes, _SHARE * free - volume_bytes
        most_views = max(1, int(free_for_views // view_bytes)) if free_for_views > 0 else 1
        one_in = math.ceil(n_views / most_views)
        n_used = math.ceil(n_views / one_in)
        if n_used >= min(n_views, _FEWEST) or shape[1] // binning < 32:
            return LivePlan(binning, one_in, volume_bytes + n_used * view_bytes)
        binning *= 2


def better_order(plan: ScanPlan) -> tuple[str, ...]:
    """A sentence that recommends an order of angles with which the live volume is better before the end of the scan;
    empty if the plan already has such an order.
    """
    angles = plan.angles[:: plan.frames_per_view]
    if not one_way(angles) or angles.size < _FEWEST:
        return ()
    if plan.mode is Mode.STEP:
        better_angles, expected = "{scheme: golden}", _GOLDEN
    elif passes := next((n for n in _PASSES if angles.size % n == 0), 0):
        better_angles, expected = f"{{scheme: interlaced, passes: {passes}}}", _INTERLACED
    else:
        return ()
    return (
        "with angles in sequence the live volume is a limited-angle reconstruction until the last projection. In a "
        f"test scan of particles the PSNR of the live volume was {_SEQUENTIAL} dB after a quarter, half and three "
        f"quarters of the scan. With scan.angles {better_angles} the PSNR was {expected} dB; the final volume is the "
        "same",
    )


def live_bytes(shape: tuple[int, int], n_views: int, binning: int = 1) -> int:
    """Estimated memory in bytes of a live volume of `n_views` projections of this shape."""
    rows, cols = (max(1, n // binning) for n in shape)
    return rows * cols * (_A_VOXEL * cols + _A_RAY * n_views)


def live_need(shape: tuple[int, int], n_views: int, free: int) -> str:
    """A sentence about the live volume: its projections and pixels, its memory, and the reason for its size."""
    plan = live_plan(shape, n_views, free)
    rows, cols = (max(1, n // plan.binning) for n in shape)
    views, share_text = math.ceil(n_views / plan.one_in), f"half of the {size(free)} of free memory"
    need = (
        f"the live volume uses {count(views, 'projection')} of {rows} x {cols} pixels and about "
        f"{size(plan.bytes)} of memory"
    )
    if plan.whole:
        return f"{need}; at most {share_text} is allowed"
    reductions = [f"one projection in {plan.one_in}"] if plan.one_in > 1 else []
    reductions += [f"pixels binned {plan.binning} x {plan.binning}"] if plan.binning > 1 else []
    whole = f"all {n_views} projections of {shape[0]} x {shape[1]} would need {size(live_bytes(shape, n_views))}"
    columns_text = f"at most {_WIDEST} columns and " if shape[1] > _WIDEST else ""
    what_to_change = ", ".join(reductions)
    return (
        f"{need} ({what_to_change}). The reason: the live volume may use {columns_text}{share_text}, but {whole}. "
        "`beamline recon` makes the full volume"
    )
