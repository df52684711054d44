"""The share of one of two materials in their sum, smooth within matter, from views of several energies.

Two states of one material, such as a fresh and a charged oxide, differ little in what they attenuate. So their sum f is
known well, and the share s of the second one is not. Then s is fitted to the views with f held, by least squares:

    min over s of ½ Σ_v w_v |A_v f s d_e(v) - q_v|² + λ/2 Σ_ij f_i f_j (s_i - s_j)²

d_e is the second cross section less the first, q what the views hold beyond a volume without the second, and i, j are
neighbours. Where there is no matter, nothing is smoothed across, so grains that do not touch keep their own shares.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.energy_fit import EnergyViews
from recon.spectral import Materials
from recon.voxels.held_out_weight import ONE_IN, busiest_rows, slab_of
from recon.voxels.projector import Projector, projection_lines, volume_lines, volume_slices

_HEAVIEST, _OCTAVES = 32.0, 12  # of λ, over the mean curvature of the first term
_STEPS, _TRIAL_STEPS = 60, 20  # of conjugate gradients
_ROWS = 16  # of trials
STEPS = _STEPS + _OCTAVES * _TRIAL_STEPS
"""Steps of `fit_share` and its trials, at most."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Arrays of lines: volumes [y, x, z], views [view, col, row].

    Attributes:
        matter: f.
        data: q.
        difference: d of each view.
        weight: w.
    """

    projector: Projector
    matter: F32
    data: F32
    difference: F32
    weight: F32

    @classmethod
    def of(cls, views: EnergyViews, densities: F32, states: tuple[int, int], grid: Grid) -> _Problem:
        """Each ray weighs as many photons as the densities let through, which is one over the variance of its noise."""
        projector, matter = Projector(views.geometry, grid), volume_lines(densities[list(states)].sum(0))
        sections = views.cross_sections[views.energy].astype(np.float32)[:, :, None, None]
        data = projection_lines(views.projections)
        depth = np.zeros_like(data)
        for material, density in enumerate(densities):
            seen = projector.forward_lines(volume_lines(density))
            depth += sections[:, material] * seen
            data = data - sections[:, states[0] if material in states else material] * seen
        weight = np.exp(-depth)
        if views.weight is not None:
            weight[projection_lines(views.weight) == 0] = 0
        return cls(projector, matter, data, sections[:, states[1]] - sections[:, states[0]], weight)

    def select(self, views: NDArray[np.intp]) -> _Problem:
        return _Problem(
            self.projector.subset(views), self.matter, self.data[views], self.difference[views], self.weight[views]
        )

    def explained(self, lines: F32) -> F32:
        """f Aᵀ w d of lines: the transpose of what shares show, weighed."""
        return self.matter * self.projector.adjoint_lines(self.weight * self.difference * lines)

    def shown(self, share: F32) -> F32:
        """d A f s."""
        return self.difference * self.projector.forward_lines(self.matter * share)

    def even(self) -> F32:
        """One share for all matter, the best in the mean of the views."""
        one = self.explained(self.shown(np.ones_like(self.matter)))
        mean = float(self.explained(self.data).sum(dtype=np.float64)) / max(float(one.sum(dtype=np.float64)), 1e-30)
        return np.full_like(self.matter, np.clip(mean, 0, 1))

    def left(self, share: F32) -> float:
        """Weighed squares that shares leave."""
        residual = self.data - self.shown(share)
        return float(np.vdot(residual, self.weight * residual))

    def rough(self, share: F32) -> F32:
        """Gradient of ½ Σ_ij f_i f_j (s_i - s_j)²."""
        out = np.zeros_like(share)
        for axis in range(3):
            low, high = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
            flow = self.matter[low] * self.matter[high] * (share[high] - share[low])
            out[low] -= flow
            out[high] += flow
        return out

    def solved(self, smooth: float, share: F32, steps: int, go_on: Callable[[], bool]) -> F32:
        """Conjugate gradients (Hestenes & Stiefel 1952) from a first share; λ is `smooth` times the mean curvature."""
        mean = float(np.vdot(self.explained(self.shown(np.ones_like(share))), self.matter))
        weight = np.float32(smooth * mean / max(float(np.vdot(self.matter, self.matter)), 1e-30))

        def normal(of: F32) -> F32:
            return self.explained(self.shown(of)) + weight * self.rough(of)

        found = share.copy()
        left = self.explained(self.data) - normal(found)
        towards, squares = left.copy(), float(np.vdot(left, left))
        for _ in range(steps):
            if squares == 0 or not go_on():
                break
            image = normal(towards)
            length = np.float32(squares / float(np.vdot(towards, image)))
            found += length * towards
            left -= length * image
            before, squares = squares, float(np.vdot(left, left))
            towards = left + np.float32(squares / before) * towards
        return found


def fit_share(
    views: EnergyViews,
    found: Materials,
    states: tuple[int, int],
    go_on: Callable[[int], bool] = lambda left: True,
) -> Materials:
    """Densities of two states of one material anew: the same sum, with the share of each smooth within matter.

    λ is the one with which views held out, one in eight of some rows, are predicted best: halved from a heavy one until
    it predicts worse twice. Memory: ten volumes, six times the projections.

    Args:
        found: of `fit_materials`, from the same views.
        states: indices of the two materials.
        go_on: called before each of `STEPS` steps at most, with how many may follow. False ends it with the share so
            far.

    Raises:
        ValueError: states that are no two materials.
    """
    count = len(found.densities)
    if len(set(states)) != 2 or not set(states) <= set(range(count)):
        raise ValueError(f"states must be two of the materials 0 ... {count - 1}, got {states}")
    steps = _Steps(go_on)
    smooth = _smoothness(views, found, states, steps)
    steps.left = _STEPS
    problem = _Problem.of(views, found.densities, states, found.grid)
    share = np.clip(volume_slices(problem.solved(smooth, problem.even(), _STEPS, steps)), 0, 1)
    densities, total = found.densities.copy(), found.densities[list(states)].sum(0)
    densities[states[0]], densities[states[1]] = total * (1 - share), total * share
    return replace(found, densities=densities)


@dataclass
class _Steps:
    """Counts steps down, and remembers that they were ended."""

    go_on: Callable[[int], bool]
    left: int = STEPS
    going: bool = True

    def __call__(self) -> bool:
        self.left -= 1
        self.going = self.going and self.go_on(self.left)
        return self.going


def _smoothness(views: EnergyViews, found: Materials, states: tuple[int, int], steps: _Steps) -> float:
    """λ over the mean curvature, by views held out."""
    densities, grid, rows = found.densities, found.grid, slice(None)
    n_rows = views.geometry.detector_shape[0]
    if views.geometry.rows_show_slices and grid.shape[0] == n_rows:
        rows = busiest_rows(views.projections, _ROWS)
        first, stop, _ = rows.indices(n_rows)
        densities, grid = densities[:, rows], slab_of(views.geometry, grid, first, stop)[1]
    problem = _Problem.of(views.select(np.arange(views.geometry.n_views), rows), densities, states, grid)
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    fit, judge = problem.select(np.flatnonzero(~held_out)), problem.select(np.flatnonzero(held_out))
    share, best, least, worse = problem.even(), _HEAVIEST, math.inf, 0
    for smooth in _HEAVIEST / 2.0 ** np.arange(_OCTAVES):
        share = fit.solved(float(smooth), share, _TRIAL_STEPS, steps)
        left = judge.left(share)
        if not steps.going:
            break
        best, least, worse = (float(smooth), left, 0) if left < least else (best, least, worse + 1)
        if worse == 2:
            break
    return best
