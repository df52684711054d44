"""Anytime: learning rates and running mean of a fit whose number of steps is not known in advance.

After t steps, the rates are 1 / (1 + t / 60) times the first rates. The model is the mean of the parameters over the
last quarter of the steps. A step uses one or two projections, so at a high rate the parameters fluctuate around the
optimum for all projections. Their mean does not (Polyak & Juditsky 1992). So the fit can end after any number of steps:
the mean is then about as good as a fit that was planned for this number of steps.
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

HALF = 60.0  # number of steps after which the rates are half of the first ones
_WINDOW = 0.25  # share of the steps over which the mean is computed
_STEPS_BETWEEN_TERMS = 4  # steps between two terms of the mean

WHILE_VIEWS_COME = FitSettings(decay=0.02, policy=DensityPolicy(start=0.0, stop=2.0))
"""Settings of a fit during a scan. They differ from those of a fit to all projections by lower final rates.

Density control runs in every round, until the number of Gaussians reaches the limit of the round.
"""


def while_views_come(settings: FitSettings) -> FitSettings:
    """`WHILE_VIEWS_COME`, changed by those settings of the caller that differ from the defaults."""
    usual = FitSettings()
    chosen = {
        f.name: value for f in fields(FitSettings) if (value := getattr(settings, f.name)) != getattr(usual, f.name)
    }
    if isinstance(policy := chosen.get("policy"), DensityPolicy):  # the number of future steps is not known
        chosen["policy"] = replace(policy, start=0.0, stop=2.0)
    return replace(WHILE_VIEWS_COME, **chosen)


def fallen(steps: int, settings: FitSettings) -> float:
    """Fraction, 0 to 1, of the logarithmic decay of the rates after `steps` steps.

    If the first rates are lower by a factor, it takes longer by this factor until they have fallen to their half.
    """
    half_steps = HALF * WHILE_VIEWS_COME.pace / settings.pace
    return min(1.0, math.log1p(steps / half_steps) / max(-math.log(settings.decay), 1e-9))


def average(state: FitState, since: int) -> None:
    """Add the parameters to their running mean at every fourth step. The mean starts with the first parameters.

    Args:
        since: the step from which the last quarter is counted.
    """
    if state.step % _STEPS_BETWEEN_TERMS:
        return
    settle(state)
    if state.mean is None:
        state.mean = {name: values + 0 for name, values in state.parameters.items()}
        return
    share = _STEPS_BETWEEN_TERMS / (_STEPS_BETWEEN_TERMS + _WINDOW * (state.step - since))
    for name, values in state.parameters.items():
        state.mean[name] += share * (values - state.mean[name])


def averaged(state: FitState) -> FitState:
    """The state with its parameters replaced by their running mean, if the state has one. No array is copied."""
    return state if state.mean is None else replace(state, parameters=state.mean)


_NEWEST = 0.2  # share of the projections that count as the newest
_ONE_IN = 16  # one in this many projections is held out until the final fit


def checked_views(data: ArrayLike, angles: NDArray[np.float64], detector_shape: tuple[int, int]) -> F32:
    """A copy of new line integrals [view, row, col] as float32; NaN marks pixels without data.

    Raises:
        ValueError: the shapes do not match, values are infinite, a projection is all NaN, or an angle is not finite.
    """
    expected = (angles.size, *detector_shape)
    if angles.ndim != 1 or np.shape(data) != expected:
        raise ValueError(f"{angles.size} angles need projections of shape {expected}, got {np.shape(data)}")
    with np.errstate(over="ignore"):  # values too large for float32 count as not finite
        images = np.array(data, np.float32)
    if np.isinf(images).any() or np.isnan(images).all(axis=(1, 2)).any() or not np.isfinite(angles).all():
        raise ValueError(
            "the new projections were not added: they contain infinite values, or nothing but NaN, or an angle is "
            "not finite"
        )
    return images


def next_view(n_views: int, rng: np.random.Generator) -> int | None:
    """The projection for the next step. In every third step it is one of the newest; otherwise None, so that all
    projections take turns.

    The fit must learn new projections without forgetting old ones (the rule of on-the-fly mapping; Meuleman et al.
    2025).
    """
    newest = max(1, int(n_views * _NEWEST))
    if newest >= n_views or rng.random() >= 1 / 3:
        return None
    return int(rng.integers(n_views - newest, n_views))


def is_held_out(view: int) -> bool:
    """Whether the projection with this number is held out until the final fit. Held-out projections measure the quality
    of the volumes before the final fit."""
    return view % _ONE_IN == _ONE_IN // 2


def covered_angle(theta: NDArray[np.float64]) -> float:
    """The angle in radians that projections cover, modulo π: π minus the widest gap."""
    ordered = np.sort(np.mod(theta, np.pi))
    return float(np.pi - np.diff(ordered, append=ordered[0] + np.pi).max())


def shift_with_axis(theta: NDArray[np.float64], axis_shift: float) -> NDArray[np.float32]:
    """The shift (x, y) of all points that best corresponds to a shift of the axis by `axis_shift`, for the angles
    `theta`.

    If the axis is wrong by d, a point appears at x cos θ + y sin θ + d. The shift (a, b) makes a cos θ + b sin θ as
    near to d as possible. For evenly spread projections, it is (0, 4 d / π).
    """
    directions = np.stack((np.cos(theta), np.sin(theta)), 1)
    return np.linalg.lstsq(directions, np.full(theta.size, axis_shift), rcond=None)[0].astype(np.float32)


_ROWS = 8  # number of rows that are compared
_VIEWS = 400  # largest number of projections of an FBP; if there are more, an evenly spread part of them is used
_COMPARED_VIEWS = 4  # number of held-out projections that are compared (the latest ones)


def volume_error(rendered: F32, measured: F32) -> float:
    """The relative error of a volume in projections [..., col]: √Σ|ω||F Δ|² for the residual Δ, divided by the same
    norm of the measured projections."""
    n = 2 * measured.shape[-1]
    ramp = np.arange(n // 2 + 1)

    def squared(image: F32) -> float:
        return float((np.abs(fft.rfft(image, n)) ** 2 * ramp).sum(dtype=np.float64))

    return math.sqrt(squared(rendered - measured) / max(squared(measured), 1e-30))


def direct_volume(images: Sequence[F32], geometry: Geometry, grid: Grid) -> F32:
    """FBP of at most 400 of the projections [row, col], with negative values set to zero, float32 [z, y, x]."""
    view_numbers = spread_views(geometry.angles, _VIEWS, np.arange(len(images)))
    return np.maximum(fbp(np.stack([images[i] for i in view_numbers]), geometry.select(view_numbers), grid, "hann"), 0)


@dataclass(frozen=True)
class PredictionErrors:
    """The `volume_error` of the fit and of FBP during a scan, in the held-out projections and in the same number of
    other projections.

    An unknown error is NaN. The error of a volume is smallest at the angles of the projections and largest in the gaps
    between them. A held-out projection leaves a gap that is twice as wide as the others. This gap lowers the quality of
    FBP more than that of a fit.
    """

    fit: float = math.nan
    direct: float = math.nan

    @classmethod
    def of(
        cls, images: Sequence[F32], geometry: Geometry, held_out: Sequence[int], render: Callable[[int], F32]
    ) -> Self:
        """Errors in the last held-out projections and in the projections before them. FBP uses all projections that are
        not held out.

        NaN if none is held out, or if a detector row does not show one slice (FBP is then not compared).

        Args:
            images: [row, col] for each projection of the geometry.
            render: function that returns the fit's projection with a given number.
        """
        if not held_out or not geometry.rows_show_slices:
            return cls()
        last = [view for each in held_out[-_COMPARED_VIEWS:] for view in (each - 1, each)]
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
    """The current volume, in 1/mm, that predicts held-out projections best. `direct`: True if FBP made it, False if the
    fit made it."""

    volume: Volume
    direct: bool
    errors: PredictionErrors

    @classmethod
    def of(
        cls, state: FitState, problem: FitProblem, settings: FitSettings, grid: Grid, held_out: Sequence[int]
    ) -> Self:
        """The better of two volumes for a problem: that of the fit, or FBP. The fit in this state did not use the
        held-out projections."""

        def render(view: int) -> F32:
            return problem.backend.numpy(next(renders(state, problem, settings, [view])))

        errors = PredictionErrors.of(problem.images, problem.geometry, held_out, render)
        if not errors.direct < errors.fit:
            return cls(volume_of(state, grid, problem.geometry, settings), False, errors)
        data = direct_volume(problem.images, problem.geometry, grid) * problem.scale
        return cls(Volume(data, grid), True, errors)
