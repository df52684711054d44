"""Reconstruction within a time: measure this machine on this scan, choose settings, and end when the time is over."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import recon
from beamline.projections.correction import Warn
from beamline.projections.held_out import with_held_out
from beamline.projections.prepare import PreparedProjections
from recon.assess.time_model import CURVES, Choice, Speeds, choose, parts_of
from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.base.method import DataUse, Progress, RunControl
from recon.base.volume import Grid
from recon.calibrate import calibrate
from recon.reconstruction import Reconstruction
from recon.splatting.finish import SUBSETS, SWEEPS, TV_STEPS
from recon.splatting.initialise import default_count, place
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import voxelize
from recon.voxels.direct import Fbp, has_direct_method
from recon.voxels.fbp import Filter
from recon.voxels.ordered_fista import subsets_of
from recon.voxels.projector import Projector
from recon.voxels.tv import TotalVariationProx, difference_weights

Now = Callable[[], float]

_GROWTH = 1.5  # how many times as many Gaussians a fit may end with, and so how much longer filling takes
_RESERVE = 0.02  # of the budget, for what no part has measured
_SLAB = 16  # slices
_FINISH_SHARE = 0.5  # of what is left after placing, at most
_TIMED_VIEWS = 8
# What goes before the sweeps of a finish, in sweeps: the largest eigenvalue of a subset, projections and an FBP.
_EIGENVALUE_ROUNDS, _FIRST_SWEEPS = 6, 3


@dataclass(frozen=True, eq=False)
class Budgeted:
    """A reconstruction that was given a time.

    Attributes:
        result: what came out.
        prepared: the views it is of, with joined pixels if the choice joins them.
        choice, speeds: what was chosen, and the measurements behind it.
        seconds: of everything, calibration included.
        placed: Gaussians at the start.
    """

    result: Reconstruction
    prepared: PreparedProjections
    choice: Choice
    speeds: Speeds
    seconds: float
    placed: int = 0

    def settings(self, budget: float) -> dict[str, Any]:
        """For the record."""
        c, s = self.choice, self.speeds
        return {
            "budget": budget,
            "budget_used": self.seconds,
            "chosen_method": self.result.method,
            "chosen_binning": c.binning,
            "chosen_share": c.share,
            "expected_steps": c.steps,
            "expected_gain_db": c.gain,
            "measured_fbp_s": s.fbp,
            "measured_start_s": s.start,
            "measured_step_s": s.step,
            "measured_fill_s": s.fill,
        }

    def summary(self, budget: float) -> str:
        """The choice in a line."""
        fit = ""
        if self.choice.fits:
            fit = f", {self.result.history[-1].step} steps from {self.placed} Gaussians"
        return f"{_named(self.choice, fit)}: {parts_of(self.seconds)} of {parts_of(budget)}"


def within(
    budget: float,
    prepared: PreparedProjections,
    seed: int,
    filter: Filter,
    now: Now,
    on_progress: Callable[[Progress], None],
    stopped: Callable[[], bool],
    warn: Warn,
) -> Budgeted:
    """Reconstruct within `budget` seconds by `now`, the measuring included.

    Placing is run and timed before the fit gets what is left, and filling is timed on a slab of what was placed: only
    the choice rests on predictions. Where even the cheapest choice will be late, `warn` gets a warning before the work.

    Raises:
        ValueError: the views cannot be reconstructed.
    """
    begin = now()
    data, geometry = prepared.projections.data, prepared.geometry
    speeds = calibrate(data, geometry, Grid.matching(geometry), now)
    unbinned = default_count(Grid.of_field(geometry, geometry.sample_pitch))  # the curves count in these
    spent = now() - begin
    # What the measuring has used up leaves no time; the cheapest choice is the one for the shortest.
    choice = choose(max(budget - spent, sys.float_info.min), speeds, min(geometry.detector_shape))
    if not choice.fits and not has_direct_method(geometry):
        # There is only the volume that Gaussians are placed by; the fewest of them, and a step, are the next best.
        choice = replace(choice, share=min(curve.share for curve in CURVES) / choice.binning**3)
    late = spent + _least(choice, speeds) - budget
    if late > 0:
        warn(
            f"{parts_of(budget)} are too few for this scan: measuring this machine took {parts_of(spent)}, and the "
            f"cheapest choice, {_named(choice)}, will be about {parts_of(late)} late."
        )
    prepared = joined(prepared, choice.binning)
    data, geometry = prepared.projections.data, prepared.geometry
    grid = Grid.matching(geometry)
    if not choice.fits:
        result = recon.reconstruct(data, geometry, Fbp(filter), grid=grid, control=RunControl(now=now))
        return Budgeted(result, prepared, choice, speeds, now() - begin)
    field = Grid.of_field(geometry, geometry.sample_pitch)
    count, rng = max(1, round(choice.share * unbinned)), np.random.default_rng(seed)
    placed = place(data, geometry, field, count, rng, kernel=FitSettings().kernel)
    before = now()
    slab = replace(grid, shape=(min(_SLAB, grid.shape[0]), *grid.shape[1:]))
    voxelize(placed, slab)
    fill = (now() - before) * grid.shape[0] / slab.shape[0] * _GROWTH
    end = begin + budget * (1 - _RESERVE) - fill
    sweeps, finishing = finish_within(_FINISH_SHARE * (end - now()), geometry, grid, now)
    data, geometry, held_out = with_held_out(data, geometry, prepared.held_out)
    control = RunControl(should_stop=lambda: stopped() or now() >= end, on_progress=on_progress, now=now)
    fit = R2(seconds=max(0.0, end - now() - finishing), gaussians=placed, finish=sweeps)
    use = DataUse(prepared.ray_weights(len(held_out)), held_out)
    result = recon.reconstruct(data, geometry, fit, grid=grid, seed=seed, use=use, control=control)
    return Budgeted(result, prepared, choice, speeds, now() - begin, placed.n)


def finish_within(seconds: float, geometry: Geometry, grid: Grid, now: Now) -> tuple[int, float]:
    """Sweeps of a fit's finish that `seconds` suffice for, at most `SWEEPS`, and the seconds that they will take.

    A few views are projected there and back, and one proximal step of total variation is taken, to measure it. Fewer
    than two sweeps are none: what goes before them takes as long.
    """
    if not geometry.is_straight or seconds <= 0:
        return 0, 0.0
    some = geometry.select(np.arange(0, geometry.n_views, max(1, geometry.n_views // _TIMED_VIEWS))[:_TIMED_VIEWS])
    projector = Projector(some, grid)
    begin = now()
    x = projector.adjoint_lines(projector.forward_lines(np.ones((*grid.shape[1:], grid.shape[0]), np.float32)))
    projected = now()
    TotalVariationProx(x.shape, difference_weights(grid), True, TV_STEPS)(x, float(x.max()) / 100)
    parts = subsets_of(geometry, SUBSETS)
    sweep = (projected - begin) * geometry.n_views / some.n_views + (now() - projected) * parts
    if geometry.is_cone:
        sweep *= 2  # voxels often cannot explain a cone's views: then the sweeps begin anew
    before = (_EIGENVALUE_ROUNDS / parts + _FIRST_SWEEPS) * sweep
    sweeps = min(SWEEPS, int((seconds - before) / sweep)) if sweep > 0 else SWEEPS
    return (sweeps, before + sweeps * sweep) if sweeps >= 2 else (0, 0.0)


def _named(choice: Choice, fit: str = "") -> str:
    joined = f", pixels joined {choice.binning} x {choice.binning}" if choice.binning > 1 else ""
    return f"{R2.name if choice.fits else Fbp.name}{fit}{joined}"


def _least(choice: Choice, speeds: Speeds) -> float:
    """Seconds that a choice takes at the least: for a fit placing, a step and filling; as `choose` counts them."""
    first = speeds.fbp / choice.binning**3
    if not choice.fits:
        return first
    return first + (speeds.start + speeds.fill) * choice.share + speeds.step / choice.binning**2


def joined(prepared: PreparedProjections, factor: int) -> PreparedProjections:
    """The same views with factor x factor pixels joined: means of line integrals."""
    if factor == 1:
        return prepared
    held = prepared.held_out
    return replace(
        prepared,
        projections=replace(prepared.projections, data=bin_views(prepared.projections.data, factor)),
        geometry=prepared.geometry.binned(factor),
        held_out=None if held is None else (bin_views(held[0], factor), held[1].binned(factor)),
    )
