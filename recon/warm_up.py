"""warm_up: compile every kernel of a fit on a toy, so that compilation never falls into a fit's time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from recon.base.geometry import Geometry
from recon.base.ray_model import RayModel
from recon.kernels.cpu.activation import F32
from recon.reconstruction import reconstruct
from recon.splatting.density_control import DensityPolicy
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import Start
from recon.splatting.problem import Loss
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project
from recon.voxels.view_weights import covers_the_circle

_SHAPE, _VIEWS = (12, 16), 4
_LEAN, _SHIFT = 0.1, 0.3  # radians; pixels


def warm_up(
    device: str = "cpu",
    loss: Loss = "l1",
    geometry: Geometry | None = None,
    *,
    rays: RayModel | None = None,
    start: Start = "fbp",
    weighted: bool = False,
) -> None:
    """Fit a toy for a few steps: some 30 s on a machine that has never done it, a fraction of a second afterwards.

    numba keeps what it compiles beside the package (or in the user's cache folder), once for each kind of processor.
    What another kind of geometry, first volume or ray needs is compiled for it alone: leaning views, a cone or weights
    take a sixth of that time more, a start by TV a third, a cone's short scan with exact rays two thirds.

    Args:
        device: that the fit will compute on.
        loss: of the fit; a GPU's kernels are compiled for one.
        geometry: of the fit; None: a parallel beam, straight.
        rays: of the fit's settings; None: their default.
        start: of the fit.
        weighted: views of the fit have weights, or values that are not finite.
    """
    data, views = toy_of(geometry)
    settings = FitSettings(loss=loss, policy=DensityPolicy(start=0, every=1, threshold=0.0))
    model = settings.rays if rays is None else rays
    if model.exact_above < math.inf:
        model = replace(model, exact_above=0.0)  # so that there are some in the toy, too
    weights = None
    if weighted:
        weights = np.ones(data.shape, np.float32)
        weights[::2, 3, 4] = 0  # views with and without go different ways
    reconstruct(
        data, views, steps=_VIEWS, gaussians=50, settings=replace(settings, rays=model), start=start, device=device,
        weights=weights,
    )  # fmt: skip


def toy_of(geometry: Geometry | None = None) -> tuple[F32, Geometry]:
    """Line integrals [view, row, col] of a blob in four small views for which the same kernels run as for `geometry`.

    They are so in the beam, in whether views lean or are shifted, and in whether they stand all around.
    """
    if geometry is None or not geometry.is_cone:
        views = Geometry.parallel(np.linspace(0, np.pi, _VIEWS, endpoint=False), _SHAPE)
    else:
        turn = 2 * np.pi if covers_the_circle(geometry.angles) else np.pi
        pitch = geometry.pixel_pitch * geometry.detector_shape[1] / _SHAPE[1]  # the same field
        angles = np.linspace(0, turn, _VIEWS, endpoint=False)
        views = Geometry.cone(angles, _SHAPE, pitch, geometry.sod, geometry.sdd)
    if geometry is not None:
        leaning = (geometry.roll != 0) | (geometry.tilt != 0)
        # Where some views lean and others do not, so it is here.
        tilt = np.where(np.arange(_VIEWS) % 2 == 0, _LEAN * leaning.any(), _LEAN * leaning.all())
        views = replace(views, tilt=tilt, shifts=np.full((_VIEWS, 2), _SHIFT * geometry.shifts.any()))
    width = 2 * views.sample_pitch
    blob = Gaussians.from_physical(
        np.zeros((1, 3)), np.array([width]), np.array([0.2 / width]), density_unit=0.2 / width
    )
    return project(blob, views).numpy(), views
