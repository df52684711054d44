"""StreamingFit: a Gaussian fit that takes projections one by one during a scan.

The first Gaussians are placed with an FBP of the first projections, as soon as these are well spread. Each time the
number of projections has grown by half, a new round begins. It allows more Gaussians, and density control clones and
splits Gaussians where the new projections require it. At the first of these rounds, the Gaussians are placed once more
if there is time for many steps: with the volume of the model plus an FBP of its residual. After that the model is kept.
Between arrivals the fit continues, with learning rates that suit any
number of future steps (`anytime`). A new projection is used in the first step after its arrival. Of the other steps,
every third uses one of the newest projections, and the rest use all projections evenly (`anytime`). One in sixteen
projections is held out until the final fit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F32
from recon.base.declared_types import check_arguments
from recon.base.empirical import DEFAULT_STEPS
from recon.base.geometry import Geometry, unseen_axis
from recon.base.method import Clock, Progress
from recon.base.units import look_like_degrees, warn_of_degrees
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.anytime import WHILE_VIEWS_COME, BetterVolume, averaged, checked_views
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.stream_placement import Arrivals, StreamPlan
from recon.splatting.stream_states import Finishing, Growing, Waiting

_NEW = 0.2  # weight of the newest projection in the running mean of residuals before a projection is used


class StreamingFit:
    """An R²-Gaussian fit that takes projections one by one, as a running scan delivers them. The fit covers everything
    that the projections see, also outside the grid of the snapshots.

    Args:
        template: geometry of all future projections, with shift, roll and tilt; its angles are ignored.
        grid: grid of the snapshots; None: the grid that matches the detector.
        gaussians: number of Gaussians at the start of the fit; None: derived from the detector (see `default_count`).
        settings: settings of the fit; `joined_pixels` can only be used in a fit of a finished scan.
        first_views, first_span: the fit starts when `first_views` projections have arrived and span `first_span`
            radians (modulo π).

    Raises:
        ValueError: the number of Gaussians is 0, `joined_pixels` is set, the axis is outside the detector, or the
            projections of the template differ in shift, roll or tilt.
    """

    def __init__(
        self,
        template: Geometry,
        grid: Grid | None = None,
        seed: int = 0,
        *,
        gaussians: int | None = None,
        settings: FitSettings | None = None,
        first_views: int = 8,
        first_span: float = np.pi / 6,
        now: Clock = time.perf_counter,
    ) -> None:
        check_arguments(StreamingFit.__init__, locals())
        if sentence := unseen_axis(template.axis_col + template.offsets[:, 0], template.detector_shape[1]):
            raise ValueError(sentence)
        arrivals, grid = Arrivals(template.at([0.0])), grid or Grid.matching(template)
        self._plan = StreamPlan(settings or WHILE_VIEWS_COME, grid, gaussians, first_views, first_span)
        self._stage: Waiting | Growing = Waiting(arrivals, (), np.random.default_rng(seed))
        self._now, self._start = now, now()
        self.unlearnt = math.nan
        """Running mean of ||rendered - measured|| / ||measured|| for new projections, computed before a step uses
        them."""
        self.step_seconds = 0.0
        """Duration of a step in s, measured in the last `advance`."""

    @property
    def n_views(self) -> int:
        return self._stage.views.n

    @property
    def n_unlearnt(self) -> int:
        """Number of projections that no step has used yet."""
        return len(self._stage.unseen)

    @property
    def settings(self) -> FitSettings:
        return self._plan.settings

    @property
    def started(self) -> bool:
        """True if the fit has a model. The fit has no model until enough projections have arrived, see `first_views`
        and `first_span`."""
        return isinstance(self._stage, Growing)

    def add_views(self, data: F32, angles: ArrayLike) -> None:
        """Add line integrals [k, row, col] at angles [k] in radians. The fit uses the new projections from the next
        step on.

        Pixels without data are NaN and get weight 0.

        Raises:
            ValueError: the shapes do not match the template, values are infinite, or a projection contains only NaN or
                values that are far too large. Nothing is added.

        Warns:
            UserWarning: the angles so far look like degrees (at most one warning in a fit).
        """
        check_arguments(StreamingFit.add_views, locals())
        theta, views_before = np.atleast_1d(np.asarray(angles, np.float64)), self._stage.views
        images = checked_views(data, theta, views_before.template.detector_shape)
        self._stage = self._stage.followed_by(images, theta)
        if not look_like_degrees(views_before.angles, ended=False):  # otherwise this warning was given before
            warn_of_degrees(self._stage.views.angles, ended=False)
        if isinstance(self._stage, Growing) and theta.size:
            self.unlearnt = _running_mean(self.unlearnt, *self._stage.newest(self.settings))

    def newest_view(self) -> tuple[F32, F32]:
        """Two arrays of line integrals [row, col]: the newest projection as it was measured, and the same projection
        computed from the model. In pixels without data, both arrays contain the same value.

        Raises:
            ValueError: there is no model yet.
        """
        return self._stage.newest(self.settings)

    def replace_views(self, data: F32, kept: ArrayLike | None = None) -> None:
        """Replace the line integrals [view, row, col] of all projections so far, in order, after a changed correction.

        The fit keeps its model, unless the new data differ by more than a fifth (norm) from the data with which the
        Gaussians were placed. If the data differ by more, the Gaussians are placed again.

        Args:
            kept: numbers, in order, of the projections that the fit keeps; `data` then contains only these projections.
                The fit drops all other projections. The learning rates then start again from their first values,
                because the model was fitted to the dropped projections, too. None: the fit keeps all projections.

        Raises:
            ValueError: as for `add_views`, or there are no projections; nothing is changed.
        """
        which = None if kept is None else np.asarray(kept, np.intp)
        views = self._stage.views if which is None else self._stage.views.only(which)
        if views.n == 0:
            raise ValueError(
                "the fit would have no projection: add projections first, and keep at least one projection"
            )
        images = checked_views(data, views.angles, views.template.detector_shape)
        self._stage = self._stage.with_images(images, which)

    def replace_newest(self, data: F32) -> None:
        """Replace the line integrals [row, col] of the newest projection, after a changed correction.

        Raises:
            ValueError: the projection does not fit (see `add_views`), or the model has no projection yet. The model
                is unchanged.
        """
        views = self._stage.views
        if not views.n:
            raise ValueError("there is no projection to replace")
        (image,) = checked_views(np.asarray(data)[None], views.angles[-1:], views.template.detector_shape)
        self._stage = self._stage.with_newest(image)

    def move_axis(self, axis_col: float) -> None:
        """Move the rotation axis. The model moves with the axis, so that it stays in agreement with the projections.

        After the move the model has double edges. The learning rates rise again, so that the fit can remove the double
        edges.
        """
        self._stage = self._stage.about(float(axis_col))

    def clear(self) -> None:
        """Drop all projections and the model, so that their memory is free."""
        self._stage = self._stage.cleared()

    def advance(self, seconds: float) -> Progress:
        """Fit for about `seconds` s (at least one step if there is a model), and return the progress."""
        begin = self._now()
        self._stage = self._stage.next_round(self._plan)
        steps = 0
        while isinstance(self._stage, Growing):
            self._stage = self._stage.stepped(self.settings)
            steps += 1
            if (spent := self._now() - begin) >= seconds:
                self.step_seconds = spent / steps
                break
        return self.progress()

    @property
    def last_steps(self) -> int:
        """Number of steps of the final fit. The steps during the scan and the final steps together are as many as in a
        fit of the finished scan.

        The final fit uses each projection at least once, and it never has more steps than a fit of the finished scan.
        If the fit was too slow during the scan, the final fit makes the missing steps.
        """
        each_view_once = math.ceil(self.n_views / self.settings.views_per_step)
        return min(DEFAULT_STEPS, max(each_view_once, DEFAULT_STEPS - self.progress().step))

    def finish(self, seconds: float = math.inf, on_progress: Callable[[Progress], bool] | None = None) -> Progress:
        """Make the final fit to all projections after the scan. The final fit has `last_steps` steps; a time limit of
        about `seconds` s may end it earlier.

        The learning rates decay until the end of the final fit. Density control continues until half of the final fit
        is done, measured by its steps or by its time limit. `on_progress` is called about ten times a second; if it
        returns True, the fit ends.

        Raises:
            ValueError: no projection has arrived, or the projections show no material.
        """
        views = self._stage.views
        if not views.n:
            raise ValueError("the fit cannot finish, because no projection has arrived")
        if not look_like_degrees(views.angles, ended=False):
            warn_of_degrees(views.angles)
        self._stage = model = self._stage.completed(self._plan)
        last = Finishing.of(model, self.last_steps, self.settings)

        def reached() -> Progress:
            return replace(self.progress(), steps=last.begun + last.steps)

        _run(last, seconds, self._now, lambda: on_progress is not None and on_progress(reached()))
        return reached()

    def snapshot(self, grid: Grid | None = None) -> Volume:
        """The current volume in 1/mm on a grid (None: the grid of the fit). The volume is 0 everywhere as long as there
        is no model."""
        return self._stage.volume(grid or self._plan.grid, self.settings)

    def best_preview(self) -> BetterVolume:
        """The volume that predicts held-out projections better: the model, or FBP of the projections so far."""
        return self._stage.preview(self._plan)

    @property
    def gaussians(self) -> Gaussians | None:
        """A copy of the model; None as long as there is no model."""
        return fit.gaussians_of(averaged(self._stage.state)) if isinstance(self._stage, Growing) else None

    def progress(self) -> Progress:
        """The progress reached so far."""
        return self._stage.progress(self._now() - self._start)


def _run(last: Finishing, seconds: float, now: Clock, ends: Callable[[], bool]) -> None:
    """Make the steps of a final fit, for at most about `seconds` s. `ends` is called about ten times a second; True
    ends the steps."""
    share, begin = 0.0, now()
    reported = begin
    while share < 1:
        last.step(share)
        instant = now()
        share = max(last.share, (instant - begin) / seconds if seconds > 0 else 1.0)
        if instant - reported > 0.1:
            reported = instant
            if ends():
                break


def _running_mean(last_mean: float, measured: F32, rendered: F32) -> float:
    """The running mean of ||rendered - measured|| / ||measured|| with one more projection. `last_mean` is NaN if it is
    the first projection."""
    residual = float(np.linalg.norm(measured - rendered) / max(float(np.linalg.norm(measured)), 1e-30))
    return (1 - _NEW) * (last_mean if math.isfinite(last_mean) else residual) + _NEW * residual
