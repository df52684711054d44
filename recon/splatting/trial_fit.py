"""Test fit: measures with few steps how well a Gaussian fit with voxel refinement predicts held-out projections."""

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
from recon.voxels.beyond_field import reach_of
from recon.voxels.choice import Prediction, TrialChoice, significantly_better
from recon.voxels.priors import TvWeight
from recon.voxels.projector import projection_lines
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem, times_power

FAR_BEHIND = 0.25
"""Margin of a test fit at its first check: it ends if its residual exceeds that of total variation by this share.

Without this rule, the test takes half as much time again. Of 17 scans, the fit is best in two. In these two, the
residual of the fit at the first check is 1.17 and 1.22 times that of total variation. In ten of the others it is 1.45
times or more, and the test ends.
"""

FIRST_SHARE = 0.25
"""Share of the steps after which a test fit is checked first. Without this check, a test takes 0.9 s more CPU time, of
3 s."""


def predict(method: Fit, trial: Trial, so_far: TrialChoice, prior: Prior) -> Prediction:
    """How well a fit predicts the held-out projections. It is a fit to the other projections, because a fit to all
    would have used the held-out ones.

    The fit is checked after a quarter of its steps. It ends there if it is already better than the simpler candidates,
    or much worse than total variation.

    The prediction names no prior if the Gaussians outside the box contribute more to the projections than the residual.
    The fit subtracts this contribution. For a region of interest, a prior that was chosen from the whole projections
    would cost 1.3 dB.
    """
    begin = trial.settings.now()
    fit = _Fit.of(method, trial, FIRST_SHARE)
    smooth, best = trial.smooth_residuals, so_far.best_residuals
    residuals, remark = fit.refined(prior), ""
    leads = best is None or significantly_better(trial.in_line_integrals(residuals), best, so_far.least_gain)
    if so_far.least_gain > 0 and not leads and significantly_better(smooth, residuals, FAR_BEHIND):
        remark = (
            f"{method.name} stopped after {FIRST_SHARE:.0%} of its steps, because its residual was much larger than "
            f"that of total variation (a full test takes about {(trial.settings.now() - begin) / FIRST_SHARE:.2g} s; "
            "--quality best runs the full test)"
        )
    elif not leads:
        fit = _Fit.of(method, trial, 1.0)
        residuals = fit.refined(prior)
    is_level_apart = fit.level_beyond > residuals.mean()
    return trial.prediction(method.name, residuals, None if is_level_apart else prior, remark)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit to the projections that are not held out, in the units of the test reconstruction.

    Attributes:
        start: volume of the fit.
        beyond, beyond_unseen: [view, col, row] contribution of Gaussians outside the box to the fitted and to the
            held-out projections.
    """

    trial: Trial
    start: F32
    beyond: F32 | None
    beyond_unseen: F32 | None

    @classmethod
    def of(cls, method: Fit, trial: Trial, share: float) -> _Fit:
        """The test fit, after this share of its steps.

        Raises:
            ValueError: the fit cannot use these projections, for example rows without material.
        """
        views = trial.views_of(method)
        rows = views.geometry.detector_shape[0] / trial.scan.projector.geometry.detector_shape[0]
        fit = method.for_trial(rows, share).run(views, trial.control)
        units, cols = trial.problem.units, trial.all_columns.cols
        model, box = fit.gaussians, fit.volume.grid
        assert isinstance(model, Gaussians)

        is_cut = reach_of(views.views).is_cut_by(box, views.geometry)

        def beyond(geometry: Geometry) -> F32 | None:
            lines = beyond_voxels(model, geometry, box, method.fit) if is_cut else None
            if lines is None:
                return None
            return times_power(np.ascontiguousarray(projection_lines(lines)[:, cols]), -units.integral)

        unseen = trial.all_columns.unseen.scaled(math.ldexp(1.0, units.length))
        return cls(trial, trial.lines_of(fit.volume), beyond(views.geometry), beyond(unseen))

    def refined(self, prior: Prior) -> F64:
        """Residuals [held-out projection] of the volume after refinement with total variation.

        PnP-DCT steps follow only if this residual is below that of total variation alone, because they take four times
        as long. Otherwise the result would not be better than PnP-DCT without a fit either.
        """
        residuals = self._by(prior, 0.0)
        if prior.patches and residuals.mean() < self.trial.smooth_residuals.mean():
            return self._by(prior, prior.strength)
        return residuals

    def _by(self, prior: Prior, strength: float) -> F64:
        def make(problem: VoxelProblem, x: F32) -> F32:
            remaining = problem if self.beyond is None else replace(problem, data=problem.data - self.beyond)
            return refine(remaining, x, TvWeight(prior.weight), strength, FINISH_SWEEPS)

        level = None if self.beyond_unseen is None else level_of(self.beyond_unseen)
        return self.trial.residuals(self.trial.volume_by(make, self.start), level)

    @property
    def level_beyond(self) -> float:
        """Root mean square, in the held-out projections, of the contribution from outside the box."""
        if self.beyond_unseen is None:
            return 0.0
        return math.sqrt(np.mean(np.square(self.beyond_unseen, dtype=np.float64)))
