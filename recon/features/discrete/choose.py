"""Which few materials, and how strong a pull to them: by views held out, and none where they do not tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.decisions import MaterialPrior
from recon.base.empirical import ONE_IN
from recon.features.discrete.mixture import AIR, MaterialPull, fitted_levels, interior
from recon.voxels.choice import LEAST_GAIN, significantly_better
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem, density_unit

PULLS = (0.02, 0.005)
"""c, from strong to weak: the strong one takes 2 to 4 dB from smooth matter, and is refused there."""
LEAST_SHARE = 1 / 16  # of the weight of total variation
MODELS = ((2, True), (2, False), (3, True), (3, False))
"""Numbers of materials, with the air around the sample left out or not, the simplest first."""


def within(problem: VoxelProblem, x: F32, inside: bool, air: float) -> np.ndarray:
    """[y, x, z] voxels of the field, and without the air around the sample if only those `inside` are wanted."""
    _, y, across = problem.projector.grid.coordinates()
    field = np.hypot(y[:, None], across) < problem.projector.geometry.reach
    if inside:
        return interior(x, air) & field[:, :, None]
    return np.repeat(field[:, :, None], x.shape[2], axis=2)


class MaterialTrial:
    """Volumes pulled to a few materials, made of the views of a trial and judged by those held out.

    Attributes:
        smooth: residuals [view] of total variation alone.
        best, materials: the least residuals so far, and the materials of that volume.
    """

    def __init__(self, trial: Trial, weight: float, sweeps: int, levels: Sequence[float] | None) -> None:
        self._trial, self._sweeps, self._levels = trial, sweeps, levels
        self._weight = weight / math.sqrt(ONE_IN / (ONE_IN - 1))  # see `choose_weight`
        self._start = trial.volume_of_weight(self._weight) if trial.smooth is None else trial.smooth
        self._air = AIR * density_unit(self._start)
        self._where = {inside: within(trial.problem, self._start, inside, self._air) for inside in (True, False)}
        self.smooth = trial.residuals(self._start)
        self.best, self.materials = self.smooth, MaterialPrior()

    def choose(self) -> None:
        """Choose number of materials, share of total variation and pull."""
        models = MODELS if self._levels is None else ((len(self._levels), True), (len(self._levels), False))
        best, chosen = self._first_of([(count, inside, 0.5, PULLS[0]) for count, inside in models])
        if chosen.levels and len(chosen.levels) == 3 and self._levels is None:
            best, chosen = self._better((4, chosen.inside, 0.5, PULLS[0]), best, chosen)
        if not chosen.levels:
            return
        count, inside = len(chosen.levels), chosen.inside
        whole, of_whole = self._tried(count, inside, 1.0, PULLS[0])
        if significantly_better(best, whole, LEAST_GAIN):
            while (share := chosen.tv_share / 2) >= LEAST_SHARE:
                before = best
                best, chosen = self._better((count, inside, share, PULLS[0]), best, chosen)
                if best is before:
                    break
        else:
            best, chosen = whole, of_whole
        for pull in PULLS[1:]:
            best, chosen = self._better((count, inside, chosen.tv_share, pull), best, chosen)
        if significantly_better(best, self.smooth, LEAST_GAIN):
            self.best, self.materials = best, chosen

    def _first_of(self, models: Sequence[tuple[int, bool, float, float]]) -> tuple[F64, MaterialPrior]:
        best, chosen = np.full(self.smooth.shape, np.inf), MaterialPrior()
        for model in models:
            best, chosen = self._better(model, best, chosen)
        return best, chosen

    def _better(
        self, model: tuple[int, bool, float, float], best: F64, chosen: MaterialPrior
    ) -> tuple[F64, MaterialPrior]:
        residuals, materials = self._tried(*model)
        if np.isfinite(residuals).all() and (not chosen.levels or significantly_better(residuals, best, LEAST_GAIN)):
            return residuals, materials
        return best, chosen

    def _tried(self, count: int, inside: bool, tv_share: float, pull: float) -> tuple[F64, MaterialPrior]:
        """Residuals [view] of a volume, and its materials; infinite where there are not so many."""
        where = self._where[inside]
        none = np.full(self.smooth.shape, np.inf), MaterialPrior()
        if not where.any() or self._trial.ended:
            return none
        levels, weights = (
            fitted_levels(self._start[where], count)
            if self._levels is None
            else (np.array(self._levels), np.full(count, 1 / count))
        )
        if not np.diff(levels).min() > 0:
            return none
        first = MaterialPrior(tuple(levels.tolist()), tuple(weights.tolist()), tv_share, pull, inside)
        towards = MaterialPull(first, where, follows=self._levels is None)
        x = self._trial.volume_of_weight(self._weight * tv_share, self._start, self._sweeps, towards)
        return self._trial.residuals(x), towards.materials_in(x)
