"""Voxels half as wide as a pixel: the last iterations of total variation and of discrete tomography use them, and those
of a state with a reference.

A ray through voxels as wide as a pixel is interpolated between two of them. Therefore computed projections are more
blurred than measured ones (`recon.voxels.resolution`), and one voxel must stand for the sharp edge of a grain. Voxels
half as wide have a quarter of this blur. The result is the mean of the four small voxels in each voxel.

With 10⁴ photons, packed grains from 30 and 45 projections of 192 columns gain 0.2 to 0.5 dB with total variation, and
1.1 dB with discrete tomography. The residual in projections that were not used falls from 0.0190 to 0.0172 on a
measured electrode, and from 0.0049 to 0.0044 on a measured walnut. Smooth volumes gain nothing on average: bone, cement
and thorax from 24 and 36 projections of 129 columns change by -0.5 to +0.3 dB. Grains in a can 1.5 and 2 times as wide
as the field of view gain 0.1 to 0.4 dB with total variation, and 0.5 to 0.8 dB with discrete tomography.
(tests/bench/half_voxels.py)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.choices import Quality
from recon.base.decisions import Prior
from recon.base.empirical import ONE_IN, STILL_IN_TRIAL
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.iterative import VoxelMethod
from recon.voxels.ordered_fista import Prox, Pull, Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.resolution import smoothed
from recon.voxels.standstill import MOST_SWEEPS, USUAL_SWEEPS, with_quality
from recon.voxels.trial import TV_STEPS, Trial
from recon.voxels.voxel_problem import VoxelProblem, bytes_of

MethodT = TypeVar("MethodT")
MakePull = Callable[[VoxelProblem, F32], Pull]

COST, USUAL_FURTHER = 3, 30
"""Time of an iteration on half voxels, divided by that of an iteration on whole voxels (2.5 to 4.5 for 16 rows, up to
6.6 for 8 rows), and usual number of iterations on half voxels.
"""
DUAL_STEPS = 2
"""Factor on the dual steps of each proximal step.

The smoothing of total variation must cross twice as many half voxels as whole ones. With 3 dual steps on half voxels,
the errors of the proximal steps accumulate if the weight is heavy: a cathode from 45 projections of 512 columns had
21.9 dB and had not converged after 60 iterations. With 12 it has 23.9 dB, with 24 it has 24.1 dB after 25 iterations.
In eight scans of 192 columns, 24 instead of 3 change the volume by up to 0.07 dB and take 2 to 20 % more time. With 8
rows they take up to a third more.
"""
FEW, FEW_WITH_LEVELS = 1 / 3, 1.0
"""Numbers of projections below which half voxels are used, divided by the number of columns: usually, and with discrete
levels.

With more projections than a third of the columns, an iteration takes long, and samples without levels may lose: thorax
and bone from 50 projections of 129 columns 0.6 and 0.1 dB, and measured Diamond 0.2 dB in projections that were not
used. With discrete levels, grains, pores and foam gain 0.2 to 1.1 dB in 1.3 to 1.9 times the time, up to 0.98 times as
many projections as columns. Of samples that are not made of few materials, walnut kernel, bone and thorax lose 0.1, 0.1
and 0.4 dB if levels are not rejected; `auto` takes other methods for most of them.
"""
_MOST_COLUMNS, _WIDEST, _LEAST_WIDTH, _AS_WIDE = 1024, 2.2, 0.75, 0.1
# copies of half-voxel volumes: a quarter for the volume of whole voxels, the rest for the coarse cells of damping
_MORE_VOLUMES = 0.6
HALVES = "half_voxels"
"""Name of the decision whether half voxels are used, and with which weight: see `Prior.half_voxel_weight`."""
_TEST_ROWS, _MARGIN_ROWS = 8, 2
"""Number of rows of the test reconstruction with half voxels, and number of rows at each end that do not count.

Whole voxels were made from more rows. If the rows at the ends counted, whole voxels would seem 0.3 to 1 % better.
"""
LARGEST_LOSS, LARGEST_LOSS_WITH_LEVELS = 0.01, 0.004
"""Half voxels are used if they increase the residual in held-out projections by at most this share: with total
variation alone, and with discrete levels.

The measurements are in docs/decisions/voxels.md. The test reconstruction must converge. After 6 iterations, its
residual does not show whether half voxels improve the volume.
"""
HALF_VOXEL_WEIGHTS, _LEAST_FALL = (1.0, 0.7, 0.5, 0.35), 0.005
"""Weights of total variation that are tested on half voxels, divided by the weight on whole voxels, and the share by
which each must lower the residual of the weight before it.

With many photons, much of the residual on whole voxels is the error of these voxels. A heavy weight hides this error,
and is too heavy on half voxels: packed grains and bone from 41 projections of 128 columns with 10⁵ photons change by
+0.3 and -0.2 dB on half voxels with the same weight, and by +0.7 and +0.2 dB with half the weight. With 3·10³ photons,
half the weight costs 0.5 to 2 dB.
"""
BY_QUALITY: dict[Quality, bool | None] = {"preview": False, "standard": None, "best": True}
"""Whether the last iterations use half voxels, for each preset; None: see `uses_half_voxels`."""


class HalfVoxels(VoxelMethod):
    """A method whose iterations end when the volume has converged. The last iterations may use half voxels.

    Attributes:
        still: as in `FistaTv`.
        half_voxels: False: never; True: with any number of projections; None: see `uses_half_voxels`. If held-out
            projections show that half voxels predict worse than whole voxels, they are not used.
        few: as in `uses_half_voxels`.
        to_the_end: False: a fixed number of iterations, on whole voxels.
    """

    still: float
    half_voxels: bool | None
    few: ClassVar[float] = FEW
    to_the_end: ClassVar[bool] = True

    @property
    def usual_sweeps(self) -> int:
        """Usual number of iterations on whole voxels until the volume has converged."""
        return min(self.iterations, USUAL_SWEEPS)

    def further_sweeps(self, geometry: Geometry, grid: Grid) -> int:
        """Usual time of the iterations on half voxels, as a number of iterations on whole voxels."""
        return COST * min(self.iterations, USUAL_FURTHER) if self.halves(geometry, grid) else 0

    def halves(self, geometry: Geometry, grid: Grid) -> bool:
        """Whether the last iterations use half voxels."""
        return self.to_the_end and uses_half_voxels(self.half_voxels, geometry, grid, self.few)

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """For "best", the method ends nearer to the minimum and uses half voxels; for "preview", it ends farther from
        the minimum.
        """
        changed, wanted = with_quality(self, quality), BY_QUALITY[quality]
        return changed if wanted is None else with_halves(changed, wanted)

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Peak memory in bytes: on half voxels, volumes are four times as large, and no FBP is made."""
        whole = bytes_of(self.buffers, geometry, grid, weighted)
        if not self.halves(geometry, grid):
            return whole
        on_halves = replace(self.buffers, volumes=self.buffers.volumes + _MORE_VOLUMES, filtered=False)
        return max(whole, bytes_of(on_halves, geometry, halved(grid), weighted))

    @property
    def half_voxel_weights(self) -> tuple[float, ...]:
        """The weights of total variation that are tested on half voxels, see `HALF_VOXEL_WEIGHTS`."""
        return HALF_VOXEL_WEIGHTS

    def half_voxel_weight_of(self, trial: Trial, prior: Prior) -> float:
        """The weight that `best_half_voxel_weight` finds for the volume that the method makes in a trial.

        Args:
            prior: the prior of the volume, in the units of the trial.
        """
        weight = prior.weight / math.sqrt(ONE_IN / (ONE_IN - 1))  # see `choose_weight`
        whole = trial.volume_of_weight(weight) if trial.smooth is None else trial.smooth
        return best_half_voxel_weight(trial, whole, weight, self.half_voxel_weights, LARGEST_LOSS)

    def half_voxel_weight(self, problem: VoxelProblem, prior: Prior, trial: Callable[[], Trial | None]) -> float:
        """The weight of total variation on half voxels, divided by the weight on whole voxels; 0: the volume does not
        use half voxels, because of `halves` or of `best_half_voxel_weight`.

        If the prior was chosen before, or if no projections can be held out, nothing more is tested.
        """

        def decided() -> float:
            if problem.prior is not None:
                return 1.0 if problem.prior.half_voxel_weight is None else problem.prior.half_voxel_weight
            judge = trial()
            return 1.0 if judge is None else self.half_voxel_weight_of(judge, prior)

        projector = problem.projector
        return problem.decide(HALVES, decided) if self.halves(projector.geometry, projector.grid) else 0.0

    def in_half_voxels(
        self, problem: VoxelProblem, x: F32, mu: float, weight: float, tv_steps: int, pull: MakePull | None = None,
        first: int = 0,
    ) -> F32:  # fmt: skip
        """The volume x [y, x, z] after further iterations on half voxels. The record states a weight below 1.

        Args:
            x: the volume of whole voxels.
            mu: weight μ of total variation with whole voxels.
            weight: the weight on half voxels, divided by μ.
            tv_steps: dual steps of each proximal step with whole voxels.
            pull: as in `on_half_voxels`.
            first: number of planned iterations before those that made x, for the progress.
        """
        decide = problem.decide
        sweeps_before = 0 if decide.ended is None else decide.ended.after
        x = on_half_voxels(
            problem, x, weight * mu, lambda fine: tv_prox(fine, DUAL_STEPS * tv_steps), done=first + sweeps_before,
            sweeps=self.iterations, still=self.still, pull=pull,
        )  # fmt: skip
        if weight < 1:
            decide.settings["half_voxel_weight"] = weight
        if (ended := decide.ended) is not None:
            decide.ended = ended._replace(after=sweeps_before + ended.after, on_half_voxels=ended.after)
        return x


def with_halves(method: MethodT, wanted: bool) -> MethodT:
    """The method that uses half voxels always or never, if it is one that can; otherwise the method itself."""
    settings: Any = method
    changed: MethodT = replace(settings, half_voxels=wanted) if isinstance(method, HalfVoxels) else method
    return changed


def uses_half_voxels(wanted: bool | None, geometry: Geometry, grid: Grid, few: float = FEW) -> bool:
    """Whether the last iterations use voxels of half a pixel.

    None: only for a parallel beam with few projections. Voxels must be as wide as pixels: with voxels of 0.8 and 1.5
    pixels, errors grew by 2 to 11 %. The grid may have up to 1024 columns, because half voxels need four times the
    memory. It may be up to 2.2 times as wide as the field of view: with a sample three times as wide, the share of
    wrong voxels grew from 17 to 19 %.

    Half voxels are not used for a cone beam, because they change the PSNR of total variation by -0.8 to +0.7 dB.
    (Ellipsoids in a can: -0.8, -0.1 and +0.3 dB; batteries: -0.5 to -0.2 dB. With 0.7 times the weight, -0.5 dB would
    be +0.2 dB.)

    True: always, unless voxels are narrower than 0.75 pixels.

    Args:
        few: number of projections below which they are few, divided by the number of columns of the detector.
    """
    columns, own, width = grid.shape[2], geometry.detector_shape[1], grid.voxel_size / geometry.sample_pitch
    if wanted is False or width < _LEAST_WIDTH:
        return False
    are_few = geometry.n_views < few * own and columns <= min(_MOST_COLUMNS, _WIDEST * own)
    return wanted is True or (are_few and abs(width - 1) < _AS_WIDE and not geometry.is_cone)


def best_half_voxel_weight(
    trial: Trial, whole: F32, mu: float, weights: Sequence[float], largest_loss: float, pull: MakePull | None = None
) -> float:
    """The weight of total variation with which half voxels predict the held-out projections of a trial, divided by the
    weight on whole voxels; 0: they predict worse than whole voxels by more than `largest_loss`.

    If half voxels predict worse with the largest weight, smaller weights are tested as long as each lowers the residual
    clearly.

    Args:
        whole: the volume [y, x, z] of whole voxels from the projections that are not held out.
        mu, pull: weight μ of total variation in that volume, and its pull; see `on_half_voxels`.
        weights: the weights on half voxels, divided by the weight on whole voxels; the largest first.
        largest_loss: as in `predict_as_well_as`.
    """
    part, rows = trial.in_the_middle(_TEST_ROWS)
    judge, inner = part.in_the_middle(_TEST_ROWS - 2 * _MARGIN_ROWS)

    def residuals_of(x: F32) -> F64:
        return judge.residuals(np.ascontiguousarray(x[:, :, inner]))

    def volume_of(weight: float) -> F32:
        return part.volume_by(
            lambda problem, x: on_half_voxels(
                problem, x, weight * mu, lambda fine: tv_prox(fine, DUAL_STEPS * TV_STEPS), done=0, sweeps=MOST_SWEEPS,
                still=STILL_IN_TRIAL, pull=pull,
            ), first,
        )  # fmt: skip

    first = np.ascontiguousarray(whole[:, :, rows])
    of_whole, best, least = residuals_of(first), weights[0], residuals_of(volume_of(weights[0]))
    for weight in () if least.mean() <= of_whole.mean() else weights[1:]:
        residuals = residuals_of(volume_of(weight))
        if not residuals.mean() < (1 - _LEAST_FALL) * least.mean():
            break
        best, least = weight, residuals
    return best if trial.ended or predict_as_well_as(least, of_whole, largest_loss) else 0.0


def predict_as_well_as(halves: F64, whole: F64, largest_loss: float) -> bool:
    """Whether the residuals [held-out view] of half voxels exceed those of whole voxels by at most this share.

    True if both are infinite, because the tests were stopped.
    """
    return bool(halves.mean() <= (1 + largest_loss) * whole.mean())


def on_half_voxels(
    problem: VoxelProblem, x: F32, mu: float, prox_of: Callable[[VoxelProblem], Prox], *, done: int, sweeps: int,
    still: float, pull: MakePull | None = None,
) -> F32:  # fmt: skip
    """The volume x [y, x, z] of whole voxels after further iterations of `ordered_fista` on half voxels.

    Total variation is a surface times a change of density. Differences between voxels half as wide, summed over four
    times as many voxels, are twice as large. Therefore the weight is halved.

    Args:
        mu: weight μ of total variation with whole voxels, times the weight of half voxels (see `HALF_VOXEL_WEIGHTS`).
        prox_of: function of the problem with half voxels; returns the proximal step.
        done: number of iterations on whole voxels, for the progress.
        sweeps, still: as in `ordered_fista`.
        pull: function of the problem with half voxels and of its first volume; returns the pull of each step.
    """
    fine, start = _with_half_voxels(problem, done), repeated(x)
    on_halves = ordered_fista(
        fine, start, TvWeight(mu / 2), _subsets(fine), sweeps=sweeps, prox=prox_of(fine),
        pull=None if pull is None else pull(fine, start), still=still,
    )  # fmt: skip
    ny, nx, nz = x.shape
    return on_halves.reshape(ny, 2, nx, 2, nz).mean(axis=(1, 3), dtype=np.float32)


def _subsets(problem: VoxelProblem) -> Subsets:
    """All projections in each step if steps are damped; otherwise subsets, because steps are then short."""
    together = Subsets.of(problem, 1)
    return together if together.is_damped else Subsets.of(problem, subsets_of(problem.projector.geometry))


def halved(grid: Grid) -> Grid:
    """The grid with voxels half as wide along y and x, and with the same slices."""
    nz, ny, nx = grid.shape
    return Grid((nz, 2 * ny, 2 * nx), grid.voxel_size / 2, grid.centre, grid.spacing[0])


def repeated(x: F32) -> F32:
    """The volume x [y, x, z] of whole voxels on half voxels: four equal ones in each voxel."""
    return np.repeat(np.repeat(x, 2, axis=0), 2, axis=1)


def _with_half_voxels(problem: VoxelProblem, done: int) -> VoxelProblem:
    """The problem with half voxels, whose iterations follow `done` iterations on whole ones."""
    projector = replace(problem.projector, grid=halved(problem.projector.grid))
    data = smoothed(problem.views, projector.resolution, None if problem.weight is None else problem.weight > 0)
    all_columns = problem.with_all_columns
    return replace(
        problem, projector=projector, data=data, measured=None if data is problem.views else problem.views,
        go_on=problem.go_on.after(done, COST), _norms=[],
        with_all_columns=None if all_columns is None else lambda: _with_half_voxels(all_columns(), done),
    )  # fmt: skip
