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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from recon.voxels.iterative import UNITS, solve
from recon.voxels.priors import NoiseBalance, Subsets, ordered_fista
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.resolution import at_voxel_resolution
from recon.voxels.voxel_problem import VoxelProblem

LEAST_VIEWS = 48
_BY_NOISE, _BY_ELSE = 0.6, 0.3  # exponents; on ten scans 0.5 to 0.7, and 0.1 to 0.4 (tests/bench/next_pass.py)
_NOISY = 0.08, 0.16  # shares of noise in the error: up to the first something else, from the second noise makes it
_SPREAD = 0.25  # relative standard error of an exponent, on the same scans
_SAME_ANGLES = 0.8  # of an exponent is the share of the error that falls with light at the same angles
_SHOWN = 1.4  # times the fall that is measured: views show errors between voxels, too, which stay
_FALL = 0.6  # the fall of the error of a scan over that in its copy, where it is not measured
_DENSITY = 3.0  # times the square error by the uncertainty of the density beside the field
_MOST_OFFSET = 0.4  # share of the error
_ROWS, _WORK = 8, 60 * 512**2  # rows of the slab; views times square of the columns: more are binned
_SWEEPS, _SUBSETS, _TV_STEPS, _TRIAL_VIEWS = 8, 9, 3, 64
_FRAMES = 3  # of the open beam, at least
_TINY = 1e-30
_BY_VIEWS = 0.6  # the weight of total variation grows with the views to this power
_CIRCLE = 0.95  # of the field's radius, where errors count


@dataclass(frozen=True)
class MeasuredLaw:
    """A law of the error; `gained`: dB by the views of the last pass, by the views held out (None: not known)."""

    law: ErrorLaw
    gained: float | None


def measured_law(
    data: F32, geometry: Geometry, sizes: Sequence[int], rng: np.random.Generator, open_beam: F32 | None = None
) -> MeasuredLaw:
    """The law of the error of the volume of these views.

    Args:
        data: line integrals [view, row, col] in the order taken; finite.
        geometry: of these views: parallel beam, straight.
        sizes: numbers of views at the ends of passes so far, the last of all.
        open_beam: line integrals [frame, row, col] of frames of the open beam, noise alone, three or more, binned as
            the views; None: how far the error falls is not measured, and taken as usual.

    Raises:
        ValueError: a cone, fewer than 48 views, or views without matter.
    """
    n = len(data)
    if geometry.is_cone or n < LEAST_VIEWS:
        why = "the beam is a cone" if geometry.is_cone else f"{n} views are fewer than {LEAST_VIEWS}"
        raise ValueError(f"the error of a volume is not measured: {why}")
    sample = sample_radius(data, geometry)
    scan = _Scan.of(data, geometry, 1.0 if sample is None else sample.radius / geometry.reach, open_beam)
    most, held_out = split_views(scan.geometry)
    parts = np.sort(scan.in_angle[1::2]), most
    weight = scan.chosen_weight()
    measured = [scan.volume(scan.views, some, weight) for some in parts]
    if not measured[1].any():
        raise ValueError("the error of a volume is not measured: these views show no matter")
    copy, other = scan.copies(measured[1], most, rng)
    copied = [scan.volume(copy, some, weight) for some in parts]
    errors = [scan.square_error(volume, measured[1]) for volume in copied]
    noise = scan.square_error(copied[0], scan.volume(other, parts[0], weight)) / 2 / max(errors[0], _TINY)
    fall = None
    if scan.noise is not None:
        real = [scan.unseen_power(volume, scan.views, held_out) for volume in measured]
        fall = _fall(real, [scan.unseen_power(volume, copy, held_out) for volume in copied])
    exponent = float(np.interp(noise * (_FALL if fall is None else fall), _NOISY, (_BY_ELSE, _BY_NOISE)))
    if n < geometry.detector_shape[1]:  # gaps between the views make the error
        exponent = _BY_NOISE
    beside = _DENSITY * offset_error(Volume(measured[1], scan.box), scan.geometry, sample)
    offset = min(beside / (errors[1] + beside), _MOST_OFFSET) if beside else 0.0
    law = ErrorLaw(n, exponent, _SPREAD * exponent, _SAME_ANGLES * exponent * (1 - offset), offset)
    if fall is None or len(sizes) < 2 or min(errors) <= 0:
        return MeasuredLaw(law, None)
    measured_exponent = _SHOWN * fall * math.log(errors[0] / errors[1]) / math.log(len(most) / len(parts[0]))
    return MeasuredLaw(law, measured_exponent * 10 * math.log10(n / sizes[-2]))


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
class _Scan:
    """Some rows of a scan, binned where they are many.

    Attributes:
        views: [view, row, col]; noise: of the open beam, [frame, row, col].
        box: as wide as the sample; field: that of the detector.
        weight: of total variation by the noise, for one view.
        units: that all volumes are made in, as `recon.voxels.iterative.solve` decides them.
    """

    views: F32
    geometry: Geometry
    box: Grid
    field: Grid
    noise: F32 | None
    weight: float
    units: Mapping[str, Sequence[Any]]

    @classmethod
    def of(cls, data: F32, geometry: Geometry, width: float, open_beam: F32 | None) -> _Scan:
        """Rows with most matter of a scan whose sample is `width` times as wide as the field."""
        factor = 1
        while len(data) * (width * data.shape[2] / factor) ** 2 > _WORK:
            factor *= 2
        rows = busiest_rows(data, min(_ROWS * factor, data.shape[1]))
        views = np.ascontiguousarray(data[:, rows])
        geometry = geometry.rows(rows.start, rows.stop)
        noise = None if open_beam is None or len(open_beam) < _FRAMES else _noise_of(open_beam)
        if factor > 1:
            views, geometry = bin_views(views, factor), geometry.binned(factor)
            noise = None if noise is None else bin_views(noise, factor)
        geometry, field = slab_of(geometry, Grid.matching(geometry), 0, geometry.detector_shape[0])
        box = field.reaching(width * geometry.reach, geometry) if width > 1 else field
        some = np.sort(np.argsort(np.mod(geometry.angles, np.pi))[:: -(-geometry.n_views // _TRIAL_VIEWS)])
        decide, part = Decisions(), geometry.select(some)
        solve(
            _TotalVariation(None),
            Projector(part, box),
            views[some],
            start=_first(views[some], part, box),
            decide=decide,
        )
        weight = decide.made["weight"][0] / len(some) ** _BY_VIEWS
        return cls(views, geometry, box, field, noise, weight, {UNITS: decide.made[UNITS]})

    def volume(self, views: F32, some: NDArray[np.intp], weight: float) -> F32:
        """[z, y, x] of some of the views; `weight` of total variation: for one view."""
        geometry, images = self.geometry.select(some), np.ascontiguousarray(views[some])
        method, start = _TotalVariation(weight * len(some) ** _BY_VIEWS), _first(images, geometry, self.box)
        made = solve(method, Projector(geometry, self.box), images, start=start, decide=Decisions(0, self.units))
        return np.maximum(made.data, 0)

    def chosen_weight(self) -> float:
        """The weight that predicts views held out best, for one view."""
        some = np.sort(self.in_angle[:: -(-len(self.views) // _TRIAL_VIEWS)])
        seen, unseen = (some[part] for part in split_views(self.geometry.select(some)))
        projector = Projector(self.geometry.select(unseen), self.box)
        judges = projection_lines(self.views[unseen])

        def residuals(weight: float) -> NDArray[np.float64]:
            model = projector.forward(self.volume(self.views, seen, weight))
            return unseen_residuals(projection_lines(model), judges, None, projector.resolution)

        best = preferred_strength(residuals, self.weight) if self.weight > 0 else None
        return self.weight if best is None else best.strength

    @property
    def in_angle(self) -> NDArray[np.intp]:
        """Views in the order of their angles, as `split_views` takes every eighth of them."""
        return np.argsort(np.mod(self.geometry.angles, self.geometry.period), kind="stable")

    def copies(self, sample: F32, fitted: NDArray[np.intp], rng: np.random.Generator) -> tuple[F32, F32]:
        """Two scans [view, row, col] of a sample, with different noise like that of the open beam; without one, like
        that of the residual in the views that the sample was fitted to."""
        clean = Projector(self.geometry, self.box).forward(sample)
        variance = np.exp(clean, dtype=np.float64)  # photons: it rises as the light falls
        if self.noise is not None:
            variance *= float(np.mean(np.square(self.noise, dtype=np.float64)))
        else:
            left = np.square(self.views[fitted] - clean[fitted], dtype=np.float64)
            variance *= float(left.mean()) / float(variance[fitted].mean())
        deviation = np.sqrt(variance)
        one, other = ((clean + rng.normal(size=clean.shape) * deviation).astype(np.float32) for _ in range(2))
        return one, other

    def square_error(self, volume: F32, other: F32) -> float:
        """Mean square difference of two volumes within the field's circle."""
        ny, nx = self.field.shape[1:]
        y, x = (np.rint(np.subtract(self.field.first, self.box.first) / self.field.spacing).astype(int))[1:]
        inside = np.hypot(*np.meshgrid(*self.field.coordinates()[1:], indexing="ij")) < _CIRCLE * self.geometry.reach
        part = np.subtract(volume, other)[:, y : y + ny, x : x + nx][:, inside]
        return float(np.mean(np.square(part, dtype=np.float64)))

    def unseen_power(self, volume: F32, views: F32, unseen: NDArray[np.intp]) -> float:
        """Power of the error of a volume in views that it was not made of, without that of their noise."""
        assert self.noise is not None
        projector = Projector(self.geometry.select(unseen), self.box)
        seen = projection_lines(np.ascontiguousarray(views[unseen]))
        left = at_voxel_resolution(seen, projector.resolution) - projection_lines(projector.forward(volume))
        some = unseen[np.arange(len(self.noise)) * len(unseen) // len(self.noise)]
        resolution = Projector(self.geometry.select(some), self.box).resolution
        noise = _ramp_power(at_voxel_resolution(projection_lines(self.noise), resolution))
        return _ramp_power(left) - noise * float(np.exp(seen, dtype=np.float64).mean())


def _first(views: F32, geometry: Geometry, box: Grid) -> Volume:
    return Volume(np.maximum(fbp(views, geometry, box, filter="hann"), 0), box)


def _noise_of(open_beam: F32) -> F32:
    """Noise [frame, row, col] as of one frame, from differences of frames that follow each other."""
    change = np.diff(open_beam, axis=0)
    change -= np.median(change, axis=(1, 2), keepdims=True)
    return (change / math.sqrt(2)).astype(np.float32)


def _ramp_power(lines: F32) -> float:
    """Mean power of lines [view, col, row] after the root of the ramp along columns."""
    n = 2 * lines.shape[1]
    spectrum = np.fft.rfft(lines, n, axis=1)
    return float(np.mean(np.fft.rfftfreq(n)[None, :, None] * np.abs(spectrum) ** 2))
