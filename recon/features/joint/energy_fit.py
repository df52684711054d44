"""The steps of the joint fits in `spectral` and `series`. Each projection shows a weighted sum of volumes, with its own
weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry, require_views
from recon.base.volume import Grid
from recon.features.joint.motion import Motion, moved, moved_back, weighed
from recon.kernels.cpu.mixtures import nonnegative_mix
from recon.kernels.cpu.vectors import combine
from recon.voxels.field_edges import busiest_rows, slab_of
from recon.voxels.ordered_fista import subsets_of
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.voxel_problem import Momentum, TotalVariationProx, difference_weights, largest_eigenvalue

_SUBSETS, _TV_STEPS = 9, 3
_ROUNDS = 6  # number of power iterations
# the energies do not separate the materials if a singular value is below this share of the largest one
_LEAST_SINGULAR = 1e-4
_ZERO_SINGULAR = 1e-20  # largest singular value that counts as zero: the materials do not attenuate


def refuse_alike(cross_sections: F64) -> None:
    """Raise ValueError if cross sections [energy, material] are not finite or cannot separate the materials."""
    n, materials = cross_sections.shape
    if not np.isfinite(cross_sections).all():
        raise ValueError("cross_sections must be finite")
    values = np.linalg.svd(cross_sections, compute_uv=False)
    if n < materials or values[-1] <= max(_LEAST_SINGULAR * values[0], _ZERO_SINGULAR):
        raise ValueError(
            f"cannot separate {materials} materials with {n} {'energy' if n == 1 else 'energies'}: use more energies, "
            "energies at which the materials differ more, or fewer materials"
        )


@dataclass(frozen=True, eq=False)
class EnergyViews:
    """Projections of one sample at several energies. A projection shows each material with its attenuation at the
    energy of the projection.

    A series of volumes in time has the same mathematical form: points in time replace the energies, and the volumes
    replace the materials.

    Attributes:
        projections: line integrals, float32 [view, row, col], finite.
        geometry: geometry of all projections.
        energy: [view], index of the energy of each projection.
        cross_sections: float64 [energy, material], attenuation of each material at density 1, for example in 1/mm.
        weight: weight of each ray [view, row, col]; None: 1.

    Raises:
        ValueError: shapes or indices do not match, values are not finite, or the energies do not separate the
            materials.
    """

    projections: F32
    geometry: Geometry
    energy: NDArray[np.intp]
    cross_sections: F64
    weight: F32 | None = None

    def __post_init__(self) -> None:
        check_settings(self)
        require_views(self.geometry, self.projections)
        if self.weight is not None:
            require_views(self.geometry, self.weight, "weights")
        if not np.isfinite(self.projections).all():
            raise ValueError(
                "projections must be finite. Give rays that were not measured any finite value and the weight 0"
            )
        if self.cross_sections.ndim != 2:
            raise ValueError(f"cross_sections must be [energy, material], got shape {self.cross_sections.shape}")
        n = len(self.cross_sections)
        views = self.geometry.n_views
        if self.energy.shape != (views,) or self.energy.min() < 0 or self.energy.max() >= n:
            raise ValueError(f"energy must be an index from 0 to {n - 1} for each of the {views} projections")
        refuse_alike(self.cross_sections[np.unique(self.energy)])

    def select(self, views: NDArray[np.intp], rows: slice) -> EnergyViews:
        """The data of the projections `views` and of the detector rows `rows` only."""
        first, stop, _ = rows.indices(self.projections.shape[1])
        weight = None if self.weight is None else self.weight[views, rows]
        geometry = self.geometry.select(views).rows(first, stop)
        return EnergyViews(self.projections[views, rows], geometry, self.energy[views], self.cross_sections, weight)

    def parted(self, n: int) -> NDArray[np.intp]:
        """Divide the projections into n parts, so that each part has projections of all energies and directions. Return
        for each projection the part it belongs to, from 0 to n - 1.

        If there are more energies than projections in a part, neighbouring energies are treated as one energy.
        """
        views, energies = self.geometry.n_views, len(self.cross_sections)
        groups = min(energies, max(n, views // n))
        part, group = np.empty(views, np.intp), self.energy * groups // energies
        angles = np.mod(self.geometry.angles, self.geometry.period)
        for number in range(groups):
            own = np.flatnonzero(group == number)
            part[own[np.argsort(angles[own], kind="stable")]] = (number * n // groups + np.arange(own.size)) % n
        return part


def trial_rows(views: EnergyViews, grid: Grid, height: int) -> tuple[slice, Grid]:
    """The rows with most material, for test reconstructions, and their slices. If a row does not show a single slice,
    all rows are returned."""
    if not views.geometry.rows_show_slices:
        return slice(None), grid
    rows = busiest_rows(views.projections, height)
    return rows, slab_of(views.geometry, grid, rows.start, rows.stop)[1]


class StoppedError(Exception):
    """The function `stop` interrupted a step."""


class _Part(NamedTuple):
    """Projections of one energy in one subset: data and weight as [view, col, row]."""

    energy: int
    projector: Projector
    data: F32
    weight: F32 | None


@dataclass(eq=False)
class EnergyFit:
    """The volumes of `fit_materials`, and the steps of the fit.

    Attributes:
        motion: motion of the volume at each energy; None: the volume does not move.
        z: float32 [component, y, x, z].
        subsets: subsets of the projections. Each subset contains all energies.
        _to, _back: conversion from densities to components and back.
        _u: U [energy, component].
        step: 1 / L. L is an upper bound on the curvature of a subset: the largest eigenvalue of AᵀWA, if a projection
            of energy e has the weight |U[e]|². L is a bound because A has no negative entry, so that |A Σ U z| <= |U| A
            |z|.
    """

    views: EnergyViews
    grid: Grid
    rng: np.random.Generator
    motion: Motion | None = None
    stop: Callable[[], bool] = lambda: False
    z: F32 = field(init=False)
    subsets: list[list[_Part]] = field(init=False)
    step: float = field(init=False)
    _begun: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        views = self.views
        counts = np.bincount(views.energy, minlength=len(views.cross_sections))
        root_counts = np.sqrt(counts / counts.max())[:, None]
        u, values, mix = np.linalg.svd(root_counts * views.cross_sections, full_matrices=False)
        self._to = values[:, None] * mix
        self._back = mix.T / values
        self._u = np.divide(u, root_counts, out=np.zeros_like(u), where=root_counts > 0)
        whole, data = Projector(views.geometry, self.grid), projection_lines(views.projections)
        weight = np.ones_like(data) if views.weight is None else projection_lines(views.weight)
        self._norm = (
            math.sqrt(float(np.vdot(data, weight * data))) or 1.0
        )  # if the projections are empty, the residual is 0
        subset = views.parted(subsets_of(views.geometry, _SUBSETS, to_the_end=False))
        self.subsets = []
        for number in range(subset.max() + 1):
            own = [np.flatnonzero((subset == number) & (views.energy == e)) for e in range(counts.size)]
            self.subsets.append(
                [
                    _Part(e, whole.subset(indices), data[indices], None if views.weight is None else weight[indices])
                    for e, indices in enumerate(own)
                    if indices.size
                ]
            )
        nz, ny, nx = self.grid.shape
        self.z = np.zeros((values.size, ny, nx, nz), np.float32)
        if self.motion is not None:
            self.move(self.motion)
            return
        largest = np.flatnonzero(subset == np.argmax(np.bincount(subset)))
        heights = (self._u**2).sum(1)[views.energy[largest]].astype(np.float32)
        self.step = 1 / largest_eigenvalue(whole.subset(largest), heights[:, None, None] * weight[largest])

    def move(self, motion: Motion) -> None:
        """Use this motion of the volume from now on."""
        self.motion = motion
        self.step = 1 / self._curvature(max(self.subsets, key=lambda subset: sum(len(part.data) for part in subset)))

    def _curvature(self, subset: list[_Part]) -> float:
        """The same as `largest_eigenvalue`, for a volume that moves."""
        x, bound = np.ones(self.z.shape[1:], np.float32), math.inf
        for _ in range(_ROUNDS):
            product = np.zeros_like(x)
            for part in subset:
                u = None if self.motion is None else self.motion.at(part.energy)
                lines = part.projector.forward_lines(moved(x, u))
                lines *= np.float32((self._u[part.energy] ** 2).sum())
                product += moved_back(part.projector.adjoint_lines(weighed(lines, part.weight)), u)
            bound = min(bound, float(np.divide(product, x, out=np.zeros_like(x), where=x > 0).max()))
            x = product / product.max()
        return bound

    def image(self, energy: int) -> F32:
        """The volume [y, x, z] at an energy, before it is displaced."""
        return np.tensordot(self._u[energy].astype(np.float32), self.z, 1)

    def descent(self, subset: list[_Part], out: F32) -> float:
        """Write the negative gradient of a subset at z to `out`. Return the weighted sum of squares of the residual of
        the subset.

        Raises:
            StoppedError: `stop` returned True.
        """
        out[...] = 0
        squares, image = 0.0, np.empty(self.z.shape[1:], np.float32)
        for part in subset:
            if self._begun and self.stop():
                raise StoppedError
            image[...] = 0
            for share, component in zip(self._u[part.energy], self.z, strict=True):
                combine(1.0, image, float(share), component, image)
            u = None if self.motion is None else self.motion.at(part.energy)
            residual = part.data - part.projector.forward_lines(moved(image, u))
            weighted = weighed(residual, part.weight)
            squares += float(np.vdot(residual, weighted))
            back = moved_back(part.projector.adjoint_lines(weighted, image), u)
            for share, component in zip(self._u[part.energy], out, strict=True):
                combine(1.0, component, float(share), back, component)
        return squares

    def sweeps(self, weights: F64, n: int) -> Iterator[float]:
        """Make n iterations, starting from z, and yield the residual of each. An iteration has about nine steps, which
        use all projections equally often.

        If a step is stopped, z stays as it was before this step.
        """
        _, ny, nx, nz = self.z.shape
        differences, count = difference_weights(self.grid), len(self.subsets)
        prox = [TotalVariationProx((ny, nx, nz), differences, False, _TV_STEPS) for _ in self.z]
        ahead, descent = Momentum(self.z, Decisions()), np.empty_like(self.z)
        for sweep in range(n):
            squares = 0.0
            order = [number for _ in range(_SUBSETS // count) for number in self.rng.permutation(count)]
            for step_number, number in enumerate(order):
                try:
                    squares += self.descent(self.subsets[number], descent)
                except StoppedError:
                    nonnegative_mix(self.z, self._back, self._to)  # momentum may have made values negative
                    return
                self._begun = True
                combine(1.0, self.z, self.step, descent, self.z)
                for component, near, weight in zip(self.z, prox, weights, strict=True):
                    near(component, float(weight) * self.step / count)
                    near.turn()
                nonnegative_mix(self.z, self._back, self._to)
                if step_number + 1 < len(order):
                    ahead(self.z)
            yield math.sqrt(squares * count / len(order)) / self._norm
            if sweep + 1 < n:
                ahead(self.z)

    def residual_of(self, densities: F32) -> float:
        """Norm of the residual for densities [material, z, y, x], divided by the norm of all projections."""
        self.z = np.ascontiguousarray(np.einsum("km,mzyx->kyxz", self._to.astype(np.float32), densities))
        out = np.empty_like(self.z)
        return math.sqrt(sum(self.descent(subset, out) for subset in self.subsets)) / self._norm

    def steepest(self) -> float:
        """The largest entry of the gradient at z."""
        out, total = np.empty_like(self.z), np.zeros_like(self.z)
        for subset in self.subsets:
            self.descent(subset, out)
            total += out
        return float(np.abs(total).max())

    def densities(self) -> F32:
        """The densities [material, z, y, x]."""
        return np.ascontiguousarray(np.einsum("mk,kyxz->mzyx", self._back.astype(np.float32), self.z))


def fitted(fit: EnergyFit, weights: F64, sweeps: int, go_on: Callable[[int, float], bool]) -> tuple[F32, float]:
    """Densities and residual after `sweeps` iterations, or earlier if `go_on` ends them."""
    residual = 1.0
    for sweep, residual in enumerate(fit.sweeps(weights, sweeps), 1):
        if not go_on(sweep, residual):
            break
    return fit.densities(), residual
