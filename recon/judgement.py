"""Judgement: what a volume is worth by its views and, where there is one, by a truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Flag, auto
from typing import NamedTuple

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
from recon.voxels.residuals import SquaresLeft, left_by_volume

_VIEWS = 16  # of those used, at most, that the residual is taken from: what it costs
_ODD_VIEWS_WORK = 1.5  # the time of `odd_views`, in projections of all rays
_REGIONS, _REGION = 2**21, 12  # voxels at most of regions (`metrics.sampled`); bytes of a voxel


class Aspect(Flag):
    """What a volume is judged by, beside a truth.

    RESIDUAL: what it leaves of up to 16 views used, and of all views held out. STRAY: mass where views show nothing.
    FIT, with RESIDUAL: of a volume fitted to its views, what it hides or leaves unexplained: whether a uniform volume
    does as well, structure left in the views, and views that do not fit.
    """

    RESIDUAL, STRAY, FIT = auto(), auto(), auto()


class TimeLeft(NamedTuple):
    """A clock, and whether a number of further seconds may be taken."""

    now: Clock = lambda: 0.0
    leaves: Callable[[float], bool] = lambda seconds: True


_ALWAYS = TimeLeft()


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a volume is worth.

    Attributes:
        figures: of merit, by name: psnr, ssim3d, nrmse by a truth; residual, residual_held_out, unexplained, stray by
            views.
        held_out: what the volume leaves of the views held out; None if none is.
        along_rows: what the volume and a uniform one leave, as of `left_by_volume`; None: not compared.
        unexplained: structure that the volume leaves in the views; None where that is not known.
        stray: mass where views show nothing; None where it was not looked for.
        odd_views: with a part that the volume does not explain.
        skipped: looks for which there was no time.
        seconds_of_views: to project all views, about.
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
    held_out: Views | None = None,
    aspects: Aspect = Aspect.RESIDUAL,
    seed: int = 0,
    time: TimeLeft = _ALWAYS,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Judgement:
    """Judge a volume by the views it was made of, those held out, and the true volume.

    Args:
        seed: of the signs of views by which noise is told from structure.
        time: looks that would take longer than it leaves are skipped, those for stray mass and odd views.
        progress: how many of how many views were compared.

    Raises:
        ValueError: the views are zero everywhere.
    """
    figures = {} if truth is None else by_truth(truth.data, volume.data)
    along_rows, unseen, structure, stray, seconds = None, None, None, None, 0.0
    odd, skipped, fitted = tuple[OddView, ...](), list[str](), Aspect.FIT in aspects
    if Aspect.RESIDUAL in aspects:
        begun = time.now()
        left, along_rows = left_by_volume(volume, views, _VIEWS, progress, beside_uniform=fitted)
        figures["residual"], projected = left.residual, left.rays.sum() * (3 if fitted else 1)
        if held_out is not None:
            unseen, _ = left_by_volume(volume, held_out, held_out.geometry.n_views, progress)
            figures["residual_held_out"], projected = unseen.residual, projected + unseen.rays.sum()
        seconds = (time.now() - begun) * views.data.size / float(projected)
    if fitted and (structure := unexplained(volume, views, np.random.default_rng(seed))) is not None:
        figures["unexplained"] = structure.share

    def has_time(work: float, name: str) -> bool:
        """Whether time remains for this many projections of all views."""
        enough = work == 0 or time.leaves(work * seconds)
        skipped.extend([] if enough else [name])
        return enough

    work = stray_mass_share(views.geometry, volume.grid)
    if Aspect.STRAY in aspects and has_time(work, "the look for mass where views show nothing"):
        stray = stray_mass(volume, views)
        figures |= {} if stray is None else {"stray": stray.share}
    if fitted and has_time(_ODD_VIEWS_WORK, "the look for views that do not fit the volume"):
        odd = odd_views(volume, views, progress)
    return Judgement(figures, unseen, along_rows, structure, stray, odd, tuple(skipped), seconds)


def judge_memory(geometry: Geometry, *, fitted: bool) -> int:
    """Approximate memory of `judge` and `contrast` in bytes, without projections and volume."""
    grid = Grid.matching(geometry)
    most = max(unexplained_memory(geometry), stray_mass_memory(geometry, grid), fitted * odd_views_memory(geometry))
    return max(most, _REGION * min(math.prod(grid.shape), _REGIONS))


def by_truth(truth: F32, volume: F32) -> dict[str, float]:
    """The figures of a volume by the true one, [z, y, x] each."""
    of = {"psnr": metrics.psnr, "ssim3d": metrics.ssim3d, "nrmse": metrics.nrmse}
    return {name: float(figure(truth, volume)) for name, figure in of.items()}


def contrast(reference: Volume, volumes: Mapping[str, Volume], seed: int) -> dict[str, dict[str, float]]:
    """SNR and CNR of each volume in the dense and the empty regions of one reference, without their rims.

    Regions of each volume itself would be others. Empty if the reference has no such regions.
    """
    regions = regions_of(reference, seed)
    return {} if regions is None else {name: contrast_in(regions, each) for name, each in volumes.items()}


def regions_of(reference: Volume, seed: int) -> NDArray[np.int8] | None:
    """Dense and empty regions for `contrast_in`; None if the reference has no such regions."""
    return metrics.interior_regions(metrics.sampled(reference.data), seed)


def contrast_in(regions: NDArray[np.int8], volume: Volume) -> dict[str, float]:
    """SNR and CNR of a volume in the regions of a reference."""
    return dict(zip(("snr", "cnr"), metrics.snr_cnr(metrics.sampled(volume.data), regions), strict=True))
