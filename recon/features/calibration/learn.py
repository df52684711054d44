"""learn_geometry: calibrates the geometry from the projections, coarse to fine, confirmed by held-out projections.

For the confirmation, a volume from the other projections predicts the held-out projections. This volume is made with
another method and projector than in the search: FISTA-TV with exact rays. For both geometries, each held-out projection
may first be shifted to the position at which it agrees best. Otherwise the new geometry would have an advantage,
because the position of the held-out projection was fitted to it. So only the volumes are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.base.arrays import F32, F64, bin_views
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.features.calibration.joint import TERMS, GeometryChange, JointFit, edge_motion, taller
from recon.voxels.choice import exceeds_standard_error
from recon.voxels.held_out import predicted_views
from recon.voxels.methods import EarlyTv

_ONE_IN = 4  # one in this many projections is held out
_SWEEPS, _TV_WEIGHT = 6, 3e-3
_EDGE_ROWS = 1  # number of rows at either end in which rays of tilted projections leave the reconstructed slices
_SMOOTHING_PX = 4.0  # pixels
_LEAST_IMPROVEMENT = 0.002  # a better geometry must lower the squared deviation by at least this share
_STANDARD_ERRORS = 2.0  # see `exceeds_standard_error`


@dataclass(frozen=True, eq=False)
class Judge:
    """Measures how well a geometry predicts held-out projections.

    Attributes:
        views: float32 [view, row, col], line integrals.
        grid: grid of all volumes.
        known: [row, col] weights of pixels; None: 1 for all.
        placed: True: each held-out projection is first shifted to the position at which it agrees best.
    """

    views: F32
    grid: Grid
    known: F32 | None
    placed: bool

    def deviations(self, geometry: Geometry) -> F64:
        """[held-out projection] root mean square residual for a volume from the other projections, if this geometry is
        used."""
        method, rows = EarlyTv(_SWEEPS, _TV_WEIGHT), geometry.detector_shape[0]
        weights = None if self.known is None else np.broadcast_to(self.known, self.views.shape)
        unseen, images = predicted_views(method, Views(self.views, geometry, weights), self.grid, _ONE_IN)
        known = np.ones(images.shape[1:], np.float32) if self.known is None else self.known.copy()
        edge = min(_EDGE_ROWS, (rows - 1) // 4)
        known[:edge], known[rows - edge :] = 0, 0
        return np.array(
            [self._left(view - image, image, known) for view, image in zip(self.views[unseen], images, strict=True)]
        )

    def _left(self, residual: F32, image: F32, known: F32) -> float:
        """Root mean square residual of a projection after it was shifted to the position at which it agrees best."""
        rays = _without_smooth(residual)[known > 0]
        if self.placed:
            image_slopes = [_without_smooth(np.gradient(image, axis=axis)) for axis in (0, 1) if image.shape[axis] > 1]
            slopes = np.stack([image_slope[known > 0] for image_slope in image_slopes], axis=1)
            rays = rays - slopes @ np.linalg.lstsq(slopes, rays, rcond=1e-6)[0]
        return float(np.sqrt(np.mean(rays**2)))


def _without_smooth(image: F32) -> F64:
    """Differences of pixels from their surroundings. An air level and material outside the field of view are smooth, so
    the differences do not contain them."""
    return np.asarray(image - gaussian_filter(image, _SMOOTHING_PX, mode="nearest"), np.float64)


def better(residuals: F64, reference_residuals: F64) -> bool:
    """Whether the first deviations [view] are significantly smaller than the second deviations, given their scatter."""
    share: NDArray[np.float64] = 1 - np.square(residuals) / np.maximum(np.square(reference_residuals), 1e-30)
    return bool(share.mean() > _LEAST_IMPROVEMENT) and exceeds_standard_error(share, _STANDARD_ERRORS)


COLS, ROWS = 320, 96  # this many pixels are enough to determine the geometry; more pixels would take longer
LEAST_VIEWS = 12
_LEAST_COLS = 20  # fewest columns at the coarsest level
# the axis is fitted alone first; if it is wrong by much, single projections would move instead of it
_AXIS_STEPS, _AXIS_ROUNDS = 4, 8
_STEPS = 6, 4, 3  # Gauss-Newton steps per level, from coarse to fine
_ROUNDS = 16  # conjugate-gradient iterations in each step
_LARGEST_MOVE = 2.0  # largest move in a step, in binned pixels
_LEAST_CHANGE = 0.03  # pixels of the given projections, at the image's edge; smaller changes are dropped


@dataclass(frozen=True, eq=False)
class LearntGeometry:
    """Result of a calibration: the change of the geometry, as far as held-out projections confirm it.

    Attributes:
        change: change in pixels of the projections. Terms that were not confirmed are zero.
        confirmed, dropped: names of terms.
        before, after: median deviation of the held-out projections from volumes made from the other projections, before
            and after the calibration.
    """

    change: GeometryChange
    confirmed: tuple[str, ...]
    dropped: tuple[str, ...]
    before: float
    after: float

    def in_words(self, binning: int = 1) -> str:
        """The result as a sentence, with lengths in unbinned pixels."""
        changes = ", ".join(_text(self.change, term, binning) for term in self.confirmed)
        if not (self.confirmed or self.dropped):
            return "Geometry: unchanged, because the projections show no significant error of the geometry."
        unchanged = f"{', '.join(self.dropped)}: unchanged, because held-out projections do not confirm a change."
        if not changes:
            return f"Geometry: {unchanged}"
        first = (
            f"Geometry calibrated: {changes}. The deviation of held-out projections fell from {self.before:.4g} to "
            f"{self.after:.4g}."
        )
        return f"{first} {unchanged[0].upper()}{unchanged[1:]}" if self.dropped else first

    def parameters(self, binning: int = 1) -> Mapping[str, NDArray[np.float64] | float | str]:
        """The values for the file of a volume, by name, in unbinned pixels."""
        return {
            "calibrate_confirmed": ",".join(self.confirmed) or "none",
            "calibrate_axis_change_px": self.change.axis * binning,
            "calibrate_roll_deg": math.degrees(self.change.roll),
            "calibrate_tilt_deg": math.degrees(self.change.tilt),
            "calibrate_held_out_before": self.before,
            "calibrate_held_out_after": self.after,
        }


def learn_geometry(
    projections: F32,
    geometry: Geometry,
    terms: frozenset[str],
    progress: Callable[[int, int], None] = lambda n, total: None,
    known: F32 | None = None,
) -> LearntGeometry:
    """Find the geometry in which a volume explains the projections best, as far as held-out projections confirm it.

    Args:
        projections: [view, row, col], line integrals; `COLS` columns and `ROWS` rows are enough.
        terms: those of `joint.TERMS` that may change.
        progress: function called with the steps done and the largest number of steps.
        known: [row, col] weights of pixels; None: 1 for all. Raises:
        ValueError: there are fewer than twelve projections, or they show no material.
    """
    if geometry.n_views < LEAST_VIEWS:
        raise ValueError(
            f"too few projections to calibrate the geometry: {geometry.n_views}; at least {LEAST_VIEWS} are needed"
        )
    if not projections.any():
        raise ValueError("the projections show no absorbing sample: all line integrals are 0")
    factors = _factors(*geometry.detector_shape)
    steps = _STEPS[: len(factors)]
    total, done = _AXIS_STEPS + sum(steps) + 2 + len(terms), 0

    def tick() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    learnt = geometry
    for factor, count in zip(factors, steps, strict=True):
        small, data = learnt.binned(factor), bin_views(projections, factor)
        fit = JointFit.of(data, small, frozenset({"axis"}), _weights(known, factor, data))
        fit.step(_AXIS_ROUNDS, 0.0)
        if factor == factors[0] and "axis" in terms:
            for _ in range(_AXIS_STEPS):
                fit.step(_AXIS_ROUNDS, _LARGEST_MOVE)
                tick()
        fit.terms = terms
        for _ in range(count):
            fit.step(_ROUNDS, _LARGEST_MOVE)
            tick()
        learnt = GeometryChange.between(small, fit.geometry).scaled(factor).applied(learnt)
    return _confirmed(
        projections, geometry, GeometryChange.between(geometry, learnt).of(terms), known, factors[-1], tick
    )


def _factors(rows: int, cols: int) -> list[int]:
    """Binning factors of the levels, from coarse to fine."""
    # binned pixels are fine enough to determine a shift to a hundredth of a pixel
    finest = 2 if cols >= 2 * _LEAST_COLS and rows > 1 else 1
    factors = [f for f in (8, 4, 2, 1) if f >= finest and cols // f >= _LEAST_COLS and rows // f >= 1]
    return factors[-len(_STEPS) :] or [1]


def _weights(known: F32 | None, factor: int, data: F32) -> F32 | None:
    if known is None:
        return None
    return np.ascontiguousarray(np.broadcast_to(bin_views(known[None], factor), data.shape))


def _confirmed(
    projections: F32,
    geometry: Geometry,
    change: GeometryChange,
    known: F32 | None,
    factor: int,
    tick: Callable[[], None],
) -> LearntGeometry:
    """The part of a change that held-out projections confirm: first the whole change, then each term of it."""
    binned, data = geometry.binned(factor), bin_views(projections, factor)
    edge = edge_motion(geometry)
    sizes = abs(change.axis), abs(change.roll) * edge, abs(change.tilt) * edge, float(np.abs(change.shifts).max())
    large_terms = [term for term, size in zip(TERMS, sizes, strict=True) if size > _LEAST_CHANGE]
    judge = Judge(
        data,
        taller(Grid.matching(binned)),
        None if known is None else bin_views(known[None], factor)[0],
        "shifts" in large_terms,
    )

    def judged(terms: list[str]) -> NDArray[np.float64]:
        tick()
        return judge.deviations(change.of(frozenset(terms)).scaled(1 / factor).applied(binned))

    without_change, groups = judged([]), _groups(large_terms)
    confirmed, with_confirmed = list(large_terms), judged(large_terms) if large_terms else without_change
    if not better(with_confirmed, without_change):
        confirmed, with_confirmed = [], without_change
        for group in groups if len(groups) > 1 else []:
            alone = judged(group)
            if better(alone, with_confirmed):
                confirmed, with_confirmed = group, alone
    elif len(groups) > 1:
        for group in groups:
            other_terms = [term for term in confirmed if term not in group]
            without_group = judged(other_terms)
            if not better(with_confirmed, without_group):
                confirmed, with_confirmed = other_terms, without_group
    dropped = [term for term in large_terms if term not in confirmed]
    return LearntGeometry(
        change.of(frozenset(confirmed)),
        tuple(confirmed),
        tuple(dropped),
        float(np.median(without_change)),
        float(np.median(with_confirmed)),
    )


def _groups(terms: list[str]) -> list[list[str]]:
    """Groups of terms that are confirmed together. Axis and shifts are one group, because a shift of the axis is the
    mean of the shifts."""
    position_terms = [term for term in terms if term in ("axis", "shifts")]
    return [group for group in (position_terms, *([term] for term in terms if term not in position_terms)) if group]


def _text(change: GeometryChange, term: str, binning: int) -> str:
    if term == "axis":
        return f"the axis moves by {change.axis * binning:+.2f} px"
    if term == "shifts":
        return f"projections shift by up to {np.abs(change.shifts).max() * binning:.2f} px"
    return f"{term} {math.degrees(getattr(change, term)):+.3f}°"
