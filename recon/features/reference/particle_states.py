"""Measures grey level, growth and shift of the particles of a reference in a state, each with an interval, from the
projections of the state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry
from recon.base.views import spread
from recon.base.volume import Grid
from recon.features.reference.motion import Basis, MotionViews, Moved, affinely_moved, improved, padded, roughly_moved
from recon.features.reference.particle_fit import (
    Body,
    Linear,
    ParticleEstimate,
    StateViews,
    improved_rounds,
    inside_of,
    unexplained,
)
from recon.features.reference.particles import Particles
from recon.reconstruction import reconstruct
from recon.voxels.direct import Fbp
from recon.voxels.projector import Projector, projection_lines, volume_lines

WIDE = 1.2816  # half width, in standard deviations, of an interval that contains the true value in 80 % of cases
STEPS = 6  # number of steps for a state, for the progress
Numbers = NDArray[np.int32]
Verdict = Literal["as before", "cracked", "closed", "gone", "not seen"]

_HALO = 3  # voxels around the label of a particle that count as part of the particle
_SHELL = 2  # thickness in voxels of the shell around them, in which the level around the particle is measured
_CORE = 2  # least distance from the surface, in voxels, of the voxels from which the level of a particle is computed
# share of the volume's voxels: a larger label is not a particle, but a wall or the whole sample
_LARGEST_PARTICLE_SHARE = 0.25
_REST_BLUR = 3.0  # width in voxels of the Gaussian that removes the noise of `rest`
# width in pixels of the Gaussian that smooths line integrals for weights, so that the weights do not depend on the
# noise of the same pixels
_BLUR = 4.0
_SPLINES = (4, 2.0), (6, 1.0)  # number of intervals, and blur in voxels, of the steps after the affine map
_MOTION_VIEWS = 40
# relative differences of gain and of diameter from the median, within which most particles of the same sample lie
_MATCH_TOLERANCES = 0.3, 0.1
# if the sample is the same: smallest share of these particles, and smallest median of the gain
_LEAST_MATCH_SHARE, _LEAST_GAIN = 0.65, 0.5
_GONE_GAIN = 0.3  # a particle with a smaller gain is gone
_LEAST_SEEN_SHARE = 0.5  # smallest share of a particle that must lie in rows that are used
_CLEAR_DEVIATIONS = 3.0  # standard deviations by which a cracked particle has less mass than the others
_TYPICAL = 8  # if there are at least so many whole particles, the spread is computed from these only
_LEAST_CRACK = 0.01  # smallest share of a particle that must be missing in a crack


@dataclass(frozen=True, eq=False)
class ReferenceParticles:
    """A reference volume divided into parts. Volumes are [y, x, z]; lengths are in voxels, so attenuation is per voxel.

    Attributes:
        volume: the whole reference.
        rest: everything that is not a particle.
        owner: number, from 1, of the body to which a voxel belongs; voxels near a particle belong to it, too. 0: no
            body.
        bodies: the particles.
        around: level around each particle.
        grid: grid of the reference, in mm.
        labels: [body], number of the body in the labelled volume.
        voxels: [body], number of voxels of the body.
    """

    volume: F32
    rest: F32
    owner: Numbers
    bodies: tuple[Body, ...]
    around: float
    grid: Grid
    voxels: NDArray[np.int64]

    @property
    def cut(self) -> NDArray[np.bool_]:
        """bool [body], True if the body touches the lowest or the highest slice."""
        bodies_at_ends = np.unique(self.owner[:, :, [0, -1]])
        return np.isin(np.arange(1, len(self.bodies) + 1), bodies_at_ends)


def reference_particles(volume: F32, labels: Numbers, grid: Grid) -> ReferenceParticles:
    """Divide a reference into parts.

    Args:
        volume, labels: [z, y, x], in 1/mm, and the particle of each voxel.

    Raises:
        ValueError: none of the labels is a particle.
    """
    counts = np.bincount(labels.ravel())
    kept = np.flatnonzero((counts > 0) & (counts < _LARGEST_PARTICLE_SHARE * labels.size))
    kept = kept[kept > 0]
    if not kept.size:
        raise ValueError("no particle was found in the reference; give --materials and --particles")
    number = np.zeros(counts.size, np.int32)
    number[kept] = np.arange(1, kept.size + 1)
    own = np.ascontiguousarray(number[labels].transpose(1, 2, 0))
    v = volume_lines(volume) * np.float32(grid.voxel_size)
    distance, nearest = ndimage.distance_transform_edt(own == 0, return_indices=True)
    owner = np.where(distance <= _HALO, own[tuple(nearest)], 0).astype(np.int32)
    shell = (distance > _HALO) & (distance <= _HALO + _SHELL)
    around = float(np.median(v[shell])) if shell.any() else 0.0
    depth, rest, bodies = ndimage.distance_transform_edt(own > 0), v.copy(), []
    for k, box in enumerate(ndimage.find_objects(owner), 1):
        mine = owner[box] == k
        excess = np.where(mine, v[box] - np.float32(around), 0).astype(np.float32)
        rest[box] -= excess
        solid = own[box] == k
        core = solid & (depth[box] >= _CORE)
        level = float(excess[core if core.any() else solid].mean())
        first = np.array([each.start for each in box], float)
        centre = first + ndimage.center_of_mass(np.where(solid, np.maximum(excess, 0) + 1e-12, 0))
        spline = ndimage.spline_filter(np.pad(excess, 2), 3, output=np.float32)
        bodies.append(Body(int(kept[k - 1]), spline, first - 2, centre, level, float(np.square(excess).sum())))
    return ReferenceParticles(v, rest, owner, tuple(bodies), around, grid, counts[kept])


@dataclass(frozen=True, eq=False)
class ParticleFit:
    """The result of the fit of the bodies to the projections of a state.

    Attributes:
        estimate: the estimate, with lengths in voxels.
        noise: [body, 6], standard deviations of gain, scale, shift (y, x, z) and mass, from the two halves of the
            projections.
        seen: [body], share of the body that the used rows show.
        motion: [body, (y, x, z)], shift from the reference in voxels.
    """

    estimate: ParticleEstimate
    noise: F64
    seen: F64
    motion: F64

    @property
    def measured(self) -> F64:
        """[body, 6], changes of gain, scale, shift (y, x, z) and mass."""
        e = self.estimate
        return np.column_stack((e.gain - 1, e.scale - 1, self.motion, e.gain * e.scale**3 - 1))

    @property
    def matches(self) -> bool:
        """True if this state contains most particles of the reference, so that it is the same sample."""
        seen = self.seen >= _LEAST_SEEN_SHARE
        gain, scale = self.estimate.gain[seen], self.estimate.scale[seen]
        if not gain.size or np.median(gain) < _LEAST_GAIN:
            return False
        is_near = [
            np.abs(values / np.median(values) - 1) < tolerance
            for values, tolerance in zip((gain, scale), _MATCH_TOLERANCES, strict=True)
        ]
        return bool((is_near[0] & is_near[1]).mean() > _LEAST_MATCH_SHARE)


@dataclass(frozen=True, eq=False)
class StateNumbers:
    """Values of the bodies of a reference in a state, with intervals; NaN for a value that is not determined.

    Attributes:
        grey: [body, 3] attenuation in 1/mm: value, low end and high end.
        grey_change: [body, 3] relative change of the attenuation since the reference.
        growth: [body, 3] relative change of the volume.
        shift: [body, axis z y x, 3] shift in mm.
        verdict: verdict on each body.
    """

    grey: F64
    grey_change: F64
    growth: F64
    shift: F64
    verdict: tuple[Verdict, ...]


def numbers_of(reference: ReferenceParticles, fit: ParticleFit) -> StateNumbers:
    """The values of the bodies in a state.

    A standard deviation here combines the error of the particle with the spread of all particles. A particle is cracked
    in two cases, compared with the median of all particles. (1) Its change of mass is lower by more than three standard
    deviations and by more than 1 %: a crack that is narrower than a voxel removes mass. (2) Its growth is higher by
    more than three standard deviations, and its change of mass is lower by more than one: a dark core looks like a
    lower grey level in a larger volume.
    """
    changes, deviation = fit.measured, fit.noise
    seen = (fit.seen >= _LEAST_SEEN_SHARE) & fit.matches
    is_gone = seen & (changes[:, 0] + 1 < _GONE_GAIN)
    is_present = seen & ~is_gone
    verdict = np.where(seen, np.where(is_gone, "gone", "as before"), "not seen").astype("<U9")
    if is_present.any():
        typical = is_present & ~reference.cut if (is_present & ~reference.cut).sum() >= _TYPICAL else is_present
        (mass_change, mass_deviation), (scale_change, scale_deviation) = (
            _relative_to_others(changes[:, j], deviation[:, j], typical) for j in (5, 1)
        )
        least_loss = np.maximum(_CLEAR_DEVIATIONS * mass_deviation, _LEAST_CRACK)
        for name, sign in (("cracked", 1), ("closed", -1)):
            outlier = (sign * scale_change > _CLEAR_DEVIATIONS * scale_deviation) & (
                sign * mass_change < -mass_deviation
            )
            verdict[is_present & ((sign * mass_change < -least_loss) | outlier)] = name
    changes, edge = np.where(seen[:, None], changes, np.nan), reference.grid.voxel_size
    changes[is_gone, 1:] = np.nan
    level = np.array([body.level for body in reference.bodies])
    reference_grey = (level + reference.around) / edge
    level_around = reference.around * (1 + fit.estimate.rest)
    grey = _interval((level_around + level * (1 + changes[:, 0])) / edge, level * deviation[:, 0] / edge)
    scale = _interval(1 + changes[:, 1], deviation[:, 1])
    shift = edge * _interval(changes[:, [4, 2, 3]], deviation[:, [4, 2, 3]])
    return StateNumbers(grey, grey / reference_grey[:, None] - 1, scale**3 - 1, shift, tuple(verdict.tolist()))


def _relative_to_others(value: F64, deviation: F64, others: NDArray[np.bool_]) -> tuple[F64, F64]:
    """The differences of values from the median of `others`, and the standard deviations of these differences, which
    combine the error of a value with the spread of all values.
    """
    differences = value - np.median(value[others])
    variance = np.square(1.4826 * np.median(np.abs(differences[others]))) - np.median(np.square(deviation[others]))
    return differences, np.sqrt(np.square(deviation) + max(float(variance), 0.0))


def _interval(value: F64, deviation: F64) -> F64:
    """[..., 3] value, low end and high end."""
    return np.stack((value, value - WIDE * deviation, value + WIDE * deviation), axis=-1)


def fit_state(
    reference: ReferenceParticles, lines: F32, geometry: Geometry, weights: F32 | None,
    tell: Callable[[], None] = lambda: None,
) -> ParticleFit:  # fmt: skip
    """Fit the bodies of a reference to the projections of a state.

    Args:
        lines: [view, row, col], line integrals, finite.
        geometry: geometry of a parallel beam. Pixels must be as wide as the voxels of the reference.
        weights: weight of each ray; None: 1 for all.
        tell: function that is called after each of the `STEPS` steps.
    """
    edge = reference.grid.voxel_size
    geometry = geometry.scaled(1 / edge)
    grid = Grid.matching(geometry)
    projector, p = Projector(geometry, grid), projection_lines(lines)
    weight = np.exp(-ndimage.gaussian_filter(np.maximum(p, 0), (0, _BLUR, _BLUR)))
    if weights is not None:
        weight *= projection_lines(weights)
    offset = (np.array(grid.first) - np.array(reference.grid.first) / edge)[[1, 2, 0]]
    u, rotation = _measured_motion(reference, projector, p, weight, offset)
    tell()
    positions = _places_of(reference, u, offset)
    sampled = _sampled(u, offset)
    rest = ndimage.map_coordinates(reference.rest, sampled, order=1, mode="nearest")
    known = ((sampled[2] > -0.5) & (sampled[2] < reference.rest.shape[2] - 0.5)).all((0, 1))
    weight[:, :, ~_rows_of(known, geometry, grid)] = 0
    views = StateViews(projector, p, weight, rest, ndimage.gaussian_filter(rest, _REST_BLUR), known)
    n = len(reference.bodies)
    estimate = ParticleEstimate(np.ones(n), np.ones(n), positions, rotation)
    estimate = improved_rounds(views, reference.bodies, estimate, (10, 20))
    tell()
    tell()
    dark = inside_of(views, reference.bodies, estimate, _has_less_mass(estimate))
    if dark.any():
        views = replace(views, lines=p - projector.forward_lines(unexplained(views, reference.bodies, estimate, dark)))
    tell()
    estimate = improved_rounds(views, reference.bodies, estimate, (20,))
    tell()
    linear = Linear.of(views, reference.bodies, estimate)
    noise = linear.noise_by_halves(~_has_less_mass(estimate))
    tell()
    shift = estimate.position - np.array([body.centre for body in reference.bodies]) + offset
    return ParticleFit(estimate, noise, linear.seen, shift)


def _has_less_mass(estimate: ParticleEstimate) -> NDArray[np.bool_]:
    """bool [body], True if the body has clearly less mass than most bodies."""
    mass = estimate.gain * estimate.scale**3
    middle = float(np.median(mass))
    deviation = 1.4826 * float(np.median(np.abs(mass - middle)))
    return mass < middle - np.maximum(_CLEAR_DEVIATIONS * deviation, _LEAST_CRACK)


def _rows_of(known: NDArray[np.bool_], geometry: Geometry, grid: Grid) -> NDArray[np.bool_]:
    """bool [row], True if the slices that the row sees are known."""
    heights = (np.arange(geometry.detector_shape[0]) - geometry.axis_row) * geometry.sample_pitch
    slices = (heights - grid.first[0]) / grid.spacing[0]
    last = known.size - 1
    return known[np.floor(slices).astype(int).clip(0, last)] & known[np.ceil(slices).astype(int).clip(0, last)]


def _measured_motion(
    reference: ReferenceParticles, projector: Projector, p: F32, weight: F32, offset: F64
) -> tuple[F32, F64]:
    """The approximate motion of the whole sample: displacement u [3, y, x, z] in voxels, and the rotation that it
    contains.
    """
    grid, geometry = projector.grid, projector.geometry
    nz, ny, nx = grid.shape
    no_displacement = np.zeros((3, ny, nx, nz), np.float32)
    level = float(np.median([body.level for body in reference.bodies]))
    parts = Particles(
        reference.rest, reference.volume - reference.rest, np.minimum(reference.owner, 1), reference.around, level
    )
    first = np.rint(offset).astype(int).tolist()
    moved = Moved(parts, (first[0], first[1], first[2]), no_displacement, np.ones(2))
    width = 2 * geometry.reach
    affine = Basis.affine(grid, width)
    lines = np.ascontiguousarray(p.transpose(0, 2, 1))
    fbp = volume_lines(reconstruct(lines, geometry, Fbp(), grid=grid).volume.data)
    affine_coefficients = roughly_moved(moved, fbp, grid, width)
    moved = replace(moved, u=padded(affine.field(affine_coefficients)))
    order = np.argsort(np.mod(geometry.angles, geometry.period), kind="stable")
    chosen = np.sort(spread(order, _MOTION_VIEWS))
    views, no_addition = MotionViews(projector.subset(chosen), p[chosen], weight[chosen]), np.zeros_like(fbp)
    moved = affinely_moved(views, moved, affine, no_addition)
    affine_coefficients = affine.nearest(moved.u)
    # Places in the reference change by the identity plus these slopes from one voxel of the state to the next.
    slopes = np.eye(3)
    for axis, direction in enumerate(((1, 0, 0), (0, 1, 0), (0, 0, 1))):
        slopes[: affine.axes, axis] += affine_coefficients[:, *direction] * 2 / width
    left, _, right = np.linalg.svd(slopes)
    for intervals, blur in _SPLINES:
        moved = improved(views, moved, Basis.splines(grid, width, intervals), blur, no_addition, False)
    return moved.u + np.float32(np.array(first) - offset).reshape(3, 1, 1, 1), (left @ right).T


def _sampled(u: F32, offset: F64) -> F32:
    """[3, y, x, z] place in the reference of each voxel of the state."""
    return np.stack([
        u[axis] + np.float32(offset[axis])
        + np.arange(u.shape[axis + 1], dtype=np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
        for axis in range(3)
    ])  # fmt: skip


def _places_of(reference: ReferenceParticles, u: F32, offset: F64) -> F64:
    """[body, (y, x, z)] position in the state of each body of the reference."""
    unshifted = np.array([body.centre for body in reference.bodies]) - offset
    position = unshifted.copy()
    for _ in range(8):
        position = unshifted - _shift_at(u, position)
    return position


def _shift_at(u: F32, position: F64) -> F64:
    return np.stack([ndimage.map_coordinates(part, position.T, order=1, mode="nearest") for part in u], axis=1)
