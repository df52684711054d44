"""Tomographic reconstruction: arrays in, arrays out: `recon.correct`, `find_axis`, `remove_rings`, `reconstruct`.

The values (Geometry, Grid, Volume, RunControl, DataUse) load at once. Functions that compute load torch and numba on
first use: a program that only plans a scan starts quickly.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.method import DataUse, Energies, Progress, Reconstruction, RunControl
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid, Volume
from recon.compiled import use_compiled_kernels
from recon.methods import REGISTRY

use_compiled_kernels()  # before numba is imported, which happens where something is computed

# libgomp reads this when torch or numba load it: without it idle threads spin, and two processes that share the cores
# (a scan and its live reconstruction) slow each other down twentyfold.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

if TYPE_CHECKING:
    from recon.auto import Auto
    from recon.axis_by_views import axis_by_views
    from recon.energy_fit import EnergyViews
    from recon.fields.methods import NAF, IntraTomo, SaxNerf
    from recon.joint_methods import EnergySeries, TimeSeries
    from recon.prep.align import AxisEstimate, find_axis
    from recon.prep.correct import CorrectionSettings, Projections, References, correct
    from recon.prep.counts import Counts
    from recon.prep.rings import WithoutRings, remove_rings
    from recon.reconstruction import reconstruct
    from recon.registration import register_energies
    from recon.series import TimedViews, TimedVolumes, fit_series
    from recon.share_fit import fit_share
    from recon.spectral import Materials, fit_materials
    from recon.splatting.gaussians import Gaussians
    from recon.splatting.published import R2Published
    from recon.splatting.r2 import R2
    from recon.splatting.settings import FitSettings
    from recon.splatting.splat import project, voxelize
    from recon.splatting.stream import StreamingFit
    from recon.voxels.direct import Fbp
    from recon.voxels.emission import Emission, attenuation_factors, mlem, weighted_lines
    from recon.voxels.methods.asd_pocs import AsdPocs
    from recon.voxels.methods.cgls import Cgls
    from recon.voxels.methods.fista_tv import FistaTv
    from recon.voxels.methods.mlem import Mlem, Osem
    from recon.voxels.methods.os_sirt_tv import OsSirtTv
    from recon.voxels.methods.pnp_dct import PnpDct
    from recon.voxels.methods.sart import Sart
    from recon.voxels.methods.sirt import Sirt
    from recon.voxels.projector import Projector

__all__ = [
    "NAF",
    "R2",
    "AsdPocs",
    "Auto",
    "AxisEstimate",
    "Cgls",
    "CorrectionSettings",
    "Counts",
    "DataUse",
    "Emission",
    "Energies",
    "EnergySeries",
    "EnergyViews",
    "Fbp",
    "FistaTv",
    "FitSettings",
    "Gaussians",
    "Geometry",
    "Grid",
    "IntraTomo",
    "Kernel",
    "Materials",
    "Mlem",
    "OsSirtTv",
    "Osem",
    "PnpDct",
    "Progress",
    "Projections",
    "Projector",
    "R2Published",
    "RayWidth",
    "Reconstruction",
    "References",
    "RunControl",
    "Sart",
    "SaxNerf",
    "Sirt",
    "StreamingFit",
    "TimeSeries",
    "TimedViews",
    "TimedVolumes",
    "Volume",
    "WithoutRings",
    "attenuation_factors",
    "axis_by_views",
    "correct",
    "find_axis",
    "fit_materials",
    "fit_series",
    "fit_share",
    "mlem",
    "project",
    "reconstruct",
    "register_energies",
    "remove_rings",
    "voxelize",
    "weighted_lines",
]

_LAZY = {
    "Auto": "recon.auto",
    "AxisEstimate": "recon.prep.align",
    "axis_by_views": "recon.axis_by_views",
    "find_axis": "recon.prep.align",
    **dict.fromkeys(("CorrectionSettings", "Projections", "References", "correct"), "recon.prep.correct"),
    "Counts": "recon.prep.counts",
    **dict.fromkeys(("WithoutRings", "remove_rings"), "recon.prep.rings"),
    "reconstruct": "recon.reconstruction",
    "register_energies": "recon.registration",
    **dict.fromkeys(("TimedVolumes", "TimedViews", "fit_series"), "recon.series"),
    "EnergyViews": "recon.energy_fit",
    **dict.fromkeys(("Materials", "fit_materials"), "recon.spectral"),
    "fit_share": "recon.share_fit",
    "FitSettings": "recon.splatting.settings",
    "Gaussians": "recon.splatting.gaussians",
    **dict.fromkeys(("Emission", "attenuation_factors", "mlem", "weighted_lines"), "recon.voxels.emission"),
    "Projector": "recon.voxels.projector",
    "StreamingFit": "recon.splatting.stream",
    **dict.fromkeys(("project", "voxelize"), "recon.splatting.splat"),
    **{entry.cls: entry.module for entry in REGISTRY.values()},
}


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'recon' has no attribute {name!r}")
