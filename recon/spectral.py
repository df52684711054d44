"""One fit of several energies: the density of each material, from views that each see one energy.

The attenuation at an energy is a sum over materials with known cross sections. So no energy needs a full set of views:
all views of all energies determine the few volumes of the materials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.kernels.cpu.mixtures import nonnegative_mix
from recon.kernels.cpu.vectors import combine
from recon.voxels.held_out_weight import ONE_IN, busiest_rows, slab_of
from recon.voxels.motion import Motion, moved, moved_back
from recon.voxels.ordered_fista import subsets_of
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.tv import TotalVariationProx, difference_weights
from recon.voxels.voxel_problem import Momentum, largest_eigenvalue

_SUBSETS, _TV_STEPS = 9, 3
_ROWS, _TRIAL_SWEEPS = 16, 8  # of a trial of weights, which begins with the volumes of the last one
_FIRST = 0.1  # the first weight, over the largest gradient at zero
_ALIKE_LONGER = 3  # times the sweeps: volumes of times differ by more than materials of energies
_TRIALS = 12  # of one weight for all components, each half of the last one
_HEAVIER = 4  # trials of a heavier one for all but the first component, each twice the last one
_ROUNDS = 6  # of power iteration
_AS_WELL = 1.01  # weights that leave so much of the least residual predict as well
_LEAST_SINGULAR = 1e-4  # of the largest singular value: less, and energies do not tell materials apart
_NOTHING = 1e-20  # singular value of materials that attenuate nothing
TRIAL_SWEEPS = (_TRIALS + _HEAVIER) * _TRIAL_SWEEPS  # of all trials, at most


@dataclass(frozen=True, eq=False)
class EnergyViews:
    """Views of one sample at several energies, and what materials attenuate there.

    Attributes:
        projections: line integrals, float32 [view, row, col], finite.
        geometry: of all views.
        energy: [view], index of the energy of each view.
        cross_sections: float64 [energy, material], attenuation of each material at density 1, such as 1/mm.
        weight: of each ray [view, row, col]; None: one.

    Raises:
        ValueError: shapes or indices do not fit, values are not finite, or the energies do not tell materials apart.
    """

    projections: F32
    geometry: Geometry
    energy: NDArray[np.intp]
    cross_sections: F64
    weight: F32 | None = None

    def __post_init__(self) -> None:
        wanted = (self.geometry.n_views, *self.geometry.detector_shape)
        for name, array in (("projections", self.projections), ("weight", self.weight)):
            if array is not None and array.shape != wanted:
                raise ValueError(f"{name} must have the geometry's shape {wanted}, got {array.shape}")
        if not np.isfinite(self.projections).all():
            raise ValueError("projections must be finite: give rays that were not measured the weight 0 and any value")
        n, materials = self.cross_sections.shape
        if self.energy.shape != wanted[:1] or self.energy.min() < 0 or self.energy.max() >= n:
            raise ValueError(f"energy must be an index 0 ... {n - 1} for each of {wanted[0]} views")
        seen = self.cross_sections[np.unique(self.energy)]
        if not np.isfinite(seen).all():
            raise ValueError("cross_sections must be finite")
        values = np.linalg.svd(seen, compute_uv=False)
        if len(seen) < materials or values[-1] <= max(_LEAST_SINGULAR * values[0], _NOTHING):
            raise ValueError(
                f"views of {len(seen)} energies do not tell {materials} materials apart: give more energies, or fewer "
                "materials"
            )

    def select(self, views: NDArray[np.intp], rows: slice) -> EnergyViews:
        """Some views, and neighbouring rows of them."""
        first, stop, _ = rows.indices(self.projections.shape[1])
        weight = None if self.weight is None else self.weight[views, rows]
        geometry = self.geometry.select(views).rows(first, stop)
        return EnergyViews(self.projections[views, rows], geometry, self.energy[views], self.cross_sections, weight)

    def parted(self, n: int) -> NDArray[np.intp]:
        """The part 0 ... n - 1 of each view: each part sees all energies, and directions all around."""
        part, energies = np.empty(self.geometry.n_views, np.intp), len(self.cross_sections)
        angles = np.mod(self.geometry.angles, self.geometry.period)
        for energy in range(energies):
            own = np.flatnonzero(self.energy == energy)
            part[own[np.argsort(angles[own], kind="stable")]] = (energy * n // energies + np.arange(own.size)) % n
        return part


@dataclass(frozen=True, eq=False)
class Materials:
    """Densities of materials.

    Attributes:
        densities: float32 [material, z, y, x], in the unit of the cross sections' densities. 0 or more.
        grid: of each volume.
        weights: of total variation, one for each component (see `fit_materials`).
        residual: norm of what the volumes leave of the views, over the norm of the views.
    """

    densities: F32
    grid: Grid
    weights: F64
    residual: float

    def share(self, of: int, others: Sequence[int], least: float) -> F32:
        """The share [z, y, x] of a material in the density of itself and others, 0 ... 1, such as a state of charge.

        Args:
            least: summed density below which there is nothing to take a share of: NaN there.
        """
        part = self.densities[of]
        total = part + self.densities[list(others)].sum(0)
        return np.where(total >= least, np.clip(part / np.maximum(total, least), 0, 1), np.float32(np.nan))


def fit_materials(
    views: EnergyViews,
    grid: Grid | None = None,
    *,
    tv_weight: float | None = None,
    sweeps: int = 20,
    seed: int = 0,
    go_on: Callable[[int, float], bool] = lambda sweep, residual: True,
) -> Materials:
    """The densities that explain the views of all energies in one least-squares fit with total variation.

        min over z of ½ Σ_v |A_v Σ_k U[e(v), k] z_k - p_v|² + Σ_k μ_k TV(z_k),    densities >= 0

    U S Vᵀ is the singular value decomposition of the cross sections (each energy counted by its views). The densities
    are V S⁻¹ z. The columns of U are orthonormal, so noise is the same in all components z_k, and the fit is as well
    conditioned as that of one energy. A sweep costs as much as one over the same views at one energy. Steps are those
    of `ordered_fista`; densities below 0 are clipped after each of them. (Long & Fessler 2014, IEEE Trans. Med. Imaging
    33, 1614, fit materials to spectra in one step, too.)
    Memory: seven volumes a material, three times the projections.

    Args:
        grid: of the volumes; None: as the geometry has it.
        tv_weight: of all components; None: the weights with which views held out are predicted best.
        sweeps: of about nine steps each, which see all views equally often.
        go_on: called with (sweep, residual) after each sweep, and with (0, residual) after each sweep of a trial of
            weights. These are `TRIAL_SWEEPS` at most. False ends the fit, with the volumes so far.
    """
    grid = grid or Grid.matching(views.geometry)
    n = views.cross_sections.shape[1]
    weights = weights_by_views(views, grid, seed, go_on) if tv_weight is None else np.full(n, tv_weight)
    fit = EnergyFit(views, grid, np.random.default_rng(seed))
    densities, residual = fitted(fit, weights, sweeps, go_on)
    return Materials(densities, grid, weights, residual)


def fitted(fit: EnergyFit, weights: F64, sweeps: int, go_on: Callable[[int, float], bool]) -> tuple[F32, float]:
    """Densities and residual after so many sweeps, or when `go_on` ends them."""
    residual = 1.0
    for sweep, residual in enumerate(fit.sweeps(weights, sweeps), 1):
        if not go_on(sweep, residual):
            break
    return fit.densities(), residual


class _Part(NamedTuple):
    """Views of one energy in one subset: data and weight as lines [view, col, row]."""

    energy: int
    projector: Projector
    data: F32
    weight: F32 | None


@dataclass(eq=False)
class EnergyFit:
    """The volumes of `fit_materials`, and its steps.

    Attributes:
        motion: of the volume at each energy; None: it does not move.
        z: float32 [component, y, x, z].
        subsets: of the views; each has all energies.
        _to, _back: from densities to components, and back.
        _u: U [energy, component].
        step: 1 / L. L bounds the curvature of a subset: the largest eigenvalue of AᵀWA where a view of energy e weighs
            |U[e]|². That is a bound since A has no negative entry, so |A Σ U z| <= |U| A |z|.
    """

    views: EnergyViews
    grid: Grid
    rng: np.random.Generator
    motion: Motion | None = None
    z: F32 = field(init=False)
    subsets: list[list[_Part]] = field(init=False)
    step: float = field(init=False)

    def __post_init__(self) -> None:
        views = self.views
        counts = np.bincount(views.energy, minlength=len(views.cross_sections))
        seen = np.sqrt(counts / counts.max())[:, None]
        u, values, mix = np.linalg.svd(seen * views.cross_sections, full_matrices=False)
        self._to = values[:, None] * mix
        self._back = mix.T / values
        self._u = np.divide(u, seen, out=np.zeros_like(u), where=seen > 0)
        whole, data = Projector(views.geometry, self.grid), projection_lines(views.projections)
        weight = np.ones_like(data) if views.weight is None else projection_lines(views.weight)
        self._norm = math.sqrt(float(np.vdot(data, weight * data))) or 1.0  # views of nothing leave nothing
        subset = views.parted(subsets_of(views.geometry, _SUBSETS))
        self.subsets = []
        for number in range(subset.max() + 1):
            own = [np.flatnonzero((subset == number) & (views.energy == e)) for e in range(counts.size)]
            self.subsets.append(
                [
                    _Part(e, whole.subset(at), data[at], None if views.weight is None else weight[at])
                    for e, at in enumerate(own)
                    if at.size
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
        """Let the volume move so from here on."""
        self.motion = motion
        self.step = 1 / self._curvature(max(self.subsets, key=lambda subset: sum(len(part.data) for part in subset)))

    def _curvature(self, subset: list[_Part]) -> float:
        """As `largest_eigenvalue`, of a volume that moves."""
        x, bound = np.ones(self.z.shape[1:], np.float32), math.inf
        for _ in range(_ROUNDS):
            product = np.zeros_like(x)
            for part in subset:
                u = None if self.motion is None else self.motion.at(part.energy)
                lines = part.projector.forward_lines(moved(x, u))
                lines *= np.float32((self._u[part.energy] ** 2).sum())
                product += moved_back(part.projector.adjoint_lines(_weighed(lines, part)), u)
            bound = min(bound, float(np.divide(product, x, out=np.zeros_like(x), where=x > 0).max()))
            x = product / product.max()
        return bound

    def image(self, energy: int) -> F32:
        """The volume [y, x, z] at an energy, before it moves."""
        return np.tensordot(self._u[energy].astype(np.float32), self.z, 1)

    def descent(self, subset: list[_Part], out: F32) -> float:
        """Minus the gradient of the views of a subset at z, into `out`. Returns their weighed sum of squares."""
        out[...] = 0
        squares, image = 0.0, np.empty(self.z.shape[1:], np.float32)
        for part in subset:
            image[...] = 0
            for share, component in zip(self._u[part.energy], self.z, strict=True):
                combine(1.0, image, float(share), component, image)
            u = None if self.motion is None else self.motion.at(part.energy)
            residual = part.data - part.projector.forward_lines(moved(image, u))
            weighted = _weighed(residual, part)
            squares += float(np.vdot(residual, weighted))
            back = moved_back(part.projector.adjoint_lines(weighted, image), u)
            for share, component in zip(self._u[part.energy], out, strict=True):
                combine(1.0, component, float(share), back, component)
        return squares

    def sweeps(self, weights: F64, n: int) -> Iterator[float]:
        """n times about nine steps from z, which see all views equally often; gives the residual of each nine."""
        _, ny, nx, nz = self.z.shape
        differences, count = difference_weights(self.grid), len(self.subsets)
        prox = [TotalVariationProx((ny, nx, nz), differences, False, _TV_STEPS) for _ in self.z]
        ahead, descent = Momentum(self.z, Decisions()), np.empty_like(self.z)
        for sweep in range(n):
            squares = 0.0
            order = [number for _ in range(_SUBSETS // count) for number in self.rng.permutation(count)]
            for at, number in enumerate(order):
                squares += self.descent(self.subsets[number], descent)
                combine(1.0, self.z, self.step, descent, self.z)
                for component, near, weight in zip(self.z, prox, weights, strict=True):
                    near(component, float(weight) * self.step / count)
                    near.turn()
                nonnegative_mix(self.z, self._back, self._to)
                if at + 1 < len(order):
                    ahead(self.z)
            yield math.sqrt(squares * count / len(order)) / self._norm
            if sweep + 1 < n:
                ahead(self.z)

    def residual_of(self, densities: F32) -> float:
        """What densities [material, z, y, x] leave of all views, over the norm of the views."""
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
        """[material, z, y, x]."""
        return np.ascontiguousarray(np.einsum("mk,kyxz->mzyx", self._back.astype(np.float32), self.z))


def _weighed(lines: F32, part: _Part) -> F32:
    return lines if part.weight is None else part.weight * lines


def weights_by_views(
    views: EnergyViews, grid: Grid, seed: int, go_on: Callable[[int, float], bool], *, alike: bool = False
) -> F64:
    """Weights of total variation [component], by one view in eight held out.

    First one weight for all components, halved until it predicts worse. The first component, which holds what energies
    have in common, keeps the best one. The others hold differences: less structure, and the same noise. So they get the
    heaviest weight that predicts within 1 % of the best.

    Args:
        alike: all components keep one weight.
    """
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    rows = slice(None)
    if views.geometry.rows_show_slices:
        rows = busiest_rows(views.projections, _ROWS)
        grid = slab_of(views.geometry, grid, *rows.indices(views.projections.shape[1])[:2])[1]
    fit, judge = (
        EnergyFit(views.select(np.flatnonzero(chosen), rows), grid, np.random.default_rng(seed))
        for chosen in (~held_out, held_out)
    )

    going = True

    def left(weights: F64) -> float:
        nonlocal going
        for residual in fit.sweeps(weights, (_ALIKE_LONGER if alike else 1) * _TRIAL_SWEEPS):
            if not (going := go_on(0, residual)):
                return math.inf
        return judge.residual_of(fit.densities())  # not z: an energy's share of the views is another one here

    weights = np.full(len(fit.z), _FIRST * fit.steepest())
    best, least, worse = weights, math.inf, 0
    for _ in range(_TRIALS):
        now = left(weights)
        if not going:
            return best
        best, least, worse = (weights, now, 0) if now < least else (best, least, worse + 1)
        if worse == 2:
            break
        weights = weights / 2
    heavier = np.r_[2.0 if alike else 1.0, np.full(len(weights) - 1, 2.0)]
    ladder = [best * heavier**octave for octave in range(_HEAVIER)]
    residuals: list[float] = []
    for weights in ladder:
        residuals.append(left(weights))
        if not going:
            return best
    limit = _AS_WELL * min(residuals)
    return next(at for at, now in zip(ladder[::-1], residuals[::-1], strict=True) if now <= limit)
