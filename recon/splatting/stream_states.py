"""States of a fit during a scan: before it has a model, with a model that grows, and in its final fit.

`Waiting` becomes `Growing` when there are enough projections. `Growing` becomes `Waiting` again if very different line
integrals replace the line integrals with which its Gaussians were placed. `Finishing` is the final fit of a `Growing`
model.

A function of a state returns the next state and does not change the state itself, except the model `Growing.state`.
Functions change the model in place, because copying the model takes as long as a step. So use only the newest `Growing`
of a fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.method import Progress
from recon.base.volume import Grid, Volume
from recon.splatting import optimise as fit
from recon.splatting.anytime import (
    HALF,
    BetterVolume,
    PredictionErrors,
    average,
    averaged,
    covered_angle,
    fallen,
    next_view,
    shift_with_axis,
)
from recon.splatting.problem import FitProblem, extend, with_projections
from recon.splatting.settings import FitSettings, growth
from recon.splatting.stream_placement import Arrivals, Placement, StreamPlan, place_gaussians

_GROWTH = 1.5  # a new round begins when the number of projections has grown by this factor
_YOUNG = 16  # a round that begins with fewer projections, after HALF steps, places all Gaussians again
_LAST_GROWTH = 0.5  # density control ends when this share of the final fit is done
_AXIS_ANEW = 0.3  # px; if the axis moves by this much, the rates start again; a smaller move raises them in part
_OTHERS = 0.2  # if replaced projections change by more than this share of their norm, the Gaussians are placed again
# Without it: -0.4 to -13.5 dB on three scenes (texture, plates, points) in which the first 3 to 16 of 48 projections
# are empty.
_BLIND = 100.0  # if the data exceed by this factor what the density unit implies, the first projections were empty
# share of the first number of Gaussians that a round may add; the final fit may add the rest of the growth
_ROUND_GROWTH = 0.25


@dataclass(frozen=True, eq=False)
class Waiting:
    """A fit during a scan that has no model yet: there are too few projections, or they show no material.

    Attributes:
        views: the projections so far.
        images: line integrals [row, col] of each; NaN: no data.
        rng: random generator of the placement and the steps.
        round_views: number of projections at the last attempt to place Gaussians; 0: there was none.
    """

    views: Arrivals
    images: tuple[F32, ...]
    rng: np.random.Generator
    round_views: int = 0
    unseen: ClassVar[tuple[int, ...]] = ()

    def followed_by(self, images: F32, angles: F64) -> Waiting:
        """The state with new projections [view, row, col]."""
        return replace(self, views=self.views.followed_by(angles), images=(*self.images, *images))

    def with_newest(self, image: F32) -> Waiting:
        """With other line integrals [row, col] of the newest projection."""
        return replace(self, images=(*self.images[:-1], image))

    def with_images(self, images: F32, indices: NDArray[np.intp] | None) -> Waiting:
        """With other line integrals [view, row, col] of projections `indices`; None: of all."""
        views = self.views if indices is None else self.views.only(indices)
        return Waiting(views, tuple(images), self.rng)

    def cleared(self) -> Waiting:
        """The state without projections."""
        return Waiting(Arrivals(self.views.template), (), self.rng)

    def about(self, axis_col: float) -> Waiting:
        """The state with the rotation axis at another column."""
        return replace(self, views=self.views.about(axis_col))

    def next_round(self, plan: StreamPlan) -> Waiting | Growing:
        """Place the first Gaussians if the number of projections has grown by half since the last attempt, and they
        cover enough angles.

        If the projections show no material, the fit waits until their number has grown by half again.
        """
        angles = self.views.angles
        early = self.views.n < _GROWTH * self.round_views or angles.size < plan.first_views
        if early or covered_angle(angles) < plan.first_span:
            return self
        try:
            first = place_gaussians(self.views, self.images, plan, self.rng, all_views=False)
        except ValueError:  # these projections show no material
            return replace(self, round_views=self.views.n)
        return Growing.of(self.views, first)._with_room(plan, final=False)

    def completed(self, plan: StreamPlan) -> Growing:
        """The model for the final fit, placed with all projections.

        Raises:
            ValueError: the projections show no material.
        """
        first = place_gaussians(self.views, self.images, plan, self.rng, all_views=True)
        return Growing.of(self.views, first)._with_room(plan, final=True)

    def newest(self, settings: FitSettings) -> NoReturn:
        """Raise ValueError: no model can be compared with the newest projection."""
        raise ValueError("there is no model yet to compare with the newest projection")

    def volume(self, grid: Grid, settings: FitSettings) -> Volume:
        """A volume of zeros."""
        return Volume(np.zeros(grid.shape, np.float32), grid)

    def preview(self, plan: StreamPlan) -> BetterVolume:
        """A volume of zeros; it is not compared with FBP."""
        return BetterVolume(self.volume(plan.grid, plan.settings), False, PredictionErrors())

    def progress(self, seconds: float) -> Progress:
        """No step was made in these seconds."""
        return Progress(0, 0, seconds, math.nan, math.nan, 0, self.views.n)


@dataclass(frozen=True, eq=False)
class Growing:
    """A fit during a scan that has a model.

    Attributes:
        views: the projections so far.
        problem: their line integrals as the steps use them, with the geometry of `views`.
        state: the model. The steps, a new round and a move of the axis change it in place.
        placed: number of Gaussians at the last placement.
        schedule_step: the step from which the decay of the learning rates is counted.
        round_views: number of projections at the beginning of this round.
        unseen: projections that no step has used, in the order of arrival.
    """

    views: Arrivals
    problem: FitProblem
    state: fit.FitState
    placed: int
    schedule_step: int = 0
    round_views: int = 0
    unseen: tuple[int, ...] = ()

    @classmethod
    def of(cls, views: Arrivals, first: Placement) -> Growing:
        """A model before its first step and its first round."""
        return cls(views, first.problem, first.state, first.state.n)

    def followed_by(self, images: F32, angles: F64) -> Growing:
        """The state with new projections [view, row, col]. A projection is used in the first step after its arrival.

        Raises:
            ValueError: a projection has no usable value.
        """
        problem, views = extend(self.problem, images, angles), self.views.followed_by(angles)
        new = tuple(view for view in range(self.views.n, views.n) if not views.held_out[view])
        return replace(self, problem=problem, views=views, unseen=self.unseen + new)

    def with_newest(self, image: F32) -> Growing:
        """With other line integrals [row, col] of the newest projection.

        Raises:
            ValueError: it has no usable value.
        """
        problem, angles = self.problem, self.views.angles
        others = replace(
            problem, geometry=self.views.template.at(angles[:-1]), images=problem.images[:-1],
            target_maps=problem.target_maps[:-1], weights=problem.weights[:-1],
        )  # fmt: skip
        return replace(self, problem=extend(others, image[None], angles[-1:]))

    def with_images(self, images: F32, indices: NDArray[np.intp] | None) -> Growing | Waiting:
        """With other line integrals [view, row, col] of projections `indices`; None: of all.

        If the line integrals differ by more than a fifth from those with which the Gaussians were placed, the model is
        dropped. If some projections are dropped, the learning rates start again, because the model was fitted to bad
        projections.

        Raises:
            ValueError: a projection has no usable value.
        """
        which = np.arange(self.views.n) if indices is None else indices
        views = self.views.only(which)
        if self._others(images, which):
            return Waiting(views, tuple(images), self.state.rng)
        problem = with_projections(replace(self.problem, geometry=views.geometry), images)
        if indices is None:
            return replace(self, problem=problem)
        self.state.drawn, self.state.mean = [], None
        return replace(
            self, views=views, problem=problem, unseen=(), schedule_step=self.state.step,
            round_views=min(self.round_views, views.n),
        )  # fmt: skip

    def cleared(self) -> Waiting:
        """The state without projections and without a model, so that their memory is free."""
        return Waiting(Arrivals(self.views.template), (), self.state.rng)

    def _others(self, images: F32, which: NDArray[np.intp]) -> bool:
        """Whether these line integrals differ from the projections `which` by more than a fifth (norm)."""
        changed = total = 0.0
        for view, image in zip(which, images, strict=True):
            old_image = self.problem.backend.numpy(self.problem.images[view]) * self.problem.scale
            changed += float(np.nansum(np.square(image - old_image, dtype=np.float64)))
            total += float(np.nansum(np.square(image, dtype=np.float64)))
        return changed > _OTHERS**2 * total

    def about(self, axis_col: float) -> Growing:
        """The state with the rotation axis at another column. The model moves with the axis, so that it stays in
        agreement with the projections.

        After the move the model has double edges. The learning rates rise again, so that the fit can remove them.
        """
        template, state = self.views.template, self.state
        axis_shift = axis_col - template.axis_col
        shift = shift_with_axis(self.views.angles, axis_shift * template.sample_pitch)
        for parameters in (state.parameters, state.mean):
            if parameters is not None:
                parameters["means"][:, :2] -= shift
        remaining = 1 - min(1.0, abs(axis_shift) / _AXIS_ANEW)
        return replace(
            self,
            views=self.views.about(axis_col),
            problem=replace(self.problem, geometry=replace(self.problem.geometry, axis_col=axis_col)),
            schedule_step=state.step - round(remaining * (state.step - self.schedule_step)),
        )

    def next_round(self, plan: StreamPlan) -> Growing:
        """Begin a round if the number of projections has grown by half. A round allows more Gaussians, and its steps
        draw from all projections. After many steps with few projections, all Gaussians are placed again.
        """
        if self.views.n < _GROWTH * self.round_views:
            return self
        is_early = self.views.n < _YOUNG and self.state.step >= HALF
        return self._placed_again(plan, is_early=is_early, final=False)._with_room(plan, final=False)

    def completed(self, plan: StreamPlan) -> Growing:
        """The model for the final fit. It may have all Gaussians, and starts from the running mean of the parameters,
        which is better than the latest parameters."""
        model = self._placed_again(plan, is_early=False, final=True)._with_room(plan, final=True)
        if model.state.mean is not None:
            model.state.parameters = {name: values + 0 for name, values in model.state.mean.items()}
        return replace(model, unseen=())

    def _placed_again(self, plan: StreamPlan, is_early: bool, final: bool) -> Growing:
        """The model with all Gaussians placed again, if `is_early` (many steps with few projections) or if the
        first projections were empty; otherwise the same model."""
        # Either the sample or the beam came later, so that the density unit was computed from noise; or there were too
        # few projections.
        problem = self.problem
        blind = max(float(image.max()) for image in problem.images) > _BLIND
        if not (blind or is_early):
            return self
        views = zip(problem.projections, problem.weights, strict=True)
        images = [view if w is None else np.where(w == 0, np.float32(np.nan), view) for view, w in views]
        known = None if blind else Placement(problem, self.state)
        placement = place_gaussians(self.views, images, plan, self.state.rng, all_views=final, known=known)
        return Growing.of(self.views, placement)

    def _with_room(self, plan: StreamPlan, final: bool) -> Growing:
        """The model, allowed to have more Gaussians. The steps draw from all projections that have arrived.

        Early projections span a narrow angle and would use all Gaussians for streaks. So a round adds only a part of
        the Gaussians.
        """
        most_gaussians = round(self.placed * growth(plan.settings))
        self.state.limit = (
            most_gaussians if final else min(most_gaussians, self.state.n + round(_ROUND_GROWTH * self.placed))
        )
        self.state.drawn = []
        return replace(self, round_views=self.views.n)

    def stepped(self, settings: FitSettings) -> Growing:
        """The state after one more step. The step uses a projection that no step has used, if there is one."""
        state = self.state
        if len(state.drawn) < settings.views_per_step:
            shuffled = state.rng.permutation(self.views.n)
            state.drawn = shuffled[~self.views.held_out[shuffled]].tolist()
        view = self.unseen[0] if self.unseen else next_view(self.views.n, state.rng)
        if view is not None and self.views.held_out[view]:
            view = None
        fit.step(state, self.problem, settings, self.fraction(settings), view)
        average(state, self.schedule_step)
        return replace(self, unseen=self.unseen[1:]) if self.unseen else self

    def fraction(self, settings: FitSettings) -> float:
        """Position of the learning rates in their decay, 0 to 1."""
        return fallen(self.state.step - self.schedule_step, settings)

    def newest(self, settings: FitSettings) -> tuple[F32, F32]:
        """The newest projection as measured, and as computed from the model: line integrals [row, col]. In pixels
        without data both are equal."""
        problem = self.problem
        (image,) = fit.renders(averaged(self.state), problem, settings, [self.views.n - 1])
        measured, weight = problem.images[-1] * problem.scale, problem.weights[-1]
        rendered: F32 = problem.backend.numpy(image) * problem.scale
        return measured, rendered if weight is None else np.where(weight == 0, measured, rendered)

    def volume(self, grid: Grid, settings: FitSettings) -> Volume:
        """The volume of the model in 1/mm."""
        return fit.volume_of(averaged(self.state), grid, self.views.template, settings)

    def preview(self, plan: StreamPlan) -> BetterVolume:
        """The volume that predicts held-out projections better: the model, or FBP of the projections so far."""
        held_out = np.flatnonzero(self.views.held_out).tolist()
        return BetterVolume.of(averaged(self.state), self.problem, plan.settings, plan.grid, held_out)

    def progress(self, seconds: float) -> Progress:
        """The progress: the steps made so far, and the seconds since the beginning of the fit."""
        state = self.state
        return Progress(state.step, 0, seconds, state.loss, state.residual, state.n, self.views.n)


@dataclass(frozen=True, eq=False)
class Finishing:
    """The final fit of a model: the learning rates decay to their end.

    Attributes:
        model: the model, `completed`.
        steps: number of steps of the final fit, unless a time limit ends it.
        begun: number of steps before the final fit.
        first: position of the learning rates in their decay when the final fit begins, 0 to 1.
        settings: settings of the first half of the steps, with density control.
        settled: settings of the second half, without it.
    """

    model: Growing
    steps: int
    begun: int
    first: float
    settings: FitSettings
    settled: FitSettings

    @classmethod
    def of(cls, model: Growing, steps: int, settings: FitSettings) -> Finishing:
        """The final fit of a model, before its first step."""
        settled = replace(settings, policy=None)
        return cls(model, steps, model.state.step, model.fraction(settings), settings, settled)

    @property
    def share(self) -> float:
        """Share of the final fit's steps that are done."""
        return (self.model.state.step - self.begun) / self.steps

    def step(self, share: float) -> None:
        """Make one step. `share` is the share of the final fit that is done, measured by steps or by time."""
        state, settings = self.model.state, self.settings if share < _LAST_GROWTH else self.settled
        fit.step(state, self.model.problem, settings, self.first + (1 - self.first) * share)
        average(state, self.begun)
