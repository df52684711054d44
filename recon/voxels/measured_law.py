"""The law of the error of a volume, measured in its views: what further views would bring, without a truth.

Volumes of total variation are made of half and of seven eighths of the views, and judged by the eighth held out: the
power of the residual, filtered by the root of the ramp (which makes it the square error in the volume, by Parseval's
theorem and the central slice theorem), less that of the noise of the open beam. How far the error falls from the one to
the other is compared with a copy of the scan in which the second volume is the sample and noise alone is added (a
parametric bootstrap; Efron & Tibshirani 1993, ch. 6.5). In that copy more views always help, by n^-0.65. Where the
measured error falls less than in the copy, it has parts that further views do not take away: edges between voxels,
fringes, a motion, a detector that is not as assumed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.assess.error_law import ErrorLaw
from recon.base.arrays import F32, bin_views
from recon.base.decisions import Decisions
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

EXPONENT = 0.65
"""Of the fall of the error by noise and gaps with the views: 0.59 to 0.69 in copies of ten scans (tests/bench)."""
LEAST_VIEWS = 48
_TRUST = 1.5  # times the measured share of the fall: half of the views in gaps of the others show too little of it
_LEAST, _UNKNOWN = 0.15, 0.75  # shares: at least, and where the views fit no volume of absorption (fringes)
_NO_FIT = 4.0  # times the error in the copy, from which they do not
_SPREAD = 0.25  # relative standard error of an exponent (tests/bench/next_pass.py)
_ROWS, _WORK = 8, 360 * 512**2  # rows of the slab; views times square of the columns: more are binned
_SWEEPS, _SUBSETS, _TV_STEPS, _TRIAL_VIEWS = 8, 9, 3, 64
_FRAMES = 3  # of the open beam, at least
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
            the views; None: the share of the error that stays is not measured, and taken as none.

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
    parts = np.sort(_in_angle(scan.geometry)[1::2]), most
    weight = scan.chosen_weight()
    measured = [scan.volume(scan.views, some, weight) for some in parts]
    if not measured[1].any():
        raise ValueError("the error of a volume is not measured: these views show no matter")
    copy, other = scan.copies(measured[1], most, rng)
    copied = [scan.volume(copy, some, weight) for some in parts]
    again = scan.volume(other, parts[0], weight)
    errors = [scan.square_error(volume, measured[1]) for volume in copied]
    noise = min(scan.square_error(copied[0], again) / 2 / errors[0], 1.0) if errors[0] > 0 else 0.0
    share = 1.0
    if scan.noise is not None:
        real = [scan.unseen_power(volume, scan.views, held_out) for volume in measured]
        ideal = [scan.unseen_power(volume, copy, held_out) for volume in copied]
        share = _share(real, ideal)
    offset = offset_error(Volume(measured[1], scan.box), scan.geometry, sample)
    law = ErrorLaw(n, EXPONENT * share, _SPREAD * EXPONENT * share, noise * share, offset / (errors[1] + offset))
    if offset:
        law = replace(law, noise=law.noise * (1 - law.offset))
    gained = law.exponent * 10 * math.log10(n / sizes[-2]) if len(sizes) > 1 else None
    return MeasuredLaw(law, gained)


def _share(real: Sequence[float], ideal: Sequence[float]) -> float:
    """The share of the copy's fall, from the first error to the second, that the views show."""
    if real[1] > _NO_FIT * ideal[1]:
        return _UNKNOWN
    if not ideal[0] > ideal[1] > 0:
        return 1.0
    fall = math.log(max(real[0], ideal[0] / 10) / max(real[1], ideal[1] / 10))
    return min(max(_TRUST * fall / math.log(ideal[0] / ideal[1]), _LEAST), 1.0)


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
        some = _some_views(geometry)
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
        some = _some_views(self.geometry)
        seen, unseen = (some[part] for part in split_views(self.geometry.select(some)))
        projector = Projector(self.geometry.select(unseen), self.box)
        judges = projection_lines(self.views[unseen])

        def residuals(weight: float) -> NDArray[np.float64]:
            model = projector.forward(self.volume(self.views, seen, weight))
            return unseen_residuals(projection_lines(model), judges, None, projector.resolution)

        best = preferred_strength(residuals, self.weight) if self.weight > 0 else None
        return self.weight if best is None else best.strength

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


def _in_angle(geometry: Geometry) -> NDArray[np.intp]:
    return np.argsort(np.mod(geometry.angles, np.pi), kind="stable")


def _some_views(geometry: Geometry) -> NDArray[np.intp]:
    """Views of the trials of a weight, evenly spread."""
    return np.sort(_in_angle(geometry)[:: -(-geometry.n_views // _TRIAL_VIEWS)])


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
