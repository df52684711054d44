"""Makes a picture of a state while it is scanned: the moved reference, and FBP of the residual that it leaves in the
projections.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon.base.arrays import F32
from recon.base.method import Preview
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.features.reference.choice import if_it_overlaps, width_of
from recon.features.reference.fit import PLAN, StateFit
from recon.features.reference.motion import Basis, MotionViews, affinely_moved, padded, roughly_moved
from recon.voxels.held_out import LEAST_VIEWS
from recon.voxels.iterative import solve_views
from recon.voxels.projector import Projector, volume_slices
from recon.voxels.voxel_problem import VoxelProblem, times_power


def preview_of(reference: Volume, views: Views) -> Preview | None:
    """The moved reference plus FBP of the residual, on the voxels of a few detector rows. None in three cases: there
    are fewer than 16 projections, the geometry is not a parallel beam with straight rows, or the reference shows no
    material there or does not overlap them.

    The motion is found as in `FromReference`, but with FBP of the residual instead of iterations. (With the motion
    known, this is one FBP: Chen, Tang & Leng 2008, Med. Phys. 35, 660, without the iterations.)
    """
    geometry = views.geometry
    if geometry.n_views < LEAST_VIEWS or not geometry.rows_show_slices:
        return None
    grid, state = Grid.matching(geometry), _Leaves(reference)
    volume = solve_views(state, Projector(geometry, grid), views.masked(), nonnegative=False)
    return None if state.moved is None else Preview(volume, Volume(state.moved, grid), state.left)


class _Leaves:
    """Makes the volume from a reference. Afterwards it also has the moved reference [z, y, x] in 1/mm, and the share of
    the projections that the reference leaves.
    """

    def __init__(self, reference: Volume) -> None:
        self._reference = reference
        self.moved: F32 | None = None
        self.left = math.nan

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        moved = if_it_overlaps(self._reference, problem)
        if moved is None:
            return x
        grid, width = problem.projector.grid, width_of(problem)
        start, affine = _rest(problem, x)[0], Basis.affine(grid, width)
        moved = replace(moved, u=padded(affine.field(roughly_moved(moved, start, grid, width))))
        additional = np.where(moved.known(), 0, start).astype(np.float32)
        moved = affinely_moved(MotionViews.of(problem), moved, affine, additional)
        fit = StateFit(problem, moved, start, 1.0, width)
        for steps in PLAN:
            fit.x = fit.m + _rest(problem, fit.m)[0]
            fit.follow(steps)
        rest, self.left = _rest(problem, fit.m)
        self.moved = volume_slices(times_power(fit.m.copy(), problem.units.density))
        return fit.m + rest


def _rest(problem: VoxelProblem, x: F32) -> tuple[F32, float]:
    """FBP [y, x, z] of the residual of a volume in the projections, and the norm of the residual divided by the norm of
    the projections.
    """
    residual = problem.views - problem.projector.forward_lines(x)
    of_rays = 1.0 if problem.weight is None else problem.weight > 0
    share = math.sqrt(
        float(np.square(residual * of_rays).sum()) / max(float(np.square(problem.views * of_rays).sum()), 1e-30)
    )
    filtered = replace(problem, data=residual, measured=None).filtered("hann")
    return np.zeros_like(x) if filtered is None else filtered, share
