"""Which few materials, and how strong a pull to them: by views held out, and none where they do not tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F64
from recon.base.decisions import MaterialPrior
from recon.base.empirical import ONE_IN
from recon.features.discrete.mixture import LEAST_NOISE, NOISE, MaterialPull, are_apart, fitted_levels
from recon.voxels.choice import LEAST_GAIN, significantly_better
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem

PULLS = (0.02, 0.005)
"""c, from strong to weak: the strong one takes 2 to 4 dB from smooth matter, and is refused there."""
COUNTS = (2, 3)
"""Numbers of materials, air among them or not; four are tried where three are best."""
_LEAST_SHARE = 1 / 16  # of the weight of total variation
_HEAVIER = 2.0
"""Times the share of total variation that predicts views held out best. Of volumes that stand still (packed grains,
cracks and polyhedra of 192 columns, 30 and 45 views) that share is best by the truth: 1.6 to 2.4 times, within 0.1 dB.
Without: -0.4 to -1.6 dB."""


def in_field(problem: VoxelProblem) -> NDArray[np.bool_]:
    """[y, x, z] voxels that some view sees in each turn: those beyond have no rays enough to tell materials."""
    _, y, x = problem.projector.grid.coordinates()
    field = np.hypot(y[:, None], x) < problem.projector.geometry.reach
    return np.repeat(field[:, :, None], problem.projector.grid.shape[0], axis=2)


class MaterialTrial:
    """Volumes pulled to a few materials, made of the views of a trial and judged by those held out.

    Attributes:
        smooth: residuals [view] of total variation alone.
        best, materials: the least residuals, and the materials of that volume; those of total variation, and none,
            where few materials do not predict significantly better.
    """

    def __init__(self, trial: Trial, weight: float, sweeps: int, levels: Sequence[float] | None) -> None:
        """For the weight of total variation of all views; `levels` in the units of the trial, None: by EM."""
        self._trial, self._sweeps, self._levels = trial, sweeps, levels
        self._weight = weight / math.sqrt(ONE_IN / (ONE_IN - 1))  # see `choose_weight`
        self._start = trial.volume_of_weight(self._weight) if trial.smooth is None else trial.smooth
        self._where = in_field(trial.problem)
        self.smooth = trial.residuals(self._start)
        self.best, self.materials = self.smooth, MaterialPrior()

    def choose(self) -> None:
        """Choose number of materials, share of total variation and pull.

        If `Trial.wide`, at least all of total variation is kept. Views held out also contain what lies beside the
        field, and prefer an eighth to a half of it: of packed balls in a can 1.5, 2 and 3 times as wide as the field
        that would cost 0.5, 0.8 and 0.7 dB. Of one 1.06 times as wide they rightly prefer twice as much, by 1.1 dB.
        """
        least_share = 1.0 if self._trial.wide else _LEAST_SHARE
        first, *others = COUNTS if self._levels is None else (len(self._levels),)
        share = 1.0
        best, chosen = self._tried(first, share, PULLS[0])
        for count in others:
            best, chosen = self._better(best, chosen, count, share)
        # Of a tooth and of a rod with a pin of metal the best is 0.3 and 1 % worse here, of packed grains 4 % better.
        if not chosen.levels or np.square(best).sum() >= np.square(self.smooth).sum():
            return
        if self._levels is None and len(chosen.levels) == COUNTS[-1]:
            best, chosen = self._better(best, chosen, COUNTS[-1] + 1, share)
        count = len(chosen.levels)
        best, chosen, tv_share = self._share_of_smoothing(best, chosen, least_share)
        for pull in PULLS[1:]:
            best, chosen = self._better(best, chosen, count, chosen.tv_share, pull)
        if not significantly_better(best, self.smooth, LEAST_GAIN):
            return
        if self._trial.settings.early:  # as many sweeps more of total variation predict smooth matter better, too
            continued = self._trial.volume_of_weight(self._weight, self._start, self._sweeps)
            if not significantly_better(best, self._trial.residuals(continued), LEAST_GAIN):
                return
        self.best, self.materials = best, chosen._replace(tv_share=tv_share)

    def _share_of_smoothing(
        self, best: F64, chosen: MaterialPrior, least_share: float
    ) -> tuple[F64, MaterialPrior, float]:
        """Residuals and materials of the share of total variation that predicts best in octaves, and the share chosen.

        Octaves are tried from 1 down to `least_share` while half the share predicts better by `LEAST_GAIN`. The vertex
        of the parabola through the best and its neighbours is taken, and `_HEAVIER` times it is chosen. Of a sample
        wider than the field the octave itself is.
        """
        count, tried = len(chosen.levels), {chosen.tv_share: (best, chosen)}

        def at(tv_share: float) -> tuple[F64, MaterialPrior]:
            if tv_share not in tried:
                tried[tv_share] = self._tried(count, tv_share, PULLS[0])
            return tried[tv_share]

        share = 1.0
        while share > least_share and significantly_better(at(share / 2)[0], at(share)[0], LEAST_GAIN):
            share /= 2
        lighter, own, heavier = (float(at(each)[0].mean()) for each in (max(share / 2, least_share), share, 2 * share))
        below, above = lighter - own, heavier - own
        octaves = float(np.clip((below - above) / (2 * (below + above)), -0.5, 0.5)) if below + above > 0 else 0.0
        return *at(share), max(share if self._trial.wide else share * _HEAVIER * 2.0**octaves, least_share)

    def _better(
        self, best: F64, chosen: MaterialPrior, count: int, tv_share: float, pull: float = PULLS[0]
    ) -> tuple[F64, MaterialPrior]:
        """The best so far, or this one if it predicts significantly better."""
        residuals, materials = self._tried(count, tv_share, pull)
        if significantly_better(residuals, best, LEAST_GAIN):
            return residuals, materials
        return best, chosen

    def _tried(self, count: int, tv_share: float, pull: float) -> tuple[F64, MaterialPrior]:
        """Residuals [view] of a volume, and its materials; infinite, and none, where there are not so many levels."""
        levels, weights = (
            fitted_levels(self._start[self._where], count)
            if self._levels is None
            else (np.array(self._levels), np.full(count, 1 / count))
        )
        if self._trial.ended or (self._levels is None and not are_apart(levels)):
            return np.full(self.smooth.shape, np.inf), MaterialPrior()
        first = MaterialPrior(tuple(levels.tolist()), tuple(weights.tolist()), tv_share, pull)
        none_thin, noise = np.broadcast_to(np.int8(0), self._start.shape), min(NOISE, LEAST_NOISE / math.sqrt(tv_share))
        towards = MaterialPull(first, self._where, none_thin, noise, follows=self._levels is None)
        x = self._trial.volume_of_weight(self._weight * tv_share, self._start, self._sweeps, towards)
        return self._trial.residuals(x), towards.materials_in(x)
