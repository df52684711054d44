"""StreamingFit: a Gaussian fit that takes projections one by one during a scan.

The first Gaussians are placed with an FBP of the first projections, as soon as these are well spread. If there is time
for many steps, the Gaussians are placed again when the number of projections has grown by half, from the volume of the
model and an FBP of its residual. After that the model is kept. Each time the number of projections has grown by half, a
new round allows more Gaussians, and density control clones and splits Gaussians according to the new projections.
Between arrivals the fit continues, with learning rates that suit any number of future steps (`anytime`). A new
projection is used in the first step after its arrival. Of the other steps, every third uses one of the newest
projections, and the rest use all projections evenly (`anytime`). One in sixteen projections is held out until the final
fit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import F32
from recon.base.declared_types import check_arguments
from recon.base.empirical import DEFAULT_STEPS
from recon.base.geometry import Geometry, unseen_axis
from recon.base.method import Clock, Progress
from recon.base.units import look_like_degrees, warn_of_degrees
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.anytime import (
    HALF,
    WHILE_VIEWS_COME,
    BetterVolume,
    PredictionErrors,
    average,
    averaged,
    checked_views,
    covered_angle,
    fallen,
    is_held_out,
    next_view,
    shift_with_axis,
)
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import (
    default_count,
    first_volume,
    place,
    sample_gaussians,
    scale_to_data,
)
from recon.splatting.problem import FitProblem, extend, with_projections
from recon.splatting.settings import FitSettings, growth
from recon.voxels.beyond_field import sample_radius

_GROWTH = 1.5  # a new round begins when the number of projections has grown by this factor
_YOUNG = 16  # a round that begins with fewer projections, after HALF steps, places all Gaussians again
_LAST_GROWTH = 0.5  # density control ends at this share of the final fit
_AXIS_ANEW = 0.3  # px; if the axis moves by this much, the rates start again; a smaller move raises them in part
_NEW = 0.2  # weight of the newest projection in the running mean of residuals before a projection is used
_OTHERS = 0.2  # if replaced projections change by more than this share of their norm, the Gaussians are placed again
# Without it: -0.4 to -13.5 dB on three scenes (texture, plates, points) in which the first 3 to 16 of 48 projections
# are empty.
_BLIND = 100.0  # if data are larger than the density unit implies by this factor, the first projections were empty
# largest number of voxels, so that a placement takes about a second; new projections wait meanwhile
PLACED_FROM = 2**22
# share of the first number of Gaussians that a round may add; the final fit may add the rest of the growth
_ROUND_GROWTH = 0.25


class StreamingFit:
    """An R²-Gaussian fit that takes projections one by one, as a running scan delivers them.

    Args:
        template: geometry of all future projections, with shift, roll and tilt; its angles are ignored.
        grid: grid of the snapshots; None: it matches the detector. The fit itself covers everything that the
            projections see.
        gaussians: number of Gaussians at the first placement; None: derived from the detector (see `default_count`).
        settings: settings of the fit; `joined_pixels` can only be used in a fit of a finished scan.
        first_views, first_span: the fit starts with this number of projections, if they span this many radians (modulo
            π).

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
        self._template, self._grid = template.at([0.0]), grid or Grid.matching(template)
        self._rng = np.random.default_rng(seed)
        if gaussians is not None and gaussians < 1:
            raise ValueError(f"a fit needs at least one Gaussian, got {gaussians}")
        self._count = gaussians
        self._settings = settings or WHILE_VIEWS_COME
        if (self._settings.joined_pixels or 1) > 1:
            raise ValueError(
                f"joined_pixels={self._settings.joined_pixels} works only in a fit of a finished scan. For a fit "
                "during a scan, leave it out and bin the scan"
            )
        self._first_views, self._first_span = first_views, first_span
        self._now, self._start = now, now()
        self._data: list[F32] = []
        self._angles: list[float] = []
        self._held_out: list[bool] = []  # for each projection; the value stays if earlier projections are dropped
        self._unseen: list[int] = []  # projections that no step has used, in the order of arrival
        self._problem: FitProblem | None = None
        self._state: fit.FitState | None = None
        self._arrived, self._round_views, self._schedule_step, self._placed = 0, 0, 0, 0
        self.unlearnt = math.nan
        """Running mean of ||rendered - measured|| / ||measured|| of new projections before a step uses them."""
        self.step_seconds = 0.0
        """Duration of a step in s, measured in the last `advance`."""

    @property
    def n_views(self) -> int:
        return len(self._angles)

    @property
    def n_unlearnt(self) -> int:
        """Number of projections that no step has used yet."""
        return len(self._unseen)

    @property
    def settings(self) -> FitSettings:
        return self._settings

    @property
    def started(self) -> bool:
        """Whether there is a model; False as long as there are too few projections."""
        return self._state is not None

    def add_views(self, data: F32, angles: ArrayLike) -> None:
        """Add line integrals [k, row, col] at angles [k] in radians; they are used from the next step on.

        Pixels without data are NaN and get weight 0.

        Raises:
            ValueError: the shapes do not match the template, values are infinite, or a projection contains only NaN or
                values that are far too large. Nothing is added.

        Warns:
            UserWarning: the angles so far look like degrees (given once).
        """
        check_arguments(StreamingFit.add_views, locals())
        theta = np.atleast_1d(np.asarray(angles, np.float64))
        images = checked_views(data, theta, self._template.detector_shape)
        if self._problem is None:
            self._data.extend(images)
        else:
            self._problem = extend(self._problem, images, theta)
        self._held_out += [is_held_out(self._arrived + k) for k in range(theta.size)]
        self._arrived += theta.size
        self._angles.extend(theta.tolist())
        if not look_like_degrees(
            np.asarray(self._angles[: self.n_views - theta.size]), ended=False
        ):  # otherwise the warning was given before
            warn_of_degrees(np.asarray(self._angles), ended=False)
        if self._state is not None and theta.size:
            new = range(self.n_views - theta.size, self.n_views)
            self._unseen += [view for view in new if not self._held_out[view]]
            measured, rendered = self.newest_view()
            left = float(np.linalg.norm(measured - rendered) / max(float(np.linalg.norm(measured)), 1e-30))
            kept = self.unlearnt if math.isfinite(self.unlearnt) else left
            self.unlearnt = (1 - _NEW) * kept + _NEW * left

    def newest_view(self) -> tuple[F32, F32]:
        """The newest projection and that of the model, line integrals [row, col]; equal in pixels without data.

        Raises:
            ValueError: there is no model yet.
        """
        if self._state is None or self._problem is None:
            raise ValueError("there is no model yet to compare with the newest projection")
        problem = self._problem
        (image,) = fit.renders(averaged(self._state), problem, self._settings, [self.n_views - 1])
        measured, weight = problem.images[-1] * problem.scale, problem.weights[-1]
        rendered: F32 = problem.backend.numpy(image) * problem.scale
        return measured, rendered if weight is None else np.where(weight == 0, measured, rendered)

    def replace_views(self, data: F32, kept: ArrayLike | None = None) -> None:
        """Replace the line integrals [view, row, col] of all projections so far, in order, after a changed correction.

        The model is kept, unless the new data differ by a fifth from the data with which the Gaussians were placed. In
        that case the Gaussians are placed again. `kept` are the numbers of the projections that these data belong to,
        in order. If it is given, only these projections count from then on, and the rates start again, because the
        model has learnt from bad projections.

        Raises:
            ValueError: as for `add_views`, or there are no projections; nothing is changed.
        """
        which = np.arange(self.n_views) if kept is None else np.asarray(kept, np.intp)
        theta = np.asarray(self._angles)[which]
        if theta.size == 0:
            raise ValueError("there are no projections to replace, or none would be left")
        images = checked_views(data, theta, self._template.detector_shape)
        self._angles, self._held_out = theta.tolist(), [self._held_out[view] for view in which]
        if self._problem is None or self._state is None or self._others(images, which):
            self._data, self._problem, self._state = list(images), None, None
            self._round_views, self._unseen = 0, []
            return
        self._problem = with_projections(replace(self._problem, geometry=self._template.at(theta)), images)
        if kept is not None:
            self._round_views = min(self._round_views, self.n_views)
            self._state.drawn, self._state.mean, self._schedule_step = [], None, self._state.step
            self._unseen = []

    def _others(self, images: F32, which: NDArray[np.intp]) -> bool:
        """Whether these line integrals differ from projections `which` of the model by more than a fifth (norm)."""
        assert self._problem is not None
        changed = total = 0.0
        for view, image in zip(which, images, strict=True):
            before = self._problem.backend.numpy(self._problem.images[view]) * self._problem.scale
            changed += float(np.nansum(np.square(image - before, dtype=np.float64)))
            total += float(np.nansum(np.square(image, dtype=np.float64)))
        return changed > _OTHERS**2 * total

    def replace_newest(self, data: F32) -> None:
        """Replace the line integrals [row, col] of the newest projection, after a changed correction.

        Raises:
            ValueError: the projection does not fit (see `add_views`), or the model has no projection yet. The model
                is unchanged.
        """
        if not self._angles:
            raise ValueError("there is no projection to replace")
        theta = np.asarray(self._angles)
        images = checked_views(np.asarray(data)[None], theta[-1:], self._template.detector_shape)
        if self._problem is None:
            self._data[-1:] = images
            return
        problem = self._problem
        others = replace(
            problem, geometry=self._template.at(theta[:-1]), images=problem.images[:-1],
            target_maps=problem.target_maps[:-1], weights=problem.weights[:-1],
        )  # fmt: skip
        self._problem = extend(others, images, theta[-1:])

    def move_axis(self, axis_col: float) -> None:
        """Move the rotation axis. The model moves with it to its position in the projections.

        The remaining errors are double edges, which the model must correct, so the rates rise again.
        """
        moved = float(axis_col) - self._template.axis_col
        self._template = replace(self._template, axis_col=float(axis_col))
        if self._problem is None or self._state is None:
            return
        self._problem = replace(self._problem, geometry=replace(self._problem.geometry, axis_col=float(axis_col)))
        theta = self._problem.geometry.angles
        shift = shift_with_axis(theta, moved * self._template.sample_pitch)
        for parameters in (self._state.parameters, self._state.mean):
            if parameters is not None:
                parameters["means"][:, :2] -= shift
        kept = 1 - min(1.0, abs(moved) / _AXIS_ANEW)
        self._schedule_step = self._state.step - round(kept * (self._state.step - self._schedule_step))

    def advance(self, seconds: float) -> Progress:
        """Fit for about `seconds` s (at least one step if there is a model), and return the progress."""
        begin = self._now()
        if self.n_views >= _GROWTH * self._round_views:
            self._begin_round()
        if self._state is None or self._problem is None:
            return self.progress()
        steps = 0
        while True:
            fit.step(self._state, self._problem, self._settings, self._fraction(), self._next_view(self._state))
            average(self._state, self._schedule_step)
            steps += 1
            if (spent := self._now() - begin) >= seconds:
                self.step_seconds = spent / steps
                return self.progress()

    def _next_view(self, state: fit.FitState) -> int | None:
        """The first projection of the next step; None: any in turn (held-out ones wait for the final fit)."""
        if len(state.drawn) < self._settings.views_per_step:
            state.drawn = [view for view in self._rng.permutation(self.n_views).tolist() if not self._held_out[view]]
        view = self._unseen.pop(0) if self._unseen else next_view(self.n_views, self._rng)
        return None if view is None or self._held_out[view] else view

    @property
    def last_steps(self) -> int:
        """Number of steps of the final fit: those missing compared with a fit of all projections at once.

        It is at least one per projection, and never more than a fit of all projections has. So a fit that was slow
        during the scan catches up here.
        """
        each_view_once = math.ceil(self.n_views / self._settings.views_per_step)
        taken = 0 if self._state is None else self._state.step
        return min(DEFAULT_STEPS, max(each_view_once, DEFAULT_STEPS - taken))

    def finish(self, seconds: float = math.inf, on_progress: Callable[[Progress], bool] | None = None) -> Progress:
        """Make the final fit to all projections after the scan: `last_steps` steps, or about `seconds` s if shorter.

        The rates decay until its end. Density control continues in its first half. `on_progress` is called about ten
        times a second; if it returns True, the fit ends.

        Raises:
            ValueError: no projection has arrived, or the projections show no material.
        """
        if not self._angles:
            raise ValueError("the fit cannot finish, because no projection has arrived")
        if not look_like_degrees(np.asarray(self._angles), ended=False):
            warn_of_degrees(np.asarray(self._angles))
        self._begin_round(force=True)
        state, problem = self._state, self._problem
        assert state is not None and problem is not None
        self._unseen = []
        if state.mean is not None:  # continue from the better of the two
            state.parameters = {name: values + 0 for name, values in state.mean.items()}
        settled, first = replace(self._settings, policy=None), self._fraction()
        begun, steps, share = state.step, self.last_steps, 0.0
        begin = reported = self._now()
        while share < 1:
            settings = self._settings if share < _LAST_GROWTH else settled
            fit.step(state, problem, settings, first + (1 - first) * share)
            average(state, begun)
            now = self._now()
            share = max((state.step - begun) / steps, (now - begin) / seconds if seconds > 0 else 1.0)
            if on_progress is not None and now - reported > 0.1:
                reported = now
                if on_progress(replace(self.progress(), steps=begun + steps)):
                    break
        return replace(self.progress(), steps=begun + steps)

    def snapshot(self, grid: Grid | None = None) -> Volume:
        """The current volume in 1/mm on a grid (None: that of the fit); all zero before the first model."""
        grid = grid or self._grid
        if self._state is None:
            return Volume(np.zeros(grid.shape, np.float32), grid)
        return fit.volume_of(averaged(self._state), grid, self._template, self._settings)

    def best_preview(self) -> BetterVolume:
        """The volume that predicts held-out projections better: the model, or FBP of the projections so far."""
        if self._problem is None or self._state is None:
            return BetterVolume(self.snapshot(), False, PredictionErrors())
        apart = np.flatnonzero(self._held_out).tolist()
        return BetterVolume.of(averaged(self._state), self._problem, self._settings, self._grid, apart)

    @property
    def gaussians(self) -> Gaussians | None:
        """A copy of the model; None before the first one."""
        return None if self._state is None else fit.gaussians_of(averaged(self._state))

    def progress(self) -> Progress:
        """The progress so far."""
        seconds, state = self._now() - self._start, self._state
        if state is None:
            return Progress(0, 0, seconds, float("nan"), float("nan"), 0, self.n_views)
        return Progress(state.step, 0, seconds, state.loss, state.residual, state.n, self.n_views)

    def _fraction(self) -> float:
        assert self._state is not None
        return fallen(self._state.step - self._schedule_step, self._settings)

    def _begin_round(self, force: bool = False) -> None:
        if self._state is None:
            if not self._placed_first(force):
                return
        elif self._problem is not None:
            # Either the sample or the beam came later, so the density unit is noise; or the projections were too few.
            blind = max(float(image.max()) for image in self._problem.images) > _BLIND
            if blind or (not force and self.n_views < _YOUNG and self._state.step >= HALF):
                views = zip(self._problem.projections, self._problem.weights, strict=True)
                self._data = [view if w is None else np.where(w == 0, np.float32(np.nan), view) for view, w in views]
                self._place_first(None if blind else self._state, all_views=force)
        assert self._state is not None
        # Later projections need new Gaussians. Early ones span a narrow angle and would use all of them for streaks.
        most = round(self._placed * growth(self._settings))
        self._state.limit = most if force else min(most, self._state.n + round(_ROUND_GROWTH * self._placed))
        self._round_views = self.n_views
        self._state.drawn = []  # from now on, draw from all projections

    def _placed_first(self, force: bool) -> bool:
        """Place the first Gaussians if there are enough projections or no further ones; returns whether it did."""
        theta = np.asarray(self._angles)
        if not force and (theta.size < self._first_views or covered_angle(theta) < self._first_span):
            return False
        try:
            self._place_first(all_views=force)
        except ValueError:  # these projections show no material: wait for half as many again
            if force:
                raise
            self._round_views = self.n_views
            return False
        return True

    def _place_first(self, known: fit.FitState | None = None, *, all_views: bool) -> None:
        """Place all Gaussians with an FBP of the projections, or with a `known` volume and an FBP of its residual.

        Held-out projections are not used, unless `all_views` is True.
        """
        views = Views(np.stack(self._data), self._template.at(self._angles)).masked()
        learnt = [view for view in range(self.n_views) if all_views or not self._held_out[view]]
        geometry, seen = views.geometry.select(learnt), views.data[learnt]
        wider = sample_radius(views)
        box = self._grid if wider is None else self._grid.reaching(wider.radius, self._template)
        field = Grid.for_fit(self._template, box, wider=wider is not None)
        coarser = 2 ** max(0, math.ceil(math.log2(math.prod(field.shape) / PLACED_FROM) / 3))
        shape = (field.shape[0], *(math.ceil(n / coarser) for n in field.shape[1:]))
        rough = replace(field, shape=shape, voxel_size=coarser * field.voxel_size)
        rough = Grid.for_fit(self._template, rough, wider=wider is not None)
        count = self._count or default_count(self._template, field.voxel_size)
        kernel = self._settings.kernel
        # the first volume of a cone does not depend linearly on the data
        if known is None or self._problem is None or geometry.is_cone:
            volume = first_volume(seen, geometry, rough)
            placed = place(volume, seen, geometry, count, self._rng, kernel=kernel)
        else:
            model = averaged(known)
            rendered: F32 = np.stack(list(fit.renders(model, self._problem, self._settings, learnt)))
            left = first_volume(seen - rendered * self._problem.scale, geometry, rough)
            volume = Volume(fit.volume_of(model, rough, self._template, self._settings).data + left.data, rough)
            radius = geometry.reach if wider is None else math.inf
            placed = sample_gaussians(volume, count, self._rng, field_radius=radius, kernel=kernel)
            placed = scale_to_data(placed, seen, geometry)
        self._problem = fit.problem_of(views, field, placed.density_unit, self._settings)
        self._state, self._schedule_step = fit.init(placed, self._rng), 0
        self._placed = placed.n
        self._data, self._unseen = [], []  # from now on the problem contains them
