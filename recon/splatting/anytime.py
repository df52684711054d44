"""Anytime: rates and mean of a fit with an unknown number of steps.

The rates fall as 1 / (1 + t / 60) with the steps t, and the model is the mean of the parameters over the last quarter
of them. A step uses one or two views, so at a high rate the parameters wander about the optimum of all views. Their
mean does not (Polyak & Juditsky 1992). After any number of steps the mean is about as good as a fit whose rates
were planned to end there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.views import spread_views
from recon.base.volume import Grid, Volume
from recon.splatting.optimise import FitState, renders, settle, volume_of
from recon.splatting.problem import FitProblem
from recon.splatting.settings import DensityPolicy, FitSettings
from recon.voxels.fbp import fbp
from recon.voxels.field_edges import busiest_rows
from recon.voxels.projector import Projector

HALF = 60.0  # steps after which the rates are half of the first ones
_WINDOW = 0.25  # share of the steps over which the mean is taken
_EVERY = 4  # steps between two terms of the mean

WHILE_VIEWS_COME = FitSettings(decay=0.02, policy=DensityPolicy(start=0.0, stop=2.0))
"""The rates of a fit to all views, with a lower end; density control in every round, within the round's limit."""


def while_views_come(settings: FitSettings) -> FitSettings:
    """The same settings with the caller's where these differ from the defaults."""
    usual = FitSettings()
    chosen = {
        f.name: value for f in fields(FitSettings) if (value := getattr(settings, f.name)) != getattr(usual, f.name)
    }
    if isinstance(policy := chosen.get("policy"), DensityPolicy):  # the number of steps to come is not known
        chosen["policy"] = replace(policy, start=0.0, stop=2.0)
    return replace(WHILE_VIEWS_COME, **chosen)


def fallen(steps: int, settings: FitSettings) -> float:
    """Fraction, 0..1, of the logarithmic decay of the rates that is done after `steps` steps.

    Rates that are lower from the start fall as much later.
    """
    half = HALF * WHILE_VIEWS_COME.pace / settings.pace
    return min(1.0, math.log1p(steps / half) / max(-math.log(settings.decay), 1e-9))


def average(state: FitState, since: int) -> None:
    """Include the parameters in their running mean, at every fourth step; the first ones start it.

    Args:
        since: the step that the last quarter is counted from.
    """
    if state.step % _EVERY:
        return
    settle(state)
    if state.mean is None:
        state.mean = {name: values + 0 for name, values in state.parameters.items()}
        return
    share = _EVERY / (_EVERY + _WINDOW * (state.step - since))
    for name, values in state.parameters.items():
        state.mean[name] += share * (values - state.mean[name])


def averaged(state: FitState) -> FitState:
    """The state with its parameters replaced by their running mean, if it has one; nothing is copied."""
    return state if state.mean is None else replace(state, parameters=state.mean)


_NEWEST = 0.2  # this share of the views counts as the newest
_ONE_IN = 16  # of so many views one is held out until the last round


def checked_views(data: ArrayLike, angles: NDArray[np.float64], detector_shape: tuple[int, int]) -> F32:
    """A copy of new line integrals [view, row, col] as float32.

    Raises:
        ValueError: shapes that disagree, or values or angles [view] that are not finite.
    """
    expected = (angles.size, *detector_shape)
    if angles.ndim != 1 or np.shape(data) != expected:
        raise ValueError(f"{angles.size} angles need projections of shape {expected}, got {np.shape(data)}")
    with np.errstate(over="ignore"):  # what float32 cannot hold counts as not finite
        images = np.array(data, np.float32)
    if not (np.isfinite(images).all() and np.isfinite(angles).all()):
        raise ValueError("new views hold values or angles that are not finite; nothing was changed")
    return images


def next_view(n_views: int, rng: np.random.Generator) -> int | None:
    """The view of the next step: one of the newest in every third step, else any in turn (None).

    New views must be learnt and old ones not forgotten (the rule of on-the-fly mapping; Meuleman et al. 2025).
    """
    newest = max(1, int(n_views * _NEWEST))
    if newest >= n_views or rng.random() >= 1 / 3:
        return None
    return int(rng.integers(n_views - newest, n_views))


def is_held_out(view: int) -> bool:
    """Whether the view of this number is held out until the last round, to assess the volumes so far."""
    return view % _ONE_IN == _ONE_IN // 2


def covered_angle(theta: NDArray[np.float64]) -> float:
    """The angle that views cover, modulo π: π minus the widest gap."""
    ordered = np.sort(np.mod(theta, np.pi))
    return float(np.pi - np.diff(ordered, append=ordered[0] + np.pi).max())


def shift_with_axis(theta: NDArray[np.float64], moved: float) -> NDArray[np.float32]:
    """The shift (x, y) of all points that best matches a shift of the axis by `moved` in the views at `theta`.

    With an axis off by d a point appears at x cos θ + y sin θ + d. The shift (a, b) makes a cos θ + b sin θ nearest to
    d: (0, 4 d / π) for evenly spread views.
    """
    across = np.stack((np.cos(theta), np.sin(theta)), 1)
    return np.linalg.lstsq(across, np.full(theta.size, moved), rcond=None)[0].astype(np.float32)


_ROWS = 8  # that are compared
_VIEWS = 400  # of an FBP, at most; of more, some are left out evenly by angle
_COMPARED = 4  # views held out, the last ones


def volume_error(rendered: F32, measured: F32) -> float:
    """The error of a volume along the rays of views [..., col], relative to the measured: √Σ|ω||F Δ|² over it."""
    n = 2 * measured.shape[-1]
    ramp = np.arange(n // 2 + 1)

    def squared(image: F32) -> float:
        return float((np.abs(fft.rfft(image, n)) ** 2 * ramp).sum(dtype=np.float64))

    return math.sqrt(squared(rendered - measured) / max(squared(measured), 1e-30))


def direct_volume(images: Sequence[F32], geometry: Geometry, grid: Grid) -> F32:
    """FBP of at most 400 of the views [row, col], without what is below zero, float32 [z, y, x]."""
    some = spread_views(geometry.angles, _VIEWS, np.arange(len(images)))
    return np.maximum(fbp(np.stack([images[i] for i in some]), geometry.select(some), grid, "hann"), 0)


@dataclass(frozen=True)
class PredictionErrors:
    """The `volume_error` of the fit and of FBP in held-out views of a growing scan and as many others; NaN: unknown.

    A volume's error is least at the angles of views and largest in the gaps. A view held out alone shows a gap that is
    twice as wide as the others, which FBP bears worse than a fit.
    """

    fit: float = math.nan
    direct: float = math.nan

    @classmethod
    def of(
        cls, images: Sequence[F32], geometry: Geometry, held_out: Sequence[int], render: Callable[[int], F32]
    ) -> Self:
        """Errors in the last held-out views and those before them; FBP uses all views that are not held out.

        NaN where none is, or the beam is not one of FBP's slices.

        Args:
            images: [row, col] of each view of the geometry.
            render: the fit's own of a view.
        """
        if not held_out or not geometry.rows_show_slices:
            return cls()
        last = [view for each in held_out[-_COMPARED:] for view in (each - 1, each)]
        measured = np.stack([images[view] for view in last])
        rows = busiest_rows(measured, _ROWS)
        slab, learnt = geometry.rows(rows.start, rows.stop), np.setdiff1d(np.arange(len(images)), held_out)
        grid = Grid.matching(slab)
        volume = direct_volume([images[view][rows] for view in learnt], slab.select(learnt), grid)
        by_fit = np.stack([render(view)[rows] for view in last])
        by_fbp = Projector(slab.select(last), grid).forward(volume)
        return cls(volume_error(by_fit, measured[:, rows]), volume_error(by_fbp, measured[:, rows]))


@dataclass(frozen=True, eq=False)
class BetterVolume:
    """The volume of the views so far that predicts held-out views best, 1/mm. `direct`: it is FBP's, else the fit's."""

    volume: Volume
    direct: bool
    errors: PredictionErrors

    @classmethod
    def of(
        cls, state: FitState, problem: FitProblem, settings: FitSettings, grid: Grid, held_out: Sequence[int]
    ) -> Self:
        """The better volume of a problem's views; the fit in this state was not fitted to the held-out ones."""

        def render(view: int) -> F32:
            return problem.backend.numpy(next(renders(state, problem, settings, [view])))

        errors = PredictionErrors.of(problem.images, problem.geometry, held_out, render)
        if not errors.direct < errors.fit:
            return cls(volume_of(state, grid, problem.geometry, settings), False, errors)
        data = direct_volume(problem.images, problem.geometry, grid) * problem.scale
        return cls(Volume(data, grid), True, errors)
