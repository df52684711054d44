"""Chooses the discrete levels and the strength of the pull to them, with held-out projections; or no levels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import MaterialPrior
from recon.base.empirical import ONE_IN
from recon.features.discrete.mixture import (
    LEAST_NOISE,
    NOISE,
    MaterialPull,
    are_apart,
    drawn_apart,
    fitted_levels,
    thin_parts,
)
from recon.voxels.choice import LEAST_GAIN, significantly_better
from recon.voxels.half_voxels import HALF_VOXEL_WEIGHTS, LARGEST_LOSS_WITH_LEVELS, best_half_voxel_weight
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem

PULL, WEAK_PULL = 0.02, 0.005
"""Factor c of the pull, and a weaker one.

If the weaker one predicts held-out projections better, the densities of a material may vary. The levels are then used
only if the volume as it will be made predicts better than total variation. (Bone from 50 projections and a walnut in a
cone from 40: pulled weakly, the residual in held-out projections is 11 and 5 % smaller than with total variation, but
the volume is 1.2 and 1.0 dB worse, at best 0.1 dB better with another weight. PnP-DCT gains 1.7 dB there.) Levels that
the user gives are pulled to weakly if no projections can be held out.
"""
COUNTS = (2, 3)
"""Numbers of levels that are tried (air may be one of them); four are tried if three are best."""
_LEAST_SHARE = 1 / 16  # smallest share of the weight of total variation
_SHARE_FACTOR = 1.75
"""Factor on the share of total variation that predicts the held-out projections best.

In the PSNR, the ground truth prefers 1.5 to 2 times that share. With 1.5 instead of 2, 16 scans of 192 and 512 columns
change by -0.5 to +0.3 dB (mean -0.05), and cracks are deeper: those thinner than a voxel keep 0.68 instead of 0.58 of
their depth (120 projections), and 0.58 instead of 0.41 (60 projections). 1.75 lies between the two in both. The factor
1 costs up to 1.7 dB. On eleven scans of other packings, 1.75 instead of 2 changes the PSNR by -0.2 to +0.1 dB (median
-0.1), and cracks thinner than a voxel keep 0.69 instead of 0.66 of their depth (60 projections).
"""


def in_field(problem: VoxelProblem) -> NDArray[np.bool_]:
    """[y, x, z] voxels inside the field of view of a 360° scan; outside, too few rays distinguish the levels."""
    _, y, x = problem.projector.grid.coordinates()
    field = np.hypot(y[:, None], x) < problem.projector.geometry.reach
    return np.repeat(field[:, :, None], problem.projector.grid.shape[0], axis=2)


def pull_to(materials: MaterialPrior, problem: VoxelProblem, x: F32) -> MaterialPull:
    """The pull of x [y, x, z], the volume of total variation, to these materials in the field of view."""
    return MaterialPull(drawn_apart(materials), in_field(problem), thin_parts(x, materials))


class MaterialTrial:
    """Test reconstructions with discrete levels, compared in held-out projections.

    Attributes:
        smooth: residuals [view] with total variation alone.
        best, materials: smallest residuals, and the levels of that volume. If no levels pass all tests: the
            residuals with total variation, and a `MaterialPrior` without levels.
    """

    def __init__(self, trial: Trial, weight: float, sweeps: int, levels: Sequence[float] | None) -> None:
        """`weight`: weight of total variation for all projections. `levels`: levels in the units of the test; None:
        found by EM.
        """
        self._trial, self._sweeps, self._levels = trial, sweeps, levels
        self._weight = weight / math.sqrt(ONE_IN / (ONE_IN - 1))  # see `choose_weight`
        self._start = trial.volume_of_weight(self._weight) if trial.smooth is None else trial.smooth
        self._where = in_field(trial.problem)
        self.smooth = trial.residuals(self._start)
        self.best, self.materials = self.smooth, MaterialPrior()

    def choose(self) -> None:
        """Choose the number of levels, the share of total variation and the noise of a voxel; or no levels.

        The levels are rejected if a weaker pull predicts better, see `WEAK_PULL`. The noise is `NOISE`, or
        `LEAST_NOISE` if a volume as it will be made predicts worse than total variation, because too many voxels
        between two levels are then pulled. (Polyhedra of two densities from 36 and 60 projections with 10⁵ photons: 0.6
        and 1.2 dB worse than total variation with `NOISE`, 1.0 and 0.5 dB better with `LEAST_NOISE`.)

        Levels whose volume, as it will be made with `NOISE`, predicts better than total variation are used, also if a
        weaker pull predicts even better. (Packed grains of 512 columns from 90 projections with 10⁵ photons: levels
        gain 1.5 dB, and a weaker pull lowers the residual by a further 4 %. For bone, the volume with `NOISE` predicts
        worse.) This does not hold for the refinement of a fit.

        If the levels lower the residual by less than `LEAST_GAIN`, and the volumes with `NOISE` and with `LEAST_NOISE`
        both predict worse than total variation, the levels are rejected. A smaller gain alone does not reject levels,
        because noise can be nearly the whole residual (docs/decisions/voxels.md has the table). For the refinement of
        a fit, levels must lower the residual by `LEAST_GAIN`.

        If the sample is wider than the field of view (`Trial.wide`), the weight of total variation is not lowered.
        Held-out projections then also contain the sample outside the field of view, and prefer an eighth to a half of
        the weight. For packed balls in a can 1.5, 2 and 3 times as wide as the field, this would cost 0.5, 0.8 and 0.7
        dB. For a can 1.06 times as wide they rightly prefer twice the weight, which gains 1.1 dB.

        If the tests are stopped before the last one, no levels are used, because the last tests may reject them.
        """
        passing = self._passing()
        if passing is not None and not self._trial.ended:
            self.best, self.materials = passing

    def _passing(self) -> tuple[F64, MaterialPrior] | None:
        """The residuals and the levels that pass all tests; None: there are no such levels, or the tests were
        stopped.
        """
        least_share = 1.0 if self._trial.wide else _LEAST_SHARE
        first, *others = COUNTS if self._levels is None else (len(self._levels),)
        share = 1.0
        best, chosen = self._tried(first, share)
        for count in others:
            best, chosen = self._better(best, chosen, count, share)
        # For a tooth and a rod with a metal pin, the best is 0.3 and 1 % worse here; for packed grains it is 4 %
        # better.
        if not chosen.levels or np.square(best).sum() >= np.square(self.smooth).sum():
            return None
        if self._levels is None and len(chosen.levels) == COUNTS[-1]:
            best, chosen = self._better(best, chosen, COUNTS[-1] + 1, share)
        count = len(chosen.levels)
        best, chosen, tv_share = self._share_of_smoothing(best, chosen, least_share)
        early = self._trial.settings.early
        if self._trial.ended or not significantly_better(best, self.smooth, LEAST_GAIN if early else 0.0):
            return None
        as_made = chosen._replace(tv_share=tv_share)
        if not early and self._is_better(as_made):
            return best, as_made
        weakly, _ = self._tried(count, chosen.tv_share, WEAK_PULL)
        if self._trial.ended or significantly_better(weakly, best, LEAST_GAIN):
            return None
        if early:
            # For a fit, the same number of further iterations of total variation also predicts smooth samples better.
            continued = self._trial.volume_of_weight(self._weight, self._start, self._sweeps)
            if not significantly_better(best, self._trial.residuals(continued), LEAST_GAIN):
                return None
            if self._is_better(as_made):
                return best, as_made
        fewer = as_made._replace(noise=LEAST_NOISE)
        if significantly_better(best, self.smooth, LEAST_GAIN) or self._is_better(fewer):
            return best, fewer
        return None

    def half_voxel_weight(self, materials: MaterialPrior) -> float:
        """The weight that `best_half_voxel_weight` finds for a volume with these levels."""
        whole, weight = self._as_made(materials), self._weight * materials.tv_share
        return best_half_voxel_weight(
            self._trial, whole, weight, HALF_VOXEL_WEIGHTS, LARGEST_LOSS_WITH_LEVELS, partial(pull_to, materials)
        )

    def _is_better(self, materials: MaterialPrior) -> bool:
        """Whether a volume as it will be made with these levels predicts better than total variation."""
        return bool(self._trial.residuals(self._as_made(materials)).mean() < self.smooth.mean())

    def _share_of_smoothing(
        self, best: F64, chosen: MaterialPrior, least_share: float
    ) -> tuple[F64, MaterialPrior, float]:
        """Choose the share of total variation; returns its residuals and levels, and the share.

        The share is halved from 1 down to `least_share` as long as half the share predicts better by `LEAST_GAIN`. Then
        the vertex of the parabola through the best share and its neighbours is taken. The result is `_SHARE_FACTOR`
        times that vertex. If the sample is wider than the field of view, it is the best share itself.
        """
        count, trials = len(chosen.levels), {chosen.tv_share: (best, chosen)}

        def trial_of(tv_share: float) -> tuple[F64, MaterialPrior]:
            if tv_share not in trials:
                trials[tv_share] = self._tried(count, tv_share)
            return trials[tv_share]

        share = 1.0
        while share > least_share and significantly_better(trial_of(share / 2)[0], trial_of(share)[0], LEAST_GAIN):
            share /= 2
        lighter, middle, heavier = (
            float(trial_of(each)[0].mean()) for each in (max(share / 2, least_share), share, 2 * share)
        )
        lighter_excess, heavier_excess = lighter - middle, heavier - middle
        octaves = (
            float(np.clip((lighter_excess - heavier_excess) / (2 * (lighter_excess + heavier_excess)), -0.5, 0.5))
            if lighter_excess + heavier_excess > 0
            else 0.0
        )
        return *trial_of(share), max(share if self._trial.wide else share * _SHARE_FACTOR * 2.0**octaves, least_share)

    def _better(self, best: F64, chosen: MaterialPrior, count: int, tv_share: float) -> tuple[F64, MaterialPrior]:
        """This candidate if it predicts significantly better, otherwise the best one so far."""
        residuals, materials = self._tried(count, tv_share)
        if significantly_better(residuals, best, LEAST_GAIN):
            return residuals, materials
        return best, chosen

    def _tried(self, count: int, tv_share: float, pull: float = PULL) -> tuple[F64, MaterialPrior]:
        """Residuals [view] of a test reconstruction, and its levels; infinite and none if there are fewer levels or the
        tests were stopped.
        """
        no_result = np.full(self.smooth.shape, np.inf), MaterialPrior()
        if self._trial.ended:
            return no_result
        levels, weights = (
            fitted_levels(self._start[self._where], count)
            if self._levels is None
            else (np.array(self._levels), np.full(count, 1 / count))
        )
        if self._levels is None and not are_apart(levels):
            return no_result
        prior = MaterialPrior(tuple(levels.tolist()), tuple(weights.tolist()), tv_share, pull, NOISE)
        none_thin, noise = np.broadcast_to(np.int8(0), self._start.shape), min(NOISE, LEAST_NOISE / math.sqrt(tv_share))
        material_pull = MaterialPull(prior._replace(noise=noise), self._where, none_thin, follows=self._levels is None)
        x = self._volume_by(material_pull)
        return self._trial.residuals(x), material_pull.materials_in(x)._replace(noise=NOISE)

    def _as_made(self, materials: MaterialPrior) -> F32:
        """The volume with all settings of the final volume with these levels."""
        return self._volume_by(pull_to(materials, self._trial.problem, self._start))

    def _volume_by(self, pull: MaterialPull) -> F32:
        """The volume of total variation that is pulled to these levels."""
        weight = self._weight * pull.materials.tv_share
        return self._trial.volume_of_weight(weight, self._start, self._sweeps, pull)
