"""polish: a few sweeps of ordered-subset SIRT with total variation add on voxels what Gaussians cannot describe."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from recon.base.masks import masked
from recon.base.method import ReconProblem
from recon.base.volume import Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from recon.voxels.iterative import solve
from recon.voxels.methods.os_sirt_tv import OsSirtTv
from recon.voxels.projector import Projector

F32 = NDArray[np.float32]

# In density units. Half of the best weight for a start from zero, since the fit has removed most of the noise.
_TV_WEIGHT = 0.002


def polish(
    volume: Volume,
    gaussians: Gaussians,
    problem: ReconProblem,
    sweeps: int,
    settings: FitSettings | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Volume:
    """The volume after `sweeps` over all views, starting from the volume of a fit.

    The sweeps fit the views p - G + A x: measured views p, less the views G of the Gaussians, plus the projection A x
    of the voxels x at the start. So the sweeps do not try to correct the coarseness of the voxels, and matter outside
    the box stays represented by the Gaussians.

    Sharp edges need many Gaussians, and no additional voxels. With many edges three sweeps gain 0.3 to 2 dB (see
    docs/exploration.md); more sweeps fit the noise. Memory: 8 volumes and 4 times the projections.

    Args:
        volume: voxels of the Gaussians, 1/mm.
        gaussians: result of a fit to the views.
        problem: the views that were fitted, without roll and tilt, and the weights of their rays.
        sweeps: 1 or more.
        settings: of the fit; None: the defaults.
        should_stop: called after each sweep; True ends the iteration.

    Raises:
        ValueError: for views with roll or tilt, shapes that disagree, or no sweeps.
    """
    fit = settings or FitSettings()
    projector = Projector(problem.geometry, volume.grid)
    data, known = masked(problem.projections, problem.use.weights)
    modelled = project(gaussians, problem.geometry, truncation=fit.truncation, model=fit.rays).numpy()
    data = data - modelled
    data += projector.forward(volume.data)
    return solve(
        OsSirtTv(sweeps, tv_weight=_TV_WEIGHT), projector, data, weight=known, start=volume,
        on_iteration=lambda *_: should_stop is not None and should_stop(), seed=problem.seed,
    )  # fmt: skip
