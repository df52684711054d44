"""polish: a few sweeps of ordered-subset SIRT with total variation add on voxels what Gaussians cannot describe."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.ray_model import RayModel, Truncation
from recon.base.volume import Volume
from recon.splatting.gaussians import Gaussians
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
    projections: F32,
    geometry: Geometry,
    sweeps: int,
    *,
    weights: F32 | None = None,
    rays: RayModel | None = None,
    truncation: Truncation | None = None,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
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
        projections: [view, row, col]; values that are not finite get weight 0.
        geometry: geometry of the views, without roll and tilt.
        sweeps: 1 or more.
        weights: weight of each ray [view, row, col], 0 or more.
        rays, truncation: as in the fit.
        should_stop: called after each sweep; True ends the iteration.
        seed: seed of the order of the subsets.

    Raises:
        ValueError: for views with roll or tilt, shapes that disagree, or no sweeps.
    """
    projector = Projector(geometry, volume.grid)
    data, known = masked(projections, weights)
    modelled = project(gaussians, geometry, truncation=truncation, model=rays).numpy()
    data = data - modelled
    data += projector.forward(volume.data)
    return solve(
        OsSirtTv(sweeps, tv_weight=_TV_WEIGHT), projector, data, weight=known, start=volume,
        on_iteration=lambda *_: should_stop is not None and should_stop(), seed=seed,
    )  # fmt: skip
