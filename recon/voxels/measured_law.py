"""The law of the error of a volume, measured in its views: what further views would bring, without a truth.

Where noise makes the error, the square error of a volume of total variation falls as n^-0.6 with the views; where edges
between voxels, fringes, a motion or matter beside the field make it, as n^-0.3 or less. Which of the two is so is
measured. A volume of seven eighths of the views stands for the sample, and in a copy of the scan noise alone is added
to its projections (a parametric bootstrap; Efron & Tibshirani 1993, ch. 6.5). The copy tells the share of the noise in
the error. Then volumes of half and of seven eighths of the views are judged by the eighth held out, in the scan and in
the copy: by the power of their residual, filtered by the root of the ramp (which makes it the square error of the
volume, by the theorems of Parseval and of the central slice), less that of the noise of the open beam. Where the error
falls less in the scan than in the copy, it has parts that further views do not take away.
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
from recon.base.volume import Grid, Volume
from recon.voxels.beyond_field import offset_error, sample_radius
from recon.voxels.fbp import fbp
from recon.voxels.field_edges import busiest_rows, slab_of
from recon.voxels.held_out import preferred_strength, split_views, unseen_residuals
from recon.voxels.iterative import solve
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.resolution import at_voxel_resolution
from recon.voxels.voxel_problem import VoxelProblem

LEAST_VIEWS = 40
_BY_NOISE, _BY_OTHERS = 0.6, 0.3  # exponents; on ten scans 0.5 to 0.7, and 0.1 to 0.4 (tests/bench/next_pass.py)
_NOISY = 0.08, 0.16  # shares of noise in the error: up to the first something else, from the second noise makes it
_SPREAD = 0.25  # half of the range of a gain, as a share of it: a convention, see docs/performance.md
_SAME_ANGLES = 0.8  # of an exponent is the share of the error that falls with light at the same angles: median of 14
_VOLUME_OVER_VIEWS = 1.4  # times the fall that is measured: views show errors between voxels, too, which stay
_ROWS, _WORK = 8, 60 * 512**2  # rows of the slab; views times square of the columns: more are binned
_SWEEPS, _SUBSETS, _TV_STEPS, _TRIAL_VIEWS = 8, 9, 3, 64
_LEAST_FRAMES = 3  # of the open beam, at least
_TINY = 1e-30
_CIRCLE = 0.95  # of the field's radius, where errors count


def measured_law(
    data: F32, geometry: Geometry, sizes: Sequence[int], rng: np.random.Generator, open_beam: F32
) -> tuple[ErrorLaw, float | None]:
    """The law of the error of the volume of these views, and dB by those of the last pass (None: not known).

    Args:
        data: line integrals [view, row, col] in the order taken; finite.
        geometry: of these views: parallel beam, straight.
        sizes: numbers of views at the ends of passes so far, the last of all.
        open_beam: line integrals [frame, row, col] of frames of the open beam that follow each other, noise alone,
            binned as the views.

    Raises:
        ValueError: a cone, fewer than 40 views or 3 frames of the open beam, or views without matter.
    """
    n = len(data)
    if geometry.is_cone or n < LEAST_VIEWS or len(open_beam) < _LEAST_FRAMES:
        needed = f"{LEAST_VIEWS} and {_LEAST_FRAMES} needed"
        there = f"{n} views and {len(open_beam)} frames of the open beam are there, {needed}"
        raise ValueError(
            f"the error of a volume is not measured: {'the beam is a cone' if geometry.is_cone else there}"
        )
    sample = sample_radius(data, geometry)
    slab = _Slab.of(data, geometry, 1.0 if sample is None else sample.radius / geometry.reach, open_beam)
    most, held_out = split_views(slab.geometry)
    parts = split_views(slab.geometry, 2)[1], most
    weight = slab.chosen_weight()
    measured = [slab.volume(slab.views, some, weight) for some in parts]
    if not measured[1].any():
        raise ValueError("the error of a volume is not measured: these views show no matter")
    copy, other = slab.copies(measured[1], rng)
    copied = [slab.volume(copy, some, weight) for some in parts]
    errors = [slab.square_error(volume, measured[1]) for volume in copied]
    noise = slab.square_error(copied[0], slab.volume(other, parts[0], weight)) / 2 / max(errors[0], _TINY)
    fall = _fall(
        [slab.unseen_power(volume, slab.views, held_out) for volume in measured],
        [slab.unseen_power(volume, copy, held_out) for volume in copied],
    )
    gaps = n < geometry.detector_shape[1]  # between the views: their error falls as that by noise does
    by_noise = 1.0 if gaps else noise * (1.0 if fall is None else fall)
    exponent = float(np.interp(by_noise, _NOISY, (_BY_OTHERS, _BY_NOISE)))
    beside = offset_error(Volume(measured[1], slab.box), slab.geometry, sample)
    offset = beside / (errors[1] + beside) if beside else 0.0
    law = ErrorLaw(n, exponent, _SPREAD * exponent, _SAME_ANGLES * exponent * (1 - offset), offset)
    if not fall or len(sizes) < 2 or min(errors) <= 0:
        return law, None
    measured_exponent = (
        _VOLUME_OVER_VIEWS * fall * math.log(errors[0] / errors[1]) / math.log(len(most) / len(parts[0]))
    )
    return law, measured_exponent * 10 * math.log10(n / sizes[-2])


def _fall(real: Sequence[float], ideal: Sequence[float]) -> float | None:
    """The fall of the error from the first volume to the second, over that in the copy, 0 to 1; None: not known."""
    if not ideal[0] > ideal[1] > 0:
        return None
    fall = math.log(max(real[0], ideal[0] / 10) / max(real[1], ideal[1] / 10))
    return min(max(fall / math.log(ideal[0] / ideal[1]), 0.0), 1.0)


@dataclass(frozen=True)
class _TotalVariation:
    """FISTA-TV of a weight; None: only the weight by the noise is decided."""

    weight: float | None
    iterations: int = _SWEEPS

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        if self.weight is None:
            problem.decide("weight", lambda: NoiseBalance.of(problem, x, self.iterations).first)
            return x
        subsets = Subsets.of(problem, _SUBSETS)
        return ordered_fista(problem, x, self.weight, subsets, sweeps=self.iterations, tv_steps=_TV_STEPS)


@dataclass(frozen=True, eq=False)
class _Slab:
    """Some rows of a scan, binned where they are many.

    Attributes:
        views: [view, row, col]; noise: of one frame of the open beam [frame, row, col].
        box: as wide as the sample.
        made: decisions of the first volume, which the others follow.
    """

    views: F32
    geometry: Geometry
    box: Grid
    noise: F32
    made: dict[str, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, data: F32, geometry: Geometry, width: float, open_beam: F32) -> _Slab:
        """Rows with most matter of a scan whose sample is `width` times as wide as the field."""
        halvings = math.log2(width * data.shape[2] * math.sqrt(len(data) / _WORK))
        factor = 2 ** max(0, math.ceil(halvings))
        rows = busiest_rows(data, min(_ROWS * factor, data.shape[1]))
        views, geometry = np.ascontiguousarray(data[:, rows]), geometry.rows(rows.start, rows.stop)
        change = np.diff(open_beam, axis=0)
        change -= np.median(change, axis=(1, 2), keepdims=True)
        noise = (change / math.sqrt(2)).astype(np.float32)
        if factor > 1:
            views, noise, geometry = bin_views(views, factor), bin_views(noise, factor), geometry.binned(factor)
        geometry, box = slab_of(geometry, Grid.matching(geometry), 0, geometry.detector_shape[0])
        return cls(views, geometry, box.reaching(width * geometry.reach, geometry) if width > 1 else box, noise)

    def volume(self, views: F32, some: NDArray[np.intp], weight: float | None) -> F32:
        """[z, y, x] of some of the views; `weight` of total variation: for one view, as of `_TotalVariation`.

        It grows as the noise in the gradient of the sum over the views does: with the root of their number.
        """
        geometry, images = self.geometry.select(some), np.ascontiguousarray(views[some])
        start = Volume(np.maximum(fbp(images, geometry, self.box, filter="hann"), 0), self.box)
        method, decide = _TotalVariation(weight and weight * math.sqrt(len(some))), Decisions(0, self.made)
        volume = solve(method, Projector(geometry, self.box), images, start=start, decide=decide)
        self.made.update(decide.made)
        return np.maximum(volume.data, 0)

    def chosen_weight(self) -> float:
        """The weight that predicts views held out best, for one view."""
        in_angle = np.argsort(np.mod(self.geometry.angles, self.geometry.period), kind="stable")
        some = np.sort(in_angle[:: -(-len(self.views) // _TRIAL_VIEWS)])
        self.volume(self.views, some, None)
        by_noise = float(self.made["weight"][0] / math.sqrt(len(some)))
        seen, unseen = (some[part] for part in split_views(self.geometry.select(some)))
        projector, judges = Projector(self.geometry.select(unseen), self.box), projection_lines(self.views[unseen])

        def residuals(weight: float) -> NDArray[np.float64]:
            model = projector.forward(self.volume(self.views, seen, weight))
            return unseen_residuals(projection_lines(model), judges, None, projector.resolution)

        best = preferred_strength(residuals, by_noise) if by_noise > 0 else None
        return by_noise if best is None else best.strength

    def copies(self, sample: F32, rng: np.random.Generator) -> list[F32]:
        """Two scans [view, row, col] of a sample, with different noise like that of the open beam."""
        clean = Projector(self.geometry, self.box).forward(sample)
        photons = np.exp(clean, dtype=np.float64)  # the variance rises as the light falls
        deviation = np.sqrt(photons * float(np.mean(np.square(self.noise, dtype=np.float64))))
        return [(clean + rng.normal(size=clean.shape) * deviation).astype(np.float32) for _ in range(2)]

    def square_error(self, volume: F32, other: F32) -> float:
        """Mean square difference of two volumes within the field's circle."""
        y, x = np.meshgrid(*self.box.coordinates()[1:], indexing="ij")
        part = np.subtract(volume, other)[:, np.hypot(y, x) < _CIRCLE * self.geometry.reach]
        return float(np.mean(np.square(part, dtype=np.float64)))

    def unseen_power(self, volume: F32, views: F32, unseen: NDArray[np.intp]) -> float:
        """Power of the error of a volume in views that it was not made of, without that of their noise."""
        projector, n = Projector(self.geometry.select(unseen), self.box), len(self.noise)
        seen = projection_lines(np.ascontiguousarray(views[unseen]))
        left = at_voxel_resolution(seen, projector.resolution) - projection_lines(projector.forward(volume))
        some = self.geometry.select(unseen[np.arange(n) * len(unseen) // n])
        noise = at_voxel_resolution(projection_lines(self.noise), Projector(some, self.box).resolution)
        return _ramp_power(left) - _ramp_power(noise) * float(np.exp(seen, dtype=np.float64).mean())


def _ramp_power(lines: F32) -> float:
    """Mean power of lines [view, col, row] after the root of the ramp along columns."""
    n = 2 * lines.shape[1]
    spectrum = np.fft.rfft(lines, n, axis=1)
    return float(np.mean(np.fft.rfftfreq(n)[None, :, None] * np.abs(spectrum) ** 2))
