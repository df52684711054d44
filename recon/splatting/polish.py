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

# In density units. Half of what is best for a volume that starts from nothing: most noise is gone already.
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
    """The volume after `sweeps` over all views, from where a fit has left it.

    The views that the sweeps see are those that the voxels x of the model would give, plus what the model leaves
    unexplained: p - G + A x, with G the views of the Gaussians. So the coarseness of the voxels is no error to be
    corrected, and what lies outside the box stays explained by the Gaussians.

    Sharp edges cost Gaussians much and voxels nothing. Three sweeps gain 0.3 to 2 dB where there are many (see
    docs/exploration.md), more of them begin to follow the noise. Memory: 8 volumes and 4 x the projections.

    Args:
        volume: of the Gaussians, 1/mm.
        gaussians: a fit of the views.
        projections: [view, row, col]; what is not finite weighs nothing.
        geometry: of the views; straight ones.
        sweeps: 1 or more.
        weights: of each ray [view, row, col], 0 or more.
        rays, truncation: of the fit.
        should_stop: asked after each sweep.
        seed: of the order of the subsets.

    Raises:
        ValueError: for leaning views, shapes that disagree, or no sweeps.
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
