"""Trial fit: how well the volume of a fit, refined on voxels, predicts views held out, by as few steps as will do."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.decisions import Prior
from recon.base.geometry import Geometry
from recon.splatting.finish import FINISH_SWEEPS, beyond_voxels, level_of, refine
from recon.splatting.fit_method import Fit
from recon.splatting.gaussians import Gaussians
from recon.voxels.choice import Prediction, TrialChoice, significantly_better
from recon.voxels.projector import projection_lines
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem, times_power

FAR_BEHIND = 0.25
"""Of a trial fit's residual: total variation that leaves so much less ends the trial at the first look. Without: half
as much time again. Of 17 scans two fits win, whose residuals are 1.17 and 1.22 times those of total variation there;
ten others have 1.45 times and more, and end."""

FIRST_SHARE = 0.25
"""Of the steps of a trial fit, after which it is looked at first. Without: 0.9 CPU s more, of 3."""


def predict(method: Fit, trial: Trial, so_far: TrialChoice, prior: Prior) -> Prediction:
    """The prediction of a fit of the views that are not held out: a fit of all views would know the others.

    It ends after a quarter of its steps where it then leads the simpler candidates, or is far behind total variation.

    No prior is named where the fit takes matter beyond the box off the views: from all of them a region of interest
    gets one that costs 1.3 dB.
    """
    begin = trial.settings.now()
    tried = _Fit.of(method, trial, FIRST_SHARE)
    smooth, best = trial.residuals_of_weight(prior.weight), so_far.least
    left, remark = tried.refined(prior), ""
    leads = best is None or significantly_better(trial.in_line_integrals(left), best, so_far.least_gain)
    if so_far.least_gain > 0 and not leads and significantly_better(smooth, left, FAR_BEHIND):
        remark = (
            f"{method.name} stopped after {FIRST_SHARE:.0%} of its steps, too far behind (a full trial: about "
            f"{(trial.settings.now() - begin) / FIRST_SHARE:.2g} s; --quality best runs it)"
        )
    elif not leads:
        tried = _Fit.of(method, trial, 1.0)
        left = tried.refined(prior)
    apart = tried.level_beyond > left.mean()
    return trial.prediction(method.name, left, None if apart else prior, remark)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit of the views that are not held out, in the units of a trial.

    Attributes:
        start: its volume.
        beyond, beyond_unseen: [view, col, row] what it explains beyond its box in the views fitted, and in the others.
    """

    trial: Trial
    start: F32
    beyond: F32 | None
    beyond_unseen: F32 | None

    @classmethod
    def of(cls, method: Fit, trial: Trial, share: float) -> _Fit:
        """The fit with this share of its steps.

        Raises:
            ValueError: it does not take these views, such as rows without matter.
        """
        views = trial.views_of(method)
        rows = views.geometry.detector_shape[0] / trial.scan.projector.geometry.detector_shape[0]
        made = method.for_trial(rows, share).run(views, trial.control)
        units, cols = trial.problem.units, trial.all_columns.cols
        model, box = made.gaussians, made.volume.grid
        assert isinstance(model, Gaussians)

        def beyond(geometry: Geometry) -> F32 | None:
            lines = beyond_voxels(model, geometry, box, method.fit)
            if lines is None:
                return None
            return times_power(np.ascontiguousarray(projection_lines(lines)[:, cols]), -units.integral)

        unseen = trial.all_columns.unseen.scaled(math.ldexp(1.0, units.length))
        return cls(trial, trial.lines_of(made.volume), beyond(views.geometry), beyond(unseen))

    def refined(self, prior: Prior) -> F64:
        """Residuals [view held out] of the volume refined by total variation.

        Only where that leaves less than total variation alone do patches follow, which cost four times as much: else
        they would not lead patches either.
        """
        residuals = self._by(prior, 0.0)
        if prior.patches and residuals.mean() < self.trial.residuals_of_weight(prior.weight).mean():
            return self._by(prior, prior.strength)
        return residuals

    def _by(self, prior: Prior, strength: float) -> F64:
        def make(problem: VoxelProblem, x: F32) -> F32:
            some = problem if self.beyond is None else replace(problem, data=problem.data - self.beyond)
            return refine(some, x, prior.weight, strength, FINISH_SWEEPS)

        other = None if self.beyond_unseen is None else level_of(self.beyond_unseen)
        return self.trial.residuals(self.trial.volume_by(make, self.start), other)

    @property
    def level_beyond(self) -> float:
        """Root mean square of what is beyond the box in the views held out."""
        if self.beyond_unseen is None:
            return 0.0
        return math.sqrt(np.mean(np.square(self.beyond_unseen, dtype=np.float64)))
