"""Estimates from the projections how the sample has moved between the reference and a state: an affine map, then cubic
splines.

    m(r) = v(r + u(r)),    u = Σ_c B_c a_c

v is the reference with a gain for each particle. Each Gauss-Newton step fits the projected derivatives of m to the
residual of the projections (Leclerc, Roux & Hild 2015, Exp. Mech. 55, 275).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft
from scipy import ndimage as ndi

from recon.base.arrays import F32, F64
from recon.base.views import spread
from recon.base.volume import Grid
from recon.features.reference.particles import Particles
from recon.kernels.cpu.spline_warp import coefficients, pull
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import VoxelProblem

# smallest number of slices with which the motion along the axis is estimated; with fewer slices it is assumed to be 0
_TALL = 8
_VIEWS = 40  # largest number of projections from which the motion is estimated
_FIRST_ROTATIONS = np.radians(np.arange(-3.75, 3.8, 0.75))  # rotations about the axis that are tried first
_LARGEST_SHIFT = 16  # largest shift in voxels that is tried first; a tenth of the width if that is larger
_TRIAL_COLUMNS = 96  # largest number of voxels across, with which rotations and shifts are tried
_BAND = 2.5, 10.0  # widths of two Gaussians in voxels; structure between these widths is compared
_BLURS = 4, 4, 2, 1, 1  # blur in voxels of the steps towards the affine map
_STEPS, _AFFINE_STEPS = 10, 6  # conjugate-gradient iterations of a step, for splines and for an affine map
_BENDING = 160  # number of columns for which the weight of bending is stated
KNOTS = 8
"""Number of intervals of the finest splines across the field of view."""


@dataclass(frozen=True, eq=False)
class Basis:
    """Displacements [axis, y, x, z] that are linear in coefficients [axis, p, q, r].

    Attributes:
        y, x, z: functions along each axis, [place, function].
        used: [p, q, r], 1 if the product of the functions p, q and r is used, otherwise 0.
        axes: 2: displacements in the plane of the slices; 3: also along the rotation axis.
        intervals: number of intervals of the splines; 0: there are no splines, so nothing can bend.
    """

    y: F64
    x: F64
    z: F64
    used: F64
    axes: int
    intervals: int = 0

    @classmethod
    def affine(cls, grid: Grid, width: float) -> Basis:
        """The functions 1, y, x and z of an affine map. Coordinates are relative to the rotation axis, divided by half
        of `width` (mm).
        """
        z, y, x = (np.stack((coordinate**0, 2 * coordinate / width), axis=1) for coordinate in grid.coordinates())
        used = (np.add.outer(np.add.outer(np.arange(2), np.arange(2)), np.arange(2)) <= 1).astype(float)
        if grid.shape[0] < _TALL:
            used[:, :, 1] = 0
        return cls(y, x, z, used, 2 + (grid.shape[0] >= _TALL))

    @classmethod
    def splines(cls, grid: Grid, width: float, intervals: int) -> Basis:
        """Cubic B-splines with this number of intervals across `width` (mm). Intervals along z have the same length; in
        a thin volume the functions are constant along z.
        """
        edge = width / intervals
        z, y, x = grid.coordinates()
        intervals_along_axis = round(grid.shape[0] * grid.spacing[0] / edge)
        functions = (
            np.ones((z.size, 1)) if intervals_along_axis < 2 else _splines(z - z.mean(), edge, intervals_along_axis)
        )
        rows, cols = (_splines(coordinate, edge, intervals) for coordinate in (y, x))
        used = np.ones((intervals + 3, intervals + 3, functions.shape[1]))
        return cls(rows, cols, functions, used, 2 + (grid.shape[0] >= _TALL), intervals)

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.axes, *self.used.shape)

    def field(self, c: F64) -> F32:
        """The displacement [axis, y, x, z] for these coefficients."""
        wide = np.einsum("yp,apqr->ayqr", self.y, c * self.used).astype(np.float32)
        wide = np.einsum("xq,ayqr->ayxr", self.x.astype(np.float32), wide)
        return np.ascontiguousarray(wide @ self.z.T.astype(np.float32))

    def back(self, field: F32) -> F64:
        """The transpose of `field`."""
        summed_over_x_z = np.einsum("xq,ayxr->ayqr", self.x.astype(np.float32), field @ self.z.astype(np.float32))
        return self.used * np.einsum("yp,ayqr->apqr", self.y, summed_over_x_z.astype(np.float64))

    def uniform_along_z(self) -> Basis:
        """The same functions of y and x, constant along the axis."""
        return replace(self, z=np.ones((len(self.z), 1)), used=np.ones((*self.used.shape[:2], 1)))

    def squared(self) -> Basis:
        """The basis whose functions are the squares of these functions."""
        return replace(self, y=self.y**2, x=self.x**2, z=self.z**2)

    def bending(self, c: F64) -> F64:
        """Half the gradient of the sum of the squared second differences of neighbouring coefficients."""
        out = np.zeros_like(c)
        for axis in (1, 2, 3) if self.intervals else ():
            if c.shape[axis] > 2:
                e, padding = np.diff(c, 2, axis), [(0, 0)] * 4
                padding[axis] = (2, 2)
                out += np.diff(np.pad(e, padding), 2, axis)
        return out

    def nearest(self, u: F32) -> F64:
        """The coefficients whose displacement is nearest to u [axis, y, x, z]."""
        y, x, z = (np.linalg.pinv(each, rcond=1e-6) for each in (self.y, self.x, self.z))
        return np.einsum("py,qx,rz,ayxz->apqr", y, x, z, u[: self.axes], optimize=True)


def _splines(coordinate: F64, edge: float, intervals: int) -> F64:
    """Cubic B-splines [place, function] on intervals as long as `edge`, around 0."""
    t = np.abs(coordinate[:, None] / edge - (np.arange(intervals + 3) - (intervals + 2) / 2))
    return np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.maximum(2 - t, 0) ** 3 / 6)


@dataclass(frozen=True, eq=False)
class Moved:
    """A reference moved to a state.

    Attributes:
        particles: the parts of the reference; `first` is the voxel of the reference at voxel 0 of the state.
        u: displacement [3, y, x, z] in voxels, from a voxel of the state to the place from which it takes its value.
        gains: gain of the ground, then of each particle. Voxels next to particles have the median gain of the
            particles.
        radius: distance from the axis, in voxels, up to which the reference is known.
    """

    particles: Particles
    first: tuple[int, int, int]
    u: F32
    gains: F64
    radius: float = math.inf

    @property
    def at_rest(self) -> F32:
        """The reference with its gains, before it is moved."""
        own = self.particles
        of_label = np.concatenate(([self.gains[0]], self.gains[1:])).astype(np.float32)
        of_label[0] = np.float32(np.median(self.gains[1:])) if own.count else np.float32(1)
        return np.float32(self.gains[0]) * own.ground + of_label[own.label] * own.above

    def pulled(self, volume: F32) -> F32:
        """A volume on the voxels of the reference, moved to the state."""
        return self.with_slopes(volume, False)[0]

    def with_slopes(self, volume: F32, slopes: bool = True) -> tuple[F32, F32 | None]:
        """The same as `pulled`, and the derivatives [3, y, x, z] of the result with respect to u."""
        out = np.empty(self.u.shape[1:], np.float32)
        derivatives = np.empty_like(self.u) if slopes else None
        pull(coefficients(volume), self.u, self.first, out, derivatives)
        return out, derivatives

    def _places(self) -> list[F32]:
        positions = []
        for axis, (start, n) in enumerate(zip(self.first, self.u.shape[1:], strict=True)):
            own = (np.arange(n, dtype=np.float32) + start).reshape([-1 if a == axis else 1 for a in range(3)])
            positions.append(own + self.u[axis])
        return positions

    def labels(self) -> np.ndarray:
        """The particle of each voxel [y, x, z] of the state."""
        label = self.particles.label
        nearest = (
            np.rint(position).astype(int).clip(0, n - 1)
            for position, n in zip(self._places(), label.shape, strict=True)
        )
        return label[tuple(nearest)]

    def known(self) -> np.ndarray:
        """bool [y, x, z], True for voxels of the state whose place is inside the known part of the reference."""
        positions, shape = self._places(), self.particles.label.shape
        is_inside = np.ones(self.u.shape[1:], bool)
        for position, n in zip(positions, shape, strict=True):
            is_inside &= (position > -0.5) & (position < n - 0.5)
        if self.radius < math.inf:
            y, x = (position - (n - 1) / 2 for position, n in zip(positions[:2], shape[:2], strict=True))
            is_inside &= np.hypot(y, x) < self.radius
        return is_inside

    def volume(self) -> F32:
        """The moved reference [y, x, z]; 0 where it is not known."""
        return self.pulled(self.at_rest) * self.known()


@dataclass(frozen=True, eq=False)
class MotionViews:
    """The projections from which the motion is estimated: at most 40 projections of a problem."""

    projector: Projector
    lines: F32
    weight: F32 | None

    @classmethod
    def of(cls, problem: VoxelProblem) -> MotionViews:
        angles = np.argsort(np.mod(problem.projector.geometry.angles, problem.projector.geometry.period), kind="stable")
        chosen = np.sort(spread(angles, _VIEWS))
        weight = None if problem.weight is None else problem.weight[chosen]
        return cls(problem.projector.subset(chosen), problem.data[chosen], weight)

    def weighed(self, lines: F32) -> F32:
        return lines if self.weight is None else lines * self.weight


def improved(views: MotionViews, moved: Moved, basis: Basis, blur: float, additional: F32, with_gains: bool) -> Moved:
    """The reference after a Gauss-Newton step towards the projections. Reference and projections are blurred by `blur`
    voxels in the plane of the slices.

    Bending by a voxel over an eighth of the field of view costs as much as the mean residual of a ray. Therefore the
    splines get softer as the fit improves.

    Args:
        additional: a volume [y, x, z] that the projections show in addition to the moved reference.
        with_gains: True: also fit one gain of the ground and one gain of all particles.
    """

    def smooth(volume: F32) -> F32:
        return ndi.gaussian_filter(volume, (blur, blur, 0)) if blur else volume

    own, known = moved.particles, moved.known()
    reference, slopes = moved.with_slopes(smooth(moved.at_rest))
    assert slopes is not None
    slopes = slopes[: basis.axes] * known
    parts = [moved.pulled(smooth(part)) * known for part in (own.ground, own.above)] if with_gains else []
    lines = views.lines - views.projector.forward_lines(additional) if additional.any() else views.lines
    residual = ndi.gaussian_filter1d(lines, blur, axis=1) if blur else lines
    residual = residual - views.projector.forward_lines(reference * known)
    n, n_views = slopes.shape[2], len(residual)
    squared_slopes, size = basis.squared().back(slopes**2), math.prod(basis.shape)
    share = 1.0 if views.weight is None else float(views.weight.mean())
    bending_weight = float(views.weighed(residual**2).mean()) * ((basis.intervals / KNOTS) ** 2 * _BENDING / n) ** 2

    def forward(v: F64) -> F32:
        change = np.einsum("ayxz,ayxz->yxz", slopes, basis.field(v[:size].reshape(basis.shape)))
        for gain, part in zip(v[size:], parts, strict=True):
            change += np.float32(gain) * part
        return views.weighed(views.projector.forward_lines(change))

    def transpose(rays: F32) -> F64:
        volume = views.projector.adjoint_lines(rays)
        of_u = basis.back(slopes * volume)
        return np.concatenate((of_u.ravel(), [float(np.vdot(volume, part)) for part in parts]))

    def normal(v: F64) -> F64:
        out = transpose(forward(v))
        out[:size] += bending_weight * basis.bending(v[:size].reshape(basis.shape)).ravel()
        return out

    of_u = share * 4 * squared_slopes + 6 * bending_weight / n_views
    scale = np.concatenate((of_u.ravel(), [share * float(np.square(part).sum()) * n / 4 for part in parts]))
    scale = n_views * scale + 1e-12
    steps = _STEPS if basis.intervals else _AFFINE_STEPS
    step = conjugate(normal, transpose(views.weighed(residual)), lambda r: r / scale, steps)
    u, gains = moved.u.copy(), moved.gains.copy()
    u[: basis.axes] += basis.field(step[:size].reshape(basis.shape))
    if with_gains:
        gains[0] += step[-2]
        gains[1:] += step[-1]
    return replace(moved, u=u, gains=np.maximum(gains, 0))


def conjugate(normal: Callable[[F64], F64], right_side: F64, scaled: Callable[[F64], F64], iterations: int) -> F64:
    """Conjugate-gradient iterations (Hestenes & Stiefel 1952) from 0. `scaled` is the preconditioner."""
    x, r = np.zeros_like(right_side), right_side.copy()
    z = scaled(r)
    p, rz = z.copy(), float(r @ z)
    for _ in range(iterations):
        q = normal(p)
        if not (curvature := float(p @ q)) > 0:
            break
        a = rz / curvature
        x, r = x + a * p, r - a * q
        z, last_rz = scaled(r), rz
        rz = float(r @ z)
        p = z + rz / last_rz * p
    return x


def roughly_moved(moved: Moved, x: F32, grid: Grid, width: float) -> F64:
    """Coefficients of `Basis.affine` for the rotation about the axis and the shift with which the reference correlates
    best with a volume x.

    Both volumes are filtered by the difference of two Gaussians, so that neither levels nor noise count.
    """
    basis, factor = Basis.affine(grid, width), math.ceil(x.shape[1] / _TRIAL_COLUMNS)
    unmoved = replace(moved, u=np.zeros_like(moved.u))

    def band(volume: F32) -> F32:
        v = volume[::factor, ::factor]
        low, high = (ndi.gaussian_filter(v, (s / factor, s / factor, 0)) for s in _BAND)
        return low - high

    target = fft.rfftn(band(x * unmoved.known()))
    largest_shift = max(_LARGEST_SHIFT, x.shape[1] // 10) // factor
    largest_axial_shift = 0 if basis.axes == 2 else min(x.shape[2] // 4, _LARGEST_SHIFT)
    best = (-math.inf, basis.used * 0)
    reference = moved.particles.volume
    for rotation in _FIRST_ROTATIONS:
        c = _turned(basis, rotation, (0.0, 0.0, 0.0), width / grid.voxel_size)
        rotated = replace(unmoved, u=padded(basis.field(c)))
        product = fft.irfftn(target * np.conj(fft.rfftn(band(rotated.pulled(reference)))), s=band(x).shape)
        offsets = [np.arange(-m, m + 1) for m in (largest_shift, largest_shift, largest_axial_shift)]
        correlations = product[np.ix_(*offsets)]
        j, i, k = np.unravel_index(correlations.argmax(), correlations.shape)
        shift = (-factor * float(offsets[0][j]), -factor * float(offsets[1][i]), -float(offsets[2][k]))
        if correlations.max() > best[0]:
            best = float(correlations.max()), _turned(basis, rotation, shift, width / grid.voxel_size)
    return np.asarray(best[1])


def _turned(basis: Basis, rotation: float, shift: Sequence[float], diameter: float) -> F64:
    """Coefficients of a shift (y, x, z) in voxels, followed by a rotation about the axis. `diameter` is the width in
    voxels.
    """
    c = np.zeros(basis.shape)
    cos, sin, radius = math.cos(rotation), math.sin(rotation), diameter / 2
    dy, dx, dz = shift
    c[0, 0, 0, 0], c[1, 0, 0, 0] = cos * dy + sin * dx, cos * dx - sin * dy
    c[0, 1, 0, 0], c[0, 0, 1, 0] = (cos - 1) * radius, sin * radius
    c[1, 0, 1, 0], c[1, 1, 0, 0] = (cos - 1) * radius, -sin * radius
    if basis.axes == 3:
        c[2, 0, 0, 0] = dz
    return c


def affinely_moved(views: MotionViews, moved: Moved, basis: Basis, additional: F32) -> Moved:
    """The reference after steps on an affine map and two gains, from coarse to fine. The arguments are those of
    `improved`.
    """
    for blur in _BLURS:
        moved = improved(views, moved, basis, blur, additional, True)
    return moved


def padded(u: F32) -> F32:
    """The displacement with three axes, [3, y, x, z]. It is 0 along an axis that `u` does not have."""
    return np.concatenate((u, np.zeros((3 - len(u), *u.shape[1:]), np.float32)))
