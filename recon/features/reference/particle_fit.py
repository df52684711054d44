"""Fits the particles of a reference to the projections of a state: grey level, growth and shift of each particle, by
least squares.

    min over g, s, c of  ½ |A m - p|²_W,    m(r) = rest(r) + Σ_k g_k a_k(c_k0 + Rᵀ (r - c_k) / s_k)

a_k is the excess of particle k over the level around it, in the reference. `rest` is everything else, moved with the
whole sample. Each Gauss-Newton round solves the linear problem by conjugate gradients. No volume of the state is
reconstructed, so few projections suffice (Leclerc, Roux & Hild 2015, Exp. Mech. 55, 275, for displacements).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from recon.base.arrays import F32, F64
from recon.features.reference.motion import conjugate
from recon.voxels.projector import Projector

UNKNOWNS = 5  # unknowns of a particle: gain, growth of the diameter, shift along y, x and z
MEASURED = np.vstack((np.eye(UNKNOWNS), (1, 3, 0, 0, 0)))
"""The unknowns, and the change of the mass, which follows from the gain and the growth."""
_PRIOR = 1.0, 0.1, 3.0, 3.0, 3.0  # standard deviations of the unknowns, much larger than what is expected
_LARGEST_STEPS = 1.0, 0.05, 1.5, 1.5, 1.5  # largest step of an unknown in a round
_HALVES = 25  # iterations with half of the projections
_CRACK = 8  # iterations for the excess of cracked particles that their shape does not explain
_SOLID = 0.5  # share of a particle's level above which a voxel is inside the particle


@dataclass(frozen=True, eq=False)
class Body:
    """A particle of the reference.

    Attributes:
        number: label of the particle.
        spline: [y, x, z], coefficients of a cubic spline through the excess of the particle over the level around it.
        first: voxel of the reference at voxel 0 of the spline.
        centre: centre (y, x, z) in voxels of the reference.
        level: mean excess over the level around the particle, away from its surface, in the unit of the volume.
        squares: sum of the squares of this excess.
    """

    number: int
    spline: F32
    first: F64
    centre: F64
    level: float
    squares: float


@dataclass(frozen=True, eq=False)
class ParticleEstimate:
    """The estimated positions, sizes and gains of the particles in a state.

    Attributes:
        gain: [particle], 1 means unchanged from the reference.
        scale: [particle], factor of the diameter.
        position: [particle, (y, x, z)], position in voxels of the state.
        rotation: [3, 3], the rotation of all particles.
        rest: change of the gain of everything that is not a particle.
        sharper: factor, in voxels², on the negative Laplacian of the particles that is added to them.
    """

    gain: F64
    scale: F64
    position: F64
    rotation: F64
    rest: float = 0.0
    sharper: float = 0.0


@dataclass(frozen=True, eq=False)
class Patch:
    """A particle in a state.

    Attributes:
        box: the box of voxels of the state that contains the particle.
        columns: [5, y, x, z], derivatives with respect to the unknowns of the particle. The first one is the particle
            with a gain of 1.
        laplacian: negative Laplacian of the particle.
    """

    box: tuple[slice, slice, slice]
    columns: F32
    laplacian: F32


def patch_of(body: Body, gain: float, scale: float, position: F64, rotation: F64, shape: Sequence[int]) -> Patch | None:
    """The particle in a state, on the voxels of a volume of this shape (y, x, z). None: the particle lies outside."""
    half_size = np.array(body.spline.shape) / 2
    reach = scale * (np.abs(rotation) @ half_size) + 1
    middle = position + scale * rotation @ (body.first + half_size - 0.5 - body.centre)
    low = np.maximum(np.floor(middle - reach).astype(int), 0)
    high = np.minimum(np.ceil(middle + reach).astype(int) + 1, shape)
    if (high - low < 1).any():
        return None
    wide_low, wide = low - 1, high - low + 2  # one more voxel on each side, for the slopes
    matrix = rotation.T / scale
    offset = body.centre - body.first + matrix @ (wide_low - position)
    wider = ndimage.affine_transform(
        body.spline, matrix, offset, tuple(wide), order=3, mode="constant", prefilter=False
    )
    particle = wider[1:-1, 1:-1, 1:-1]
    slopes = np.stack([
        (np.roll(wider, -1, axis) - np.roll(wider, 1, axis))[1:-1, 1:-1, 1:-1] / 2 for axis in range(3)
    ])  # fmt: skip
    laplacian = 6 * particle - sum(np.roll(wider, s, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for s in (-1, 1))
    distances = [(np.arange(a, b) - c).reshape([-1 if i == axis else 1 for i in range(3)])
          for axis, (a, b, c) in enumerate(zip(low, high, position, strict=True))]  # fmt: skip
    growth = -sum(distance * slope for distance, slope in zip(distances, slopes, strict=True)) / scale
    columns = np.concatenate((particle[None], gain * growth[None], -gain * slopes)).astype(np.float32)
    box = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    return Patch((box[0], box[1], box[2]), columns, laplacian.astype(np.float32))


@dataclass(frozen=True, eq=False)
class StateViews:
    """The projections of a state.

    Attributes:
        projector: projector of the volume [y, x, z] of the state; its lines are [view, col, row].
        lines: line integrals.
        weight: weight of each ray; 0: the ray is not used.
        rest: [y, x, z], everything that is not a particle, at its position in this state.
        smooth: the same without noise; its gain is an unknown.
        known: [z], True for slices that the projections show and the reference contains.
    """

    projector: Projector
    lines: F32
    weight: F32
    rest: F32
    smooth: F32
    known: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int, int]:
        z, y, x = self.projector.grid.shape
        return y, x, z

    def subset(self, views: NDArray[np.integer]) -> StateViews:
        return replace(self, projector=self.projector.subset(views), lines=self.lines[views], weight=self.weight[views])


@dataclass(frozen=True, eq=False)
class Linear:
    """The linear problem around an estimate. The unknowns are [particle, 5], then the changes of `rest` and `sharper`.

    Attributes:
        patches: the particles in the state; None for a particle outside.
        residual: projections minus the projections of the estimate.
        blocks: [particle, 5, 5], approximate normal matrix of each particle without the others.
    """

    views: StateViews
    bodies: Sequence[Body]
    now: ParticleEstimate
    patches: list[Patch | None]
    residual: F32
    blocks: F64
    others: F64
    prior: F64

    @classmethod
    def of(cls, views: StateViews, bodies: Sequence[Body], now: ParticleEstimate) -> Linear:
        patches = [
            patch_of(body, g, s, c, now.rotation, views.shape)
            for body, g, s, c in zip(bodies, now.gain, now.scale, now.position, strict=True)
        ]
        volume = views.rest + np.float32(now.rest) * views.smooth
        for patch, gain in zip(patches, now.gain, strict=True):
            if patch is not None:
                volume[patch.box] += np.float32(gain) * (patch.columns[0] + np.float32(now.sharper) * patch.laplacian)
        residual = views.lines - views.projector.forward_lines(volume)
        mean = float(views.weight[views.weight > 0].mean()) * views.projector.geometry.n_views
        edge = views.projector.grid.voxel_size
        blocks = np.stack([
            np.eye(UNKNOWNS)
            if patch is None or not views.known[patch.box[2]].any()
            else mean * edge**2 * gram(patch.columns[..., views.known[patch.box[2]]])
            for patch in patches
        ])  # fmt: skip
        noise = float((views.weight * residual**2).sum() / max(views.weight.sum(), 1e-30)) * float(views.weight.mean())
        prior = noise / np.square(_PRIOR)
        linear = cls(views, bodies, now, patches, residual, blocks, np.ones(2), prior)
        units = []
        for k in range(2):
            rays = views.projector.forward_lines(linear._volume(np.zeros((len(patches), UNKNOWNS)), np.eye(2)[k]))
            units.append(float((views.weight * rays**2).sum(dtype=np.float64)))
        return replace(linear, others=np.maximum(units, 1e-30))

    def _volume(self, theta: F64, others: F64) -> F32:
        volume = np.float32(others[0]) * self.views.smooth
        for patch, of_one, gain in zip(self.patches, theta.astype(np.float32), self.now.gain, strict=True):
            if patch is not None:
                volume[patch.box] += np.tensordot(of_one, patch.columns, 1)
                if others[1]:
                    volume[patch.box] += np.float32(gain * others[1]) * patch.laplacian
        return volume

    def back(self, rays: F32) -> F64:
        """The inner product of each column of the problem with rays."""
        volume = self.views.projector.adjoint_lines(rays)
        theta, sharper = np.zeros((len(self.patches), UNKNOWNS)), 0.0
        for k, patch in enumerate(self.patches):
            if patch is not None:
                part = np.ascontiguousarray(volume[patch.box])
                theta[k] = patch.columns.reshape(UNKNOWNS, -1) @ part.ravel()
                sharper += self.now.gain[k] * float(np.vdot(patch.laplacian, part))
        return np.concatenate((theta.ravel(), [float(np.vdot(self.views.smooth, volume)), sharper]))

    def normal(self, v: F64) -> F64:
        theta = v[:-2].reshape(-1, UNKNOWNS)
        rays = self.views.projector.forward_lines(self._volume(theta, v[-2:]))
        out = self.back(rays * self.views.weight)
        out[:-2] += (self.prior * theta).ravel()
        return out

    @property
    def seen(self) -> F64:
        """[particle] share of the particle that lies in slices that the projections show."""
        return np.array([
            0.0 if patch is None else float(np.square(patch.columns[0][..., self.views.known[patch.box[2]]]).sum())
            / (scale**3 * body.squares)
            for patch, scale, body in zip(self.patches, self.now.scale, self.bodies, strict=True)
        ])  # fmt: skip

    def solved(self, rays: F32, iterations: int) -> F64:
        """The unknowns that explain the rays best."""
        inverse = np.linalg.inv(self.blocks + self.prior * np.eye(UNKNOWNS))

        def scaled(r: F64) -> F64:
            theta = np.einsum("kij,kj->ki", inverse, r[:-2].reshape(-1, UNKNOWNS))
            return np.concatenate((theta.ravel(), r[-2:] / self.others))

        return conjugate(self.normal, self.back(rays * self.views.weight), scaled, iterations)

    def noise_by_halves(self, typical: NDArray[np.bool_]) -> F64:
        """[particle, 6] standard deviations of what `MEASURED` lists.

        A standard deviation is first computed for the particle without the others. It is then multiplied by a factor
        for each unknown: how much larger the differences between the results from both halves of the projections are,
        over all `typical` particles.
        """
        angles = self.views.projector.geometry
        order = np.argsort(np.mod(angles.angles, angles.period), kind="stable")
        halves = []
        for k in (0, 1):
            views_of_half = np.sort(order[k::2])
            half = replace(
                self, views=self.views.subset(views_of_half), residual=self.residual[views_of_half],
                blocks=self.blocks / 2, others=self.others / 2, prior=self.prior / 2,
            )  # fmt: skip
            halves.append(half.solved(half.residual, _HALVES)[:-2].reshape(-1, UNKNOWNS) @ MEASURED.T)
        noise = float((self.views.weight * self.residual**2).sum() / max(self.views.weight.sum(), 1e-30))
        inverse = np.linalg.inv(self.blocks + self.prior * np.eye(UNKNOWNS))
        alone = np.sqrt(noise * np.einsum("mi,kij,mj->km", MEASURED, inverse, MEASURED))
        ratio = np.abs(halves[0] - halves[1]) / 2 / alone
        typical = typical & (self.seen > _SOLID)
        return alone * np.sqrt(np.square(ratio[typical]).mean(0)) if typical.any() else alone


def gram(columns: F32) -> F64:
    """[5, 5] inner products of the projections of the columns, a mean over angles, in voxels of edge 1.

    The mean over all angles of the products of projections equals an inner product in Fourier space with the weight 1 /
    (π |k|).
    """
    n = tuple(fft.next_fast_len(2 * size) for size in columns.shape[1:3])
    spectrum = fft.rfft2(columns, n, (1, 2))
    ky, kx = fft.fftfreq(n[0])[:, None], fft.rfftfreq(n[1])
    k = np.hypot(ky, kx)
    k[0, 0] = 1 / (2 * math.log(1 + math.sqrt(2)) * (n[0] + n[1]))  # mean of 1/|k| over the frequency cell at 0
    twice = np.where((kx > 0) & ~((n[1] % 2 == 0) & (kx == 0.5)), 2.0, 1.0)
    flat = (spectrum * np.sqrt(twice / (np.pi * k * n[0] * n[1]))[None, :, :, None]).reshape(len(columns), -1)
    return np.real(flat @ flat.conj().T)


def improved_rounds(
    views: StateViews, bodies: Sequence[Body], now: ParticleEstimate, iterations: Sequence[int]
) -> ParticleEstimate:
    """The estimate after Gauss-Newton rounds. `iterations` has the number of iterations of each round."""
    for each in iterations:
        linear = Linear.of(views, bodies, now)
        step = linear.solved(linear.residual, each)
        theta = np.clip(step[:-2].reshape(-1, UNKNOWNS), -np.array(_LARGEST_STEPS), _LARGEST_STEPS)
        theta[[patch is None for patch in linear.patches]] = 0
        now = replace(
            now, gain=np.maximum(now.gain + theta[:, 0], 0), scale=np.clip(now.scale + theta[:, 1], 0.5, 2),
            position=now.position + theta[:, 2:], rest=now.rest + step[-2], sharper=now.sharper + step[-1],
        )  # fmt: skip
    return now


def inside_of(views: StateViews, bodies: Sequence[Body], now: ParticleEstimate, which: NDArray[np.bool_]) -> F32:
    """[y, x, z] 1 inside these particles, 0 elsewhere."""
    mask = np.zeros(views.shape, np.float32)
    for k in np.flatnonzero(which).tolist():
        patch = patch_of(bodies[k], 1.0, now.scale[k], now.position[k], now.rotation, views.shape)
        if patch is not None:
            mask[patch.box] = np.maximum(mask[patch.box], patch.columns[0] > _SOLID * bodies[k].level)
    return mask


def unexplained(views: StateViews, bodies: Sequence[Body], now: ParticleEstimate, mask: F32) -> F32:
    """[y, x, z] the part inside the mask that the shapes of the particles do not explain. For cracked particles it is
    the crack.

    It is subtracted so that it does not disturb the fit of the other particles. It is orthogonal to the unknowns of its
    own particle.
    """
    residual, weight = Linear.of(views, bodies, now).residual, views.weight

    def back(rays: F32) -> F64:
        return (mask * views.projector.adjoint_lines(rays * weight)).ravel().astype(np.float64)

    def normal(v: F64) -> F64:
        return back(views.projector.forward_lines(mask * v.reshape(mask.shape).astype(np.float32)))

    crack = conjugate(normal, back(residual), lambda r: r, _CRACK)
    return mask * crack.reshape(mask.shape).astype(np.float32)
