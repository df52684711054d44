"""Tomographic reconstruction of splatline: arrays in, arrays out. The main functions are `recon.correct`, `find_axis`
and `reconstruct`.

The classes of values (Geometry, Grid, Volume, RunControl, DataUse) are imported at once. torch and numba are imported
when a function that computes is first used, so that a program that only plans a scan starts quickly.
"""

from __future__ import annotations

import os
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.method import DataUse, Progress, Reconstruction, RunControl
from recon.base.ray_width import RayWidth
from recon.base.registry import loaded
from recon.base.vectors import geometry_of_vectors, vectors_of
from recon.base.volume import Grid, Volume
from recon.compiled import use_compiled_kernels
from recon.methods import REGISTRY

__path__ = extend_path(__path__, __name__)  # another folder recon/ without __init__.py on the path adds its modules
use_compiled_kernels()  # must run before numba is imported, which happens when something is computed

# libgomp reads this when torch or numba load it. Without it, idle threads spin, and two processes that share the cores
# (a scan and its live reconstruction) slow each other down twentyfold.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")


if TYPE_CHECKING:
    from recon.auto import Auto
    from recon.axis_held_out import axis_by_views
    from recon.features.discrete.methods import Discrete
    from recon.features.iterative.methods import AsdPocs, Cgls, Sart, Sirt
    from recon.features.joint.energy_fit import EnergyViews
    from recon.features.joint.learnt_motion import register_energies
    from recon.features.joint.methods import TimeSeries
    from recon.features.joint.proportions import fit_share
    from recon.features.joint.series import TimedViews, TimedVolumes, fit_series
    from recon.features.joint.spectral import Materials, fit_materials
    from recon.features.published.r2_published import R2Published as R2Published
    from recon.features.rings import WithoutRings, remove_rings
    from recon.prep.align import AxisEstimate, find_axis
    from recon.prep.correct import correct
    from recon.prep.counts import Counts
    from recon.prep.counts_plan import CorrectionSettings
    from recon.prep.projections import Projections
    from recon.prep.references import References
    from recon.reconstruction import reconstruct
    from recon.splatting.gaussians import Gaussians
    from recon.splatting.r2 import R2
    from recon.splatting.settings import FitSettings
    from recon.splatting.splat import project, voxelize
    from recon.splatting.stream import StreamingFit
    from recon.voxels.direct import Fbp
    from recon.voxels.methods import FistaTv, OsSirtTv, PnpDct
    from recon.voxels.projector import Projector

__all__ = [
    "R2",
    "AsdPocs",
    "Auto",
    "AxisEstimate",
    "Cgls",
    "CorrectionSettings",
    "Counts",
    "DataUse",
    "Discrete",
    "EnergyViews",
    "Fbp",
    "FistaTv",
    "FitSettings",
    "Gaussians",
    "Geometry",
    "Grid",
    "Kernel",
    "Materials",
    "OsSirtTv",
    "PnpDct",
    "Progress",
    "Projections",
    "Projector",
    "RayWidth",
    "Reconstruction",
    "References",
    "RunControl",
    "Sart",
    "Sirt",
    "StreamingFit",
    "TimeSeries",
    "TimedViews",
    "TimedVolumes",
    "Volume",
    "WithoutRings",
    "axis_by_views",
    "correct",
    "find_axis",
    "fit_materials",
    "fit_series",
    "fit_share",
    "geometry_of_vectors",
    "project",
    "reconstruct",
    "register_energies",
    "remove_rings",
    "vectors_of",
    "voxelize",
]

_LAZY = {
    "Auto": "recon.auto",
    "AxisEstimate": "recon.prep.align",
    "axis_by_views": "recon.axis_held_out",
    "find_axis": "recon.prep.align",
    "CorrectionSettings": "recon.prep.counts_plan",
    "Projections": "recon.prep.projections",
    "References": "recon.prep.references",
    "correct": "recon.prep.correct",
    "Counts": "recon.prep.counts",
    **dict.fromkeys(("WithoutRings", "remove_rings"), "recon.features.rings"),
    "reconstruct": "recon.reconstruction",
    "register_energies": "recon.features.joint.learnt_motion",
    **dict.fromkeys(("TimedVolumes", "TimedViews", "fit_series"), "recon.features.joint.series"),
    "EnergyViews": "recon.features.joint.energy_fit",
    **dict.fromkeys(("Materials", "fit_materials"), "recon.features.joint.spectral"),
    "fit_share": "recon.features.joint.proportions",
    "FitSettings": "recon.splatting.settings",
    "Gaussians": "recon.splatting.gaussians",
    "Projector": "recon.voxels.projector",
    "StreamingFit": "recon.splatting.stream",
    **dict.fromkeys(("project", "voxelize"), "recon.splatting.splat"),
    **{entry.cls: entry.module for entry in REGISTRY.values()},
}


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(loaded(_LAZY[name]), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("splatline")
    raise AttributeError(f"module 'recon' has no attribute {name!r}")
