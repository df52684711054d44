"""Decides with three tests on held-out projections whether a reference is used.

Any prior predicts held-out projections better than no prior, even a misplaced reference. So the reference must pass
three tests: it must predict them better than the same total variation without a reference, better than the method that
`auto` chooses without a reference, and better than copies of the reference that are displaced by a voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.decisions import Prior
from recon.base.empirical import ONE_IN
from recon.base.volume import Volume
from recon.features.reference.fit import PLAN, StateFit
from recon.features.reference.motion import KNOTS, Basis, MotionViews, Moved, affinely_moved, padded, roughly_moved
from recon.features.reference.particles import particles_of, placed
from recon.features.reference.weights import CLEAR_LINES
from recon.voxels.choice import (
    LEAST_GAIN,
    MEASURE,
    BestStrength,
    TrialChoice,
    exceeds_standard_error,
    preferred_strength,
    significantly_better,
)
from recon.voxels.half_voxels import predict_as_well_as
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem, times_power

MARGIN = 16  # voxels beyond the box in which the reference is also kept, because the sample may have moved
# first weight of the total variation of the change, divided by the best weight of total variation
_FIRST_CHANGE_WEIGHT = 1.4
_LARGEST_LOSS_OF_HALVES = 0.015
"""Half voxels are used if they increase the residual in held-out projections by at most this share.

On packed balls (30 and 60 projections of 160 columns), half voxels increase the residual by at most 0.8 %, and change
the PSNR by -0.1 to +0.6 dB. On a measured walnut with hardly any noise (60 to 100 projections of 128 columns), they
increase it by 6 to 12 %, and make the volume worse: the residual in projections that were not used grows by 2 to 3 %.
"""
_DISPLACED_SWEEPS = 6  # iterations with a displaced copy


class ReferenceVerdict(NamedTuple):
    """The decision whether the reference is used, as plain values that can be stored (see `Decisions`).

    Attributes:
        used: True if the reference is used. False: the volume is the one that `auto` makes.
        because: the residuals in held-out projections, or the test that failed.
        weight: the weight μ for all projections, in the units of the scan.
        affine, splines: coefficients of the displacement in mm, for `Basis.affine` and for `Basis.splines`. `affine` is
            for heights from the middle of the reference, which all slabs of a volume share.
        gains: gain of the ground, and one gain for all particles.
        half_voxels: True if the volume ends on half voxels, because these predict held-out projections about as well.
    """

    used: bool
    because: str
    weight: float = 0.0
    affine: Sequence[float] = ()
    splines: Sequence[float] = ()
    gains: Sequence[float] = (1.0, 1.0)
    half_voxels: bool = False

    @classmethod
    def of(cls, values: Sequence[Any]) -> ReferenceVerdict:
        return cls(*values)


def not_moved(reference: Volume, problem: VoxelProblem) -> Moved | None:
    """The reference on the voxels of a problem, before its motion is known. None: the reference shows no material
    there.
    """
    grid = problem.units.projector(problem.projector, 1).grid
    volume, first = placed(reference, grid, MARGIN)
    particles = particles_of(times_power(volume, -problem.units.density))
    if particles is None:
        return None
    nz, ny, nx = grid.shape
    no_displacement = np.zeros((3, ny, nx, nz), np.float32)
    radius = problem.projector.geometry.reach / problem.projector.grid.voxel_size if problem.wide else np.inf
    return Moved(particles, first, no_displacement, np.ones(particles.count + 1), radius)


def width_of(problem: VoxelProblem) -> float:
    """Width of the field of view, in the units of the problem. The splines of the motion span this width."""
    return 2 * problem.projector.geometry.reach


def about_reference(affine: F64, reference: Volume, problem: VoxelProblem, width: float, sign: int = 1) -> F64:
    """Coefficients of `Basis.affine` for heights from the middle of the reference. With sign -1, the reverse: for
    heights in the problem."""
    scale = problem.projector.grid.voxel_size / problem.units.projector(problem.projector, 1).grid.voxel_size
    c = affine.copy()
    c[:, 0, 0, 0] += sign * c[:, 0, 0, 1] * 2 * scale * reference.grid.centre[0] / width
    return c


def _at_rows(reference: Volume, trial: Trial) -> Volume:
    """The reference with z measured from the middle of the trial's rows, as in the trial of a parallel beam."""
    z, y, x = reference.grid.centre
    pitch = trial.problem.units.projector(trial.problem.projector, 1).grid.spacing[0]
    return Volume(reference.data, replace(reference.grid, centre=(z - trial.above * pitch, y, x)))


def if_it_overlaps(reference: Volume, problem: VoxelProblem) -> Moved | None:
    """The reference on the voxels of a problem; None: it shows no material there, or it is above, below or beside
    them.
    """
    with suppress(ValueError):
        return not_moved(reference, problem)
    return None


def _in_rows(reference: Volume, problem: VoxelProblem) -> Moved | str:
    """The reference on the voxels of a problem, or why it cannot be used there.

    Raises:
        ValueError: the reference is beside the volume.
    """
    try:
        return not_moved(reference, problem) or "the reference shows no material in the rows of the test"
    except ValueError:
        _, y, x = reference.grid.centre
        not_moved(Volume(reference.data, replace(reference.grid, centre=(0.0, y, x))), problem)
        return "the reference ends above or below the rows of the test"


def asked(trial: Trial, choice: TrialChoice, reference: Volume, halves: bool) -> ReferenceVerdict:
    """Make the three tests on the rows and projections of a trial. `choice` is the choice of `auto`.

    If `halves` is True, a fourth test decides whether the volume ends on half voxels.

    For a cone beam no reference is used, because held-out projections preferred a reference whose volume was up to 2 dB
    worse than the volume of `auto`.
    """
    problem, mu = trial.problem, trial.weight
    if problem.projector.geometry.is_cone:
        return ReferenceVerdict(False, "a reference is used only with a parallel beam, and this scan has a cone beam")
    reference = _at_rows(reference, trial)
    moved = _in_rows(reference, problem)
    if mu is None:
        return ReferenceVerdict(False, "the weights could not be chosen")
    if isinstance(moved, str):
        return ReferenceVerdict(False, moved)
    mu /= np.sqrt(ONE_IN / (ONE_IN - 1))  # weight for the projections that are not held out, see `choose_weight`
    smooth = trial.volume_of_weight(mu) if trial.smooth is None else trial.smooth
    width, grid = width_of(trial.scan), problem.projector.grid
    affine = Basis.affine(grid, width)
    rough_motion = roughly_moved(moved, smooth, grid, width)
    moved = replace(moved, u=padded(affine.field(rough_motion)))
    additional = np.where(moved.known(), 0, smooth).astype(np.float32)
    moved = affinely_moved(MotionViews.of(problem), moved, affine, additional)
    coefficients, gains = affine.nearest(moved.u) * affine.used, moved.gains[:2].tolist()
    from_reference_middle = about_reference(coefficients, reference, problem, width)
    start = np.where(moved.known(), moved.volume(), smooth).astype(np.float32)
    fit = StateFit(problem, moved, start, _FIRST_CHANGE_WEIGHT * mu, width)
    fit.rounds(PLAN)
    if trial.ended or not fit.x.any():
        return ReferenceVerdict(False, "stopped before it was tried")
    best, without_reference = _best_weight(trial, fit), _without(trial, fit, smooth, mu)
    if best is None or without_reference is None:
        return ReferenceVerdict(False, "stopped before it was tried")
    least = choice.best_residuals
    others = [("the same total variation without the reference", trial.in_line_integrals(without_reference.residuals))]
    others += [] if least is None or choice.best is None else [(choice.predictions[choice.best].name, least)]
    residuals_with = trial.in_line_integrals(best.residuals)
    residuals_text = f"{MEASURE}: with the reference {residuals_with.mean():#.4g}"
    for name, residuals in others:
        residuals_text += f"; with {name} {residuals.mean():#.4g}"
        if not significantly_better(residuals_with, residuals, LEAST_GAIN):
            return ReferenceVerdict(
                False, f"the reference does not predict held-out projections better than {name} ({residuals_text})"
            )
    if (direction := _better_displaced(trial, fit)) is not None:
        return ReferenceVerdict(
            False,
            (
                f"a copy of the reference that is displaced by a voxel {direction} predicts held-out projections "
                "equally well or better"
            ),
        )
    weight_of_all_views = best.strength * np.sqrt(ONE_IN / (ONE_IN - 1))
    of_scan = problem.units.prior(Prior(float(weight_of_all_views)), problem.weight is not None, 1).weight
    splines = Basis.splines(grid, width, KNOTS)
    bent = splines.nearest(fit.moved.u - padded(affine.field(coefficients)))
    edge = problem.units.projector(problem.projector, 1).grid.voxel_size
    motion_mm = [
        (edge * motion_voxels).ravel().tolist()
        for motion_voxels in (from_reference_middle, bent.mean(-1, keepdims=True))
    ]
    half_voxels = halves and _half_voxels_predict(trial, fit, best.strength)
    return ReferenceVerdict(True, residuals_text, of_scan, motion_mm[0], motion_mm[1], gains, half_voxels)


def _best_weight(trial: Trial, fit: StateFit) -> BestStrength | None:
    """The weight with which the reference predicts held-out projections best; None: the trials were stopped."""

    def residuals_of(weight: float) -> F64:
        other = fit.again(weight, fit.x)
        other.sharpen(1, CLEAR_LINES)
        return trial.residuals(other.x)

    return preferred_strength(residuals_of, fit.weight)


def _half_voxels_predict(trial: Trial, fit: StateFit, weight: float) -> bool:
    """Whether half voxels predict held-out projections as well as whole voxels. This ends the fit."""
    fit.weight = weight
    fit.sharpen(1, CLEAR_LINES)
    whole = trial.residuals(fit.x)
    fit.on_half_voxels(CLEAR_LINES)
    return predict_as_well_as(trial.residuals(fit.x), whole, _LARGEST_LOSS_OF_HALVES)


def _without(trial: Trial, fit: StateFit, smooth: F32, mu: float) -> BestStrength | None:
    """The same without the reference: total variation whose weights fall in the same way. The search starts at μ."""

    def residuals_of(weight: float) -> F64:
        other = fit.again(weight, smooth)
        other.alone()
        other.sharpen(1, CLEAR_LINES)
        return trial.residuals(other.x)

    return preferred_strength(residuals_of, mu)


def _better_displaced(trial: Trial, fit: StateFit) -> str | None:
    """The direction in which a copy of the reference, displaced by a voxel, predicts as well as the reference itself;
    None: there is no such direction.
    """

    def displaced(axis: int, step: int) -> F64:
        """The residuals with this copy. A function, because it frees the copy before the next one is made."""
        u = fit.moved.u.copy()
        u[axis] += step
        copy = fit.again(fit.weight, fit.x, replace(fit.moved, u=u))
        copy.solve(iterations=_DISPLACED_SWEEPS)
        return trial.residuals(copy.x)

    undisplaced = trial.residuals(fit.x)
    for axis in range(2 if fit.moved.u[2].any() == 0 else 3):
        for step in (-1, 1):
            if not exceeds_standard_error(displaced(axis, step) - undisplaced, 1.0):
                return f"along {'yxz'[axis]}"
    return None
