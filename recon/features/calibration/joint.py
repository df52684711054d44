"""Joint fit of the volume and the geometry, by least squares on the projections.

    min over (y, c)  ‖ p - A(g) x - A(g) y - J c ‖²_W        J: the change of the images of x for a change c of the
    geometry

An alternation between volume and geometry would be slow if the volume can hide an error of the geometry. For example, a
slow drift looks like a slightly blurred sample. Here volume and geometry are unknowns of one system, which conjugate
gradients solve (Gauss-Newton; the geometry part of bundle adjustment). W is the ramp filter of FBP along the columns,
so that AᵀWA is near the identity and ten steps suffice. The conjugate gradients start from zero change. So the solution
does not change in directions that the projections do not determine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from scipy import fft, ndimage

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.fbp import ramp
from recon.voxels.projector import Projector, projection_lines

TERMS = "axis", "roll", "tilt", "shifts"
"""The quantities that may change: column of the axis, in-plane tilt of the axis, tilt of the axis along the beam, and
position (col, row) of each projection."""


@dataclass(frozen=True, eq=False)
class GeometryChange:
    """A change of a geometry, in pixels and radians.

    Attributes:
        axis: columns.
        shifts: float64 [view, 2], (col, row).
    """

    axis: float
    roll: float
    tilt: float
    shifts: F64

    @classmethod
    def none(cls, views: int) -> GeometryChange:
        return cls(0.0, 0.0, 0.0, np.zeros((views, 2)))

    @classmethod
    def between(cls, before: Geometry, after: Geometry) -> GeometryChange:
        """The change from one geometry to another geometry of the same projections."""
        return cls(
            after.axis_col - before.axis_col,
            float((after.roll - before.roll).mean()),
            float((after.tilt - before.tilt).mean()),
            after.shifts - before.shifts,
        )

    def of(self, terms: frozenset[str]) -> GeometryChange:
        """The change, limited to these terms."""
        return GeometryChange(
            self.axis * ("axis" in terms), self.roll * ("roll" in terms), self.tilt * ("tilt" in terms),
            self.shifts * ("shifts" in terms),
        )  # fmt: skip

    def scaled(self, factor: float) -> GeometryChange:
        """The same change in pixels that are smaller by this factor."""
        return replace(self, axis=self.axis * factor, shifts=self.shifts * factor)

    def applied(self, geometry: Geometry) -> Geometry:
        """The geometry with this change applied."""
        return replace(
            geometry,
            axis_col=geometry.axis_col + self.axis,
            roll=geometry.roll + self.roll,
            tilt=geometry.tilt + self.tilt,
            shifts=geometry.shifts + self.shifts,
        )


def knowable(shifts: F64, angles: F64) -> tuple[F64, float]:
    """Shifts [view, 2] without the part that the data cannot determine, and their mean along the columns, which is a
    shift of the axis."""
    undetermined_basis = np.stack((np.ones_like(angles), np.cos(angles), np.sin(angles)), axis=1)
    solution = np.linalg.lstsq(undetermined_basis, shifts[:, 0], rcond=None)[0]
    remainder = np.stack((shifts[:, 0] - undetermined_basis @ solution, shifts[:, 1] - shifts[:, 1].mean()), axis=1)
    return remainder, float(solution[0])


def slopes(images: F32, geometry: Geometry, tilted: F32 | None, terms: frozenset[str]) -> dict[str, F32]:
    """Derivatives of images [view, col, row] with respect to each quantity, per pixel (for angles: per pixel at the
    image's edge).

    Args:
        tilted: derivative with respect to tilt, per radian; None: not needed.
    """
    along_columns = -np.gradient(images, axis=1)
    along_rows = -np.gradient(images, axis=2) if images.shape[2] > 1 else 0 * images
    by_term: dict[str, F32] = {}
    if "axis" in terms:  # also used if there are shifts, so that one step finds their mean
        by_term["axis"] = along_columns
    if "shifts" in terms:
        by_term |= {"col": along_columns, "row": along_rows}
    rows, cols = geometry.detector_shape
    if "roll" in terms:
        u = np.arange(cols) - geometry.axis_col - geometry.shifts[:, :1]
        v = np.arange(rows) - geometry.axis_row - geometry.shifts[:, 1:]
        turned = along_columns * v[:, None, :].astype(np.float32) - along_rows * u[:, :, None].astype(np.float32)
        by_term["roll"] = np.asarray(turned / edge_motion(geometry), np.float32)
    if tilted is not None:
        by_term["tilt"] = np.asarray(tilted / edge_motion(geometry), np.float32)
    return by_term


def edge_motion(geometry: Geometry) -> float:
    """Displacement of the image's edge per radian of roll or tilt, in pixels."""
    return max(geometry.detector_shape) / 2


def moved(geometry: Geometry, steps: dict[str, NDArray[np.float64]], farthest: float) -> Geometry:
    """The geometry after steps along `slopes` of at most `farthest` pixels, without the parts that the data cannot
    determine."""
    limited = {name: np.clip(step, -farthest, farthest) for name, step in steps.items()}
    shifts, axis = geometry.shifts.copy(), geometry.axis_col
    if "col" in limited:
        shifts += np.stack((limited["col"], limited["row"]), axis=1)
        shifts, mean = knowable(shifts, geometry.angles)
        axis += mean
    if "axis" in limited:
        axis += float(limited["axis"][0])
    angle_steps = {
        name: float(limited[name][0]) / edge_motion(geometry) for name in ("roll", "tilt") if name in limited
    }
    limit = math.radians(30)
    return replace(
        geometry,
        axis_col=axis,
        shifts=shifts,
        roll=np.clip(geometry.roll + angle_steps.get("roll", 0.0), -limit, limit),
        tilt=np.clip(geometry.tilt + angle_steps.get("tilt", 0.0), -limit, limit),
    )


_TRIAL_DISPLACEMENT = 0.25  # pixels at the image's edge, for the derivative with respect to tilt
_MARGIN_SLICES = 3  # additional slices at either end
# a projection with less than this share of the information in a typical one is not moved, because it shows no material
_LEAST_INFORMATION = 0.05


@dataclass(eq=False)
class JointFit:
    """The state of a joint fit: a volume [y, x, z] and the geometry of some projections, improved together in steps.

    Attributes:
        data: [view, col, row], line integrals.
        known: [view, col, row] weights of rays; None: 1 for all.
        terms: those of `TERMS` that may change.
        volume: the best volume so far.
        turned: the data that a detector without roll would have measured.
    """

    data: F32
    geometry: Geometry
    terms: frozenset[str]
    grid: Grid
    known: F32 | None = None
    volume: F32 = field(init=False)
    turned: F32 = field(init=False)

    def __post_init__(self) -> None:
        nz, ny, nx = self.grid.shape
        self.volume = np.zeros((ny, nx, nz), np.float32)
        self.turned = _turned_back(self.data, self.geometry) if self.geometry.roll.any() else self.data

    @classmethod
    def of(cls, data: F32, geometry: Geometry, terms: frozenset[str], known: F32 | None = None) -> JointFit:
        """A joint fit to projections [view, row, col]."""
        tall = taller(Grid.matching(geometry))
        rays = None if known is None else projection_lines(known)
        return cls(projection_lines(data), geometry, terms, tall, rays)

    def weighed(self, images: F32) -> F32:
        """W applied to images, see the module."""
        if self.known is None:
            return _ramp(images)
        return self.known * _ramp(self.known * images)

    def step(self, rounds: int, farthest: float) -> None:
        """One Gauss-Newton step for the volume, and for the geometry if the volume is not zero.

        Args:
            rounds: number of conjugate-gradient iterations.
            farthest: largest move of any quantity, in pixels.
        """
        model = _Model(self.geometry, self.grid)
        images, free = model.forward(self.volume), dict[str, F32]()
        if self.terms and self.volume.any():
            by_tilt = model.by_tilt(self.volume) if "tilt" in self.terms else None
            free = slopes(images, model.geometry, by_tilt, self.terms)
        y, c = _solved(model, free, self.weighed, self.turned - images, rounds)
        self.volume += y
        np.maximum(self.volume, 0, out=self.volume)
        if free:
            self.geometry = moved(self.geometry, c, farthest)
            if {"col", "roll"} & set(free) and self.geometry.roll.any():
                self.turned = _turned_back(self.data, self.geometry)


def taller(grid: Grid) -> Grid:
    """The grid with more slices at either end, for tilted or shifted projections."""
    return replace(grid, shape=(grid.shape[0] + 2 * _MARGIN_SLICES, *grid.shape[1:]))


class _Model:
    """Projection of a volume [y, x, z] to images [view, col, row] without roll, and the transpose.

    A tilt in a parallel beam is approximated to first order: it displaces the image of a voxel along the rotation axis
    by the voxel's depth times the tilt. So only the images of the volume times x, and of the volume times y, are
    needed.
    """

    def __init__(self, geometry: Geometry, grid: Grid) -> None:
        self.geometry = geometry.straightened()
        self._tilt, self._grid = float(geometry.tilt[0]), grid
        exact = replace(self.geometry, tilt=geometry.tilt) if geometry.is_cone else self.geometry
        self._projector = Projector(exact, grid)
        _, y, x = (axis.astype(np.float32) / np.float32(geometry.pixel_pitch) for axis in grid.coordinates())
        self._x, self._y = x[None, :, None], y[:, None, None]
        self._cos, self._sin = (f(geometry.angles).astype(np.float32)[:, None, None] for f in (np.cos, np.sin))

    def forward(self, volume: F32) -> F32:
        images = self._projector.forward_lines(volume)
        if self._tilt and not self.geometry.is_cone:
            images += np.float32(self._tilt) * self.by_tilt(volume)
        return images

    def adjoint(self, images: F32) -> F32:
        volume = self._projector.adjoint_lines(images)
        if self._tilt and not self.geometry.is_cone:
            tilt_changes = np.float32(self._tilt) * _along_rows(images)
            volume += self._y * self._projector.adjoint_lines(tilt_changes * self._cos)
            volume -= self._x * self._projector.adjoint_lines(tilt_changes * self._sin)
        return volume

    def by_tilt(self, volume: F32) -> F32:
        """The derivative of the images with respect to tilt, per radian."""
        if self.geometry.is_cone:
            trial_tilt = _TRIAL_DISPLACEMENT / max(self.geometry.detector_shape)
            tilted_forwards, tilted_backwards = (
                Projector(replace(self.geometry, tilt=self._projector.geometry.tilt + t), self._grid)
                for t in (trial_tilt, -trial_tilt)
            )
            difference = tilted_forwards.forward_lines(volume) - tilted_backwards.forward_lines(volume)
            return difference / np.float32(2 * trial_tilt)
        by_x, by_y = (self._projector.forward_lines(volume * coordinate) for coordinate in (self._x, self._y))
        return -_along_rows(by_y * self._cos - by_x * self._sin)


def _along_rows(images: F32) -> F32:
    """Slopes along the rows (central differences of fourth order); 0 outside."""
    out = np.zeros_like(images)
    for reach, coefficient in ((1, 8 / 12), (2, -1 / 12)):
        out[..., :-reach] += np.float32(coefficient) * images[..., reach:]
        out[..., reach:] -= np.float32(coefficient) * images[..., :-reach]
    return out


def _turned_back(data: F32, geometry: Geometry) -> F32:
    """The projections [view, col, row] that a detector without roll would have measured (cubic interpolation)."""
    out = np.empty_like(data)
    for view in range(len(data)):
        c, s = math.cos(geometry.roll[view]), math.sin(geometry.roll[view])
        rotation, origin = np.array([[c, s], [-s, c]]), np.array(geometry.origin(view))
        out[view] = ndimage.affine_transform(data[view], rotation, origin - rotation @ origin, mode="nearest")
    return out


def _ramp(images: F32) -> F32:
    cols = images.shape[1]
    n = fft.next_fast_len(2 * cols, real=True)
    spectrum = fft.rfft(images, n, axis=1, workers=get_num_threads())
    spectrum *= ramp(n, 1.0, "hann")[:, None]
    return np.asarray(fft.irfft(spectrum, n, axis=1, workers=get_num_threads())[:, :cols])


def _solved(
    model: _Model, free: dict[str, F32], weighed: Callable[[F32], F32], residual: F32, rounds: int
) -> tuple[F32, dict[str, F64]]:
    """The change of the volume and of each quantity that may change: [view] for positions of projections, [1] for the
    others."""
    first = model.adjoint(weighed(residual))
    projected = model.forward(first)
    typical = float(np.vdot(projected, weighed(projected)) / max(float(np.vdot(first, first)), 1e-30))
    scale: dict[str, NDArray[np.float64]] = {}
    for name, slope in free.items():
        information = np.einsum("vcr,vcr->v", slope, weighed(slope)).astype(np.float64)
        information = (
            np.maximum(information, _LEAST_INFORMATION * np.median(information))
            if name in ("col", "row")
            else information.sum(keepdims=True)
        )
        scale[name] = np.sqrt(typical / np.maximum(information, 1e-30))

    def transpose(images: F32) -> tuple[F32, dict[str, F64]]:
        values = {}
        for name, slope in free.items():
            each = np.einsum("vcr,vcr->v", slope, images).astype(np.float64)
            values[name] = scale[name] * (each if scale[name].size > 1 else each.sum(keepdims=True))
        return model.adjoint(images), values

    def dot(a: tuple[F32, dict[str, F64]]) -> float:
        return float(np.vdot(a[0], a[0])) + sum(float(v @ v) for v in a[1].values())

    volume_change, term_changes = np.zeros_like(first), {name: np.zeros(s.size) for name, s in scale.items()}
    gradient = transpose(weighed(residual))
    direction = gradient[0].copy(), {name: v.copy() for name, v in gradient[1].items()}
    squares = dot(gradient)
    for _ in range(rounds):
        if squares == 0:
            break
        image = model.forward(direction[0])
        for name, slope in free.items():
            image += slope * (scale[name] * direction[1][name]).astype(np.float32)[:, None, None]
        weighed_image = weighed(image)
        step_length = squares / max(float(np.vdot(image, weighed_image)), 1e-30)
        volume_change += np.float32(step_length) * direction[0]
        change = transpose(weighed_image)
        for name in term_changes:
            term_changes[name] += step_length * direction[1][name]
            gradient[1][name] -= step_length * change[1][name]
        gradient = gradient[0] - np.float32(step_length) * change[0], gradient[1]
        last_squares, squares = squares, dot(gradient)
        direction = (
            gradient[0] + np.float32(squares / last_squares) * direction[0],
            {name: gradient[1][name] + squares / last_squares * direction[1][name] for name in term_changes},
        )
    return volume_change, {name: scale[name] * value for name, value in term_changes.items()}
