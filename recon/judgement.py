"""Judgement: how good a volume is, judged by its projections and, if known, by the ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Flag, auto
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Clock
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.voxels.matter_checks import (
    StrayMass,
    Unexplained,
    stray_mass,
    stray_mass_memory,
    stray_mass_share,
    unexplained,
    unexplained_memory,
)
from recon.voxels.odd_views import OddView, odd_views, odd_views_memory
from recon.voxels.one_projection import RayCheck, project_parts
from recon.voxels.residuals import SquaresLeft, residual, uniform_residual

_RESIDUAL_VIEWS = 16  # largest number of used projections in the residual; limits the time
_ODD_VIEWS_WORK = 1.5  # duration of `odd_views`, in units of projecting the volume once
# largest number of voxels in the regions (`metrics.sampled`); bytes per voxel
_REGION_VOXELS, _REGION_BYTES = 2**21, 12


class Aspect(Flag):
    """The criteria by which a volume is judged, in addition to a ground truth.

    RESIDUAL: the residual in up to 16 of the projections used, and in all held-out projections. STRAY: mass where the
    projections show no material. FIT (with RESIDUAL), for a volume fitted to its projections: whether a uniform volume
    predicts them as well, structure in the residual, and projections that do not fit.
    """

    RESIDUAL, STRAY, FIT = auto(), auto(), auto()


class TimeLeft(NamedTuple):
    """A clock, and a function that says whether a number of further seconds may be used."""

    now: Clock = lambda: 0.0
    leaves: Callable[[float], bool] = lambda seconds: True


_ALWAYS = TimeLeft()


@dataclass(frozen=True, eq=False)
class Judgement:
    """How good a volume is.

    Attributes:
        figures: figures of merit by name: psnr, ssim3d and nrmse from the ground truth; residual, residual_held_out,
            unexplained and stray from the projections.
        held_out: residual in the held-out projections; None if there are none.
        along_rows: residuals of the volume and of a uniform volume, see `uniform_residual`; None: not compared.
        unexplained: structure in the residual of the projections; None: not known.
        stray: mass where the projections show no material; None: not computed.
        odd_views: projections with a part that the volume does not explain.
        skipped: checks for which there was no time.
        seconds_of_views: approximate seconds to compute all projections.
    """

    figures: Mapping[str, float]
    held_out: SquaresLeft | None = None
    along_rows: tuple[float, float] | None = None
    unexplained: Unexplained | None = None
    stray: StrayMass | None = None
    odd_views: tuple[OddView, ...] = ()
    skipped: tuple[str, ...] = ()
    seconds_of_views: float = 0.0


def judge(
    volume: Volume,
    views: Views,
    truth: Volume | None = None,
    *,
    aspects: Aspect = Aspect.RESIDUAL,
    seed: int = 0,
    time: TimeLeft = _ALWAYS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Judgement:
    """Judge a volume by the projections it was made from, the held-out projections and the true volume.

    Args:
        seed: seed of the random signs of projections that separate noise from structure.
        time: the checks for stray mass and for odd projections are skipped if they would exceed this time.
        progress: function that takes the number of projections compared so far, and their total number.

    Raises:
        ValueError: all projections are zero.
    """
    seen, unseen, grid, start_time = views.seen, views.unseen, volume.grid, time.now()
    fitted, compares, seconds, residual_of_uniform = Aspect.FIT in aspects, Aspect.RESIDUAL in aspects, 0.0, 0.0
    if compares and fitted:
        residual_of_uniform, rays = uniform_residual(grid, seen, _RESIDUAL_VIEWS)
        seconds = (time.now() - start_time) * seen.data.size / rays
    stray_work = stray_mass_share(seen.geometry, grid) if Aspect.STRAY in aspects else 0.0
    looks_for_odd = fitted and time.leaves((stray_work + _ODD_VIEWS_WORK) * seconds)
    used, no_check = np.setdiff1d(np.arange(len(views.data)), views.held_out), RayCheck[Any]((), lambda: None)
    residual_check = residual(grid, seen, _RESIDUAL_VIEWS).renumbered(used) if compares else no_check
    held_out_check = no_check
    if compares and unseen is not None:
        held_out_check = residual(grid, unseen, len(unseen.data)).renumbered(views.held_out)
    structure_check = unexplained(volume, seen, np.random.default_rng(seed)).renumbered(used) if fitted else no_check
    odd_check = odd_views(grid, seen).renumbered(used) if looks_for_odd else no_check
    checks = residual_check, held_out_check, structure_check, odd_check
    start_time = time.now()
    project_parts(volume, views.geometry, [part for check in checks for part in check.parts], progress)

    figures, along_rows, held_out = {} if truth is None else by_truth(truth.data, volume.data), None, None
    if compares:
        squares, residual_of_volume = residual_check.result()
        figures["residual"] = squares.residual
        along_rows = (residual_of_volume, residual_of_uniform) if fitted else None
        if unseen is not None:
            held_out, _ = held_out_check.result()
            figures["residual_held_out"] = held_out.residual
        if not fitted:
            rays = squares.rays.sum() + (0 if held_out is None else held_out.rays.sum())
            seconds = (time.now() - start_time) * seen.data.size / rays
    if (structure := structure_check.result()) is not None:
        figures["unexplained"] = structure.share
    looks_for_stray = Aspect.STRAY in aspects and (stray_work == 0 or time.leaves(stray_work * seconds))
    stray = stray_mass(volume, seen) if looks_for_stray else None
    figures |= {} if stray is None else {"stray": stray.share}
    is_skipped = {
        "the check for mass where projections show no material": Aspect.STRAY in aspects and not looks_for_stray,
        "the check for projections that do not fit the volume": fitted and not looks_for_odd,
    }
    skipped = tuple(name for name, left_out in is_skipped.items() if left_out)
    return Judgement(figures, held_out, along_rows, structure, stray, odd_check.result() or (), skipped, seconds)


def judge_memory(geometry: Geometry, *, fitted: bool) -> int:
    """Approximate memory of `judge` and `contrast` in bytes, without projections and volume."""
    grid = Grid.matching(geometry)
    of_fitted = fitted * odd_views_memory(geometry) + unexplained_memory(geometry)
    memory_of_checks = max(of_fitted, stray_mass_memory(geometry, grid))
    return max(memory_of_checks, _REGION_BYTES * min(math.prod(grid.shape), _REGION_VOXELS))


def by_truth(truth: F32, volume: F32) -> dict[str, float]:
    """The figures of merit of a volume from the true volume, both [z, y, x]."""
    measures = {"psnr": metrics.psnr, "ssim3d": metrics.ssim3d, "nrmse": metrics.nrmse}
    return {name: float(figure(truth, volume)) for name, figure in measures.items()}


def contrast(reference: Volume, volumes: Mapping[str, Volume], seed: int) -> dict[str, dict[str, float]]:
    """SNR and CNR of each volume in the dense and the empty regions of one reference, without the edges of the regions.

    All volumes use the regions of the reference, because each volume by itself would give different regions. The result
    is empty if the reference has no such regions.
    """
    regions = regions_of(reference, seed)
    return {} if regions is None else {name: contrast_in(regions, each) for name, each in volumes.items()}


def regions_of(reference: Volume, seed: int) -> NDArray[np.int8] | None:
    """Dense and empty regions for `contrast_in`; None if the reference has no such regions."""
    return metrics.interior_regions(metrics.sampled(reference.data), seed)


def contrast_in(regions: NDArray[np.int8], volume: Volume) -> dict[str, float]:
    """SNR and CNR of a volume in the regions of a reference."""
    return dict(zip(("snr", "cnr"), metrics.snr_cnr(metrics.sampled(volume.data), regions), strict=True))
