"""Measures the law of the error of a volume, which tells the benefit of more projections, without ground truth.

If noise dominates the error, the square error of a volume of total variation falls as n^-0.6 with the number of
projections. If edges between voxels, fringes, motion or material outside the field dominate, it falls as n^-0.3 or more
slowly. This module measures which of the two is the case. A volume from seven eighths of the projections represents the
sample. In a copy of the scan, only noise is added to the projections of this volume (a parametric bootstrap; Efron &
Tibshirani 1993, ch. 6.5). The copy shows the share of noise in the error. Then volumes from half and from seven eighths
of the projections are judged by the held-out eighth, in the scan and in the copy. The measure is the power of their
residual, filtered by the root of the ramp, minus that of the noise of the open beam. (By the theorems of Parseval and
of the central slice, this power is the square error of the volume.) If the error falls less in the scan than in the
copy, a part of the error is not reduced by more projections.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, bin_views
from recon.base.decisions import Decisions
from recon.base.error_law import ErrorLaw
from recon.base.geometry import Geometry
from recon.base.view_data import Views, split_views
from recon.base.volume import Grid, Volume
from recon.voxels.beyond_field import offset_error, whole_reach
from recon.voxels.choice import preferred_strength
from recon.voxels.fbp import fbp
from recon.voxels.field_edges import busiest_rows, slab_of
from recon.voxels.iterative import Iterating, solve
from recon.voxels.ordered_fista import Subsets, ordered_fista, subsets_of
from recon.voxels.priors import TvWeight, tv_prox
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.residuals import unseen_residuals
from recon.voxels.resolution import at_voxel_resolution
from recon.voxels.standstill import MOST_SWEEPS
from recon.voxels.voxel_problem import VoxelProblem

LEAST_VIEWS = 40
# exponents measured on ten scans: 0.5 to 0.7 and 0.1 to 0.4 (tests/bench/next_pass.py)
_NOISE_EXPONENT, _OTHER_EXPONENT = 0.6, 0.3
# limits of noise share x ratio of falls: below the first value other errors dominate, above the second value noise
# dominates
_NOISE_PRODUCT = 0.08, 0.16
# relative uncertainty of a gain, a convention: the range is from half to one and a half times the gain
_EXPONENT_ERROR = 0.25
_GAPS_ERROR = 0.46  # the same if gaps between projections dominate; on ten scans the exponents were 0.41 to 1.15
# how the error falls with more light at the same angles, as a share of the exponent; median of 14 pairs of scans
_SAME_ANGLES = 0.8
# factor on the measured fall, because projections also show errors between voxels, which do not fall
_VOLUME_OVER_VIEWS = 2.1
_ROWS, _WORK = 8, 60 * 512**2  # rows of the slab; projections times squared columns, above which columns are binned
_TV_STEPS, _TRIAL_VIEWS = 3, 64
_LEAST_FRAMES = 3  # fewest frames of the open beam
_TINY = 1e-30
_CIRCLE = 0.95  # share of the radius of the field of view in which errors count


def measured_law(
    data: F32, geometry: Geometry, views_at_ends: Sequence[int], rng: np.random.Generator, open_beam: F32
) -> tuple[ErrorLaw, float | None]:
    """The law of the error of a volume of these projections, and the dB gained by the last pass (None: not known).

    Args:
        data: line integrals [view, row, col] in the order of acquisition; finite.
        geometry: geometry of the projections: a parallel beam without roll and tilt.
        views_at_ends: number of projections at the end of each pass so far; the last one is the number of all. If the
            last two are equal, the last pass added no projections, and its gain is not measured.
        open_beam: line integrals [frame, row, col] of successive frames of the open beam, which contain only noise,
            binned as the projections.

    Raises:
        ValueError: the beam is a cone, there are fewer than 40 projections or 3 frames of the open beam, or the
            projections show no material.
    """
    n = len(data)
    if geometry.is_cone:
        raise ValueError(
            "the law of the error (how the error falls with the number of projections) can be measured only for a "
            "parallel beam, and this scan has a cone beam"
        )
    if n < LEAST_VIEWS or len(open_beam) < _LEAST_FRAMES:
        raise ValueError(
            f"to measure how the error falls with the number of projections, at least {LEAST_VIEWS} projections and "
            f"{_LEAST_FRAMES} frames of the open beam are needed; got {n} projections and {len(open_beam)} frames"
        )
    sample = whole_reach(Views(data, geometry)).sample
    # width of the sample over that of the field of view
    width = 1.0 if sample is None else sample.radius / geometry.reach
    slab = _Slab.of(data, geometry, width, open_beam)
    fitted_views, held_out = split_views(slab.geometry)
    half_of_views = split_views(slab.geometry, 2)[1]  # every second projection by angle, without the held-out ones
    method = _TotalVariation(slab.chosen_weight())
    volumes = [slab.volume(method, slab.views, used) for used in (half_of_views, fitted_views)]
    if not volumes[1].any():
        raise ValueError(
            "the error against the number of projections was not measured, because the projections show no sample"
        )
    copy, second_copy = slab.copies(volumes[1], rng)
    copied = [slab.volume(method, copy, used) for used in (half_of_views, fitted_views)]
    errors = [slab.square_error(volume, volumes[1]) for volume in copied]
    noise = slab.square_error(copied[0], slab.volume(method, second_copy, half_of_views)) / 2 / max(errors[0], _TINY)
    fall_ratio = _fall_ratio(
        [slab.unseen_power(volume, slab.views, held_out) for volume in volumes],
        [slab.unseen_power(volume, copy, held_out) for volume in copied],
    )
    # With fewer projections than the sample has columns there are gaps. Their error falls in the same way as noise.
    gaps = n < width * geometry.detector_shape[1]
    product = 1.0 if gaps else noise * (1.0 if fall_ratio is None else fall_ratio)
    exponent = float(np.interp(product, _NOISE_PRODUCT, (_OTHER_EXPONENT, _NOISE_EXPONENT)))
    constant = offset_error(Volume(volumes[1], slab.box), slab.geometry, sample)
    offset = constant / (errors[1] + constant) if constant else 0.0
    error = (_GAPS_ERROR if gaps else _EXPONENT_ERROR) * exponent
    error_law = ErrorLaw(n, exponent, error, _SAME_ANGLES * exponent * (1 - offset), offset)
    if not fall_ratio or min(errors) <= 0 or (n, *views_at_ends)[-2] == n:
        return error_law, None
    # fall of the error in the scan, from half to seven eighths of the projections
    fall = _VOLUME_OVER_VIEWS * fall_ratio * math.log(errors[0] / errors[1])
    return error_law, fall / math.log(len(fitted_views) / len(half_of_views)) * 10 * math.log10(n / views_at_ends[-2])


def _fall_ratio(scan: Sequence[float], copy: Sequence[float]) -> float | None:
    """The fall of the error from the first volume to the second volume in the scan, divided by the fall in the copy; 0
    to 1.

    Args:
        scan, copy: `_Slab.unseen_power` of the two volumes.

    Returns:
        None if the ratio is not known, because the error of the copy does not fall.
    """
    if not copy[0] > copy[1] > 0:
        return None
    fall = math.log(max(scan[0], copy[0] / 10) / max(scan[1], copy[1] / 10))
    return min(max(fall / math.log(copy[0] / copy[1]), 0.0), 1.0)


@dataclass(frozen=True)
class _TotalVariation:
    """FISTA-TV whose weight is given for one projection.

    For n projections the weight is √n times as large, like the noise of the gradient, which is a sum over the
    projections.
    """

    weight: float
    iterations: int = MOST_SWEEPS

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        weight = TvWeight(self.weight * math.sqrt(problem.projector.geometry.n_views))
        subsets = Subsets.of(problem, subsets_of(problem.projector.geometry))
        return ordered_fista(problem, x, weight, subsets, sweeps=self.iterations, prox=tv_prox(problem, _TV_STEPS))


@dataclass(frozen=True)
class _WeightByNoise:
    """Chooses the weight of total variation from the noise of the projections, without making a volume."""

    iterations: int = MOST_SWEEPS

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        problem.decide("weight", lambda: TvWeight.of_noise(problem, x, self.iterations).first)
        return x


@dataclass(frozen=True, eq=False)
class _Slab:
    """Some rows of a scan, binned if there are many columns.

    Attributes:
        views: line integrals [view, row, col].
        noise: noise of single frames of the open beam, [frame, row, col].
        box: a box as wide as the sample.
        decisions: decisions of the volumes so far, which the next volumes repeat.
    """

    views: F32
    geometry: Geometry
    box: Grid
    noise: F32
    decisions: dict[str, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, data: F32, geometry: Geometry, width: float, open_beam: F32) -> _Slab:
        """The rows with the most material in a scan whose sample is `width` times as wide as the field of view."""
        factor = 2 ** max(0, math.ceil(math.log2(width * data.shape[2] * math.sqrt(len(data) / _WORK))))
        rows = busiest_rows(data, min(_ROWS * factor, data.shape[1]))
        views, geometry = np.ascontiguousarray(data[:, rows]), geometry.rows(rows.start, rows.stop)
        change = np.diff(open_beam, axis=0)
        change -= np.median(change, axis=(1, 2), keepdims=True)
        noise = (change / math.sqrt(2)).astype(np.float32)
        if factor > 1:
            views, noise, geometry = bin_views(views, factor), bin_views(noise, factor), geometry.binned(factor)
        geometry, box = slab_of(geometry, Grid.matching(geometry), 0, geometry.detector_shape[0])
        return cls(views, geometry, box.reaching(width * geometry.reach, geometry) if width > 1 else box, noise)

    def volume(self, method: Iterating, views: F32, used: NDArray[np.intp]) -> F32:
        """A volume [z, y, x] from the projections with the numbers `used`.

        It starts from their filtered back-projection.
        """
        geometry, images = self.geometry.select(used), np.ascontiguousarray(views[used])
        start = Volume(np.maximum(fbp(images, geometry, self.box, filter="hann"), 0), self.box)
        decide = Decisions(0, self.decisions)
        volume = solve(method, Projector(geometry, self.box), images, start=start, decide=decide)
        self.decisions.update(decide.made)
        return np.maximum(volume.data, 0)

    def chosen_weight(self) -> float:
        """The weight of total variation, for one projection, that predicts held-out projections best."""
        by_angle = np.argsort(np.mod(self.geometry.angles, self.geometry.period), kind="stable")
        trial_views = np.sort(by_angle[:: -(-len(self.views) // _TRIAL_VIEWS)])
        self.volume(_WeightByNoise(), self.views, trial_views)
        first = float(self.decisions["weight"][0] / math.sqrt(len(trial_views)))
        fitted, left_out = (trial_views[part] for part in split_views(self.geometry.select(trial_views)))
        projector, held_out = (
            Projector(self.geometry.select(left_out), self.box),
            projection_lines(self.views[left_out]),
        )

        def residuals(weight: float) -> NDArray[np.float64]:
            model = projector.forward(self.volume(_TotalVariation(weight), self.views, fitted))
            return unseen_residuals(projection_lines(model), held_out, None, projector.resolution)

        best = preferred_strength(residuals, first) if first > 0 else None
        return first if best is None else best.strength

    def copies(self, sample: F32, rng: np.random.Generator) -> list[F32]:
        """Two simulated scans [view, row, col] of a sample, with different noise like that of the open beam."""
        clean = Projector(self.geometry, self.box).forward(sample)
        photons = np.exp(clean, dtype=np.float64)  # the variance grows as the light falls
        deviation = np.sqrt(photons * float(np.mean(np.square(self.noise, dtype=np.float64))))
        return [(clean + rng.normal(size=clean.shape) * deviation).astype(np.float32) for _ in range(2)]

    def square_error(self, volume: F32, reference: F32) -> float:
        """Mean square difference of two volumes within the circle of the field of view."""
        y, x = np.meshgrid(*self.box.coordinates()[1:], indexing="ij")
        difference = np.subtract(volume, reference)[:, np.hypot(y, x) < _CIRCLE * self.geometry.reach]
        return float(np.mean(np.square(difference, dtype=np.float64)))

    def unseen_power(self, volume: F32, views: F32, unseen: NDArray[np.intp]) -> float:
        """Power of the error of a volume in projections that were not used for it, without the power of their noise."""
        projector, n = Projector(self.geometry.select(unseen), self.box), len(self.noise)
        lines = projection_lines(np.ascontiguousarray(views[unseen]))
        residual = at_voxel_resolution(lines, projector.resolution) - projection_lines(projector.forward(volume))
        angles_of_noise = self.geometry.select(unseen[np.arange(n) * len(unseen) // n])  # smoothed like the projections
        noise = at_voxel_resolution(projection_lines(self.noise), Projector(angles_of_noise, self.box).resolution)
        return _ramp_power(residual) - _ramp_power(noise) * float(np.exp(lines, dtype=np.float64).mean())


def _ramp_power(lines: F32) -> float:
    """Mean power of lines [view, col, row] after filtering with the root of the ramp along columns."""
    n = 2 * lines.shape[1]
    spectrum = np.fft.rfft(lines, n, axis=1)
    return float(np.mean(np.fft.rfftfreq(n)[None, :, None] * np.abs(spectrum) ** 2))
