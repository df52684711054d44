"""The share of one of two states in their sum, smooth within matter, from views of several energies.

Two states of one material, such as a fresh and a charged oxide, differ little in what they attenuate. So their sum is
known well, and the share of the second one is not. With the sum held, that share is fitted to all views (see
module `proportions`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon.base.arrays import F32
from recon.base.declared_types import check_arguments
from recon.base.empirical import ONE_IN
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyViews
from recon.features.joint.proportions import SOLUTION_STEPS, TRIAL_STEPS, Countdown, Proportions, smoothness
from recon.features.joint.spectral import Materials
from recon.voxels.held_out import busiest_rows, slab_of
from recon.voxels.projector import Projector, projection_lines, volume_lines, volume_slices

_ROWS, _DEEPEST = 16, 7.0  # of trials; line integral from which on rays weigh alike
STEPS = TRIAL_STEPS + SOLUTION_STEPS


def fit_share(
    views: EnergyViews,
    found: Materials,
    states: tuple[int, int],
    go_on: Callable[[int], bool] = lambda left: True,
    stop: Callable[[], bool] = lambda: False,
) -> Materials:
    """Densities of two states of one material anew: the same sum, with the share of each smooth within matter.

    Views held out, one in eight of some rows, choose how smooth. Memory: ten volumes, six times the projections.

    Args:
        found: of `fit_materials`, from the same views.
        states: indices of the two materials.
        go_on: called before each of `STEPS` steps at most, with how many may follow. False ends it, with the densities
            found before.
        stop: asked many times within a step. True ends it likewise.

    Raises:
        ValueError: states that are no two materials.
    """
    check_arguments(fit_share, locals())
    count = len(found.densities)
    if len(set(states)) != 2 or not set(states) <= set(range(count)):
        raise ValueError(f"states must be two of the materials 0 ... {count - 1}, got {states}")
    steps = Countdown(go_on, STEPS, stop)
    smooth = _smoothness(views, found, states, steps)
    steps.left = min(steps.left, SOLUTION_STEPS)
    problem = share_problem(views, found.densities, states, found.grid)
    share = _even(problem)
    share = np.clip(volume_slices(replace(problem, stop=stop).solved(smooth, share, steps)[0]), 0, 1)
    if not steps.going or stop():
        return found
    densities, total = found.densities.copy(), found.densities[list(states)].sum(0)
    densities[states[0]], densities[states[1]] = total * (1 - share), total * share
    return replace(found, densities=densities)


def share_problem(views: EnergyViews, densities: F32, states: tuple[int, int], grid: Grid) -> Proportions:
    """Each ray weighs as many photons as the densities let through, which is one over the variance of its noise."""
    projector, sections = Projector(views.geometry, grid), views.cross_sections
    of_view = sections[views.energy].astype(np.float32)[:, :, None, None]
    data = projection_lines(views.projections)
    depth = np.zeros_like(data)
    for material, density in enumerate(densities):
        seen = projector.forward_lines(volume_lines(density))
        depth += of_view[:, material] * seen
        data = data - of_view[:, states[0] if material in states else material] * seen
    weight = np.exp(-np.minimum(depth, _DEEPEST))
    if views.weight is not None:
        weight[projection_lines(views.weight) == 0] = 0
    difference = sections[:, [states[1]]] - sections[:, [states[0]]]
    return Proportions(projector, views.energy, difference, volume_lines(densities[list(states)].sum(0)), data, weight)


def _even(problem: Proportions) -> F32:
    """One share for all matter, the best in the mean of the views."""
    one = problem.ones()
    all_explained = float(problem.explained(problem.shown(one)).sum(dtype=np.float64))
    mean = float(problem.explained(problem.data).sum(dtype=np.float64)) / (all_explained or 1)
    return np.float32(np.clip(mean, 0, 1)) * one


def _smoothness(views: EnergyViews, found: Materials, states: tuple[int, int], steps: Countdown) -> float:
    densities, grid, rows = found.densities, found.grid, slice(None)
    n_rows = views.geometry.detector_shape[0]
    if views.geometry.rows_show_slices and grid.shape[0] == n_rows:
        rows = busiest_rows(views.projections, _ROWS)
        densities = densities[:, rows]
        grid = slab_of(views.geometry, grid, *rows.indices(n_rows)[:2])[1]
    problem = share_problem(views.select(np.arange(views.geometry.n_views), rows), densities, states, grid)
    held_out = views.parted(ONE_IN) == ONE_IN // 2
    first, problem = _even(problem), replace(problem, stop=steps.stop)
    fit, judge = problem.select(np.flatnonzero(~held_out)), problem.select(np.flatnonzero(held_out))
    return smoothness(fit, judge, first, steps)[0]
