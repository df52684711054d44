"""The kernels for a hard case: those of the CPU, or Triton's (on CUDA if there is a GPU, otherwise interpreted and
small)."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.hard_cases.measure import WHOLE, Found, compare
from tests.recon.helpers import as_leaves
from tests.recon.kernels.reference import on_grid as voxelize
from tests.recon.kernels.reference import project

PITCH = 0.5
EXACT = RayModel(exact_above=0.0)
Place = tuple[float, float, float]


@dataclass(frozen=True)
class On:
    """Kernels, and set-ups small enough for a test.

    Attributes:
        device: device of the Triton kernels; None: CPU kernels.
        beams: geometries with pixels of 0.5 mm, by name; `grid`: voxels of 0.6 mm.
        view: geometry with pixels of 1 mm; x is the column, z the row. `source`: a cone with its source at y = -10 mm.
        far: largest distance, in px, of a pixel from the middle of the detector or from a centre in it. `reach`: the
            same in voxels.
        extent: centres are within this, mm.
        many: number of Gaussians at a time.
    """

    device: torch.device | None
    beams: Mapping[str, Geometry]
    grid: Grid
    view: Geometry
    source: Geometry
    far: float
    reach: float
    extent: float
    many: int

    def compare(self, g: Gaussians, where: Geometry | Grid, model: RayModel | None = None) -> Found:
        return compare(g, where, model=model, device=self.device)

    def leaves(self, g: Gaussians) -> Gaussians:
        return as_leaves(g, self.device)

    def shown(
        self, g: Gaussians, where: Geometry | Grid, model: RayModel | None = None, *, whole: bool = False
    ) -> Tensor:
        """An image or a volume of leaves; `whole`: without cut-off, as in `compare`."""
        cut, gpu = WHOLE if whole else Truncation(), self.device is not None
        if isinstance(where, Grid):
            return voxelize(g, where, truncation=cut, gpu=gpu)
        return project(g, where, truncation=cut, model=model, gpu=gpu)

    def some(self, shape: Place, n: int = 12, seed: int = 1) -> Gaussians:
        """n Gaussians of one shape, in any orientation; at most 8 for Triton."""
        n = n if self.device is None else min(n, 8)
        rng = np.random.default_rng(seed)
        means = (rng.random((n, 3)) - 0.5) * self.extent
        return Gaussians.from_physical(
            means, np.tile(shape, (n, 1)), rng.uniform(0.2, 1, n), rng.normal(size=(n, 4)), density_unit=0.7
        )


def at(places: list[Place], sigma: float = 1.1, density: float = 0.8) -> Gaussians:
    """Slightly different, slightly rotated Gaussians at (x, y, z)."""
    n = len(places)
    rng = np.random.default_rng(5)
    shapes = sigma * rng.uniform(0.7, 1.4, (n, 3))
    return Gaussians.from_physical(places, shapes, np.full(n, density), rng.normal(size=(n, 4)))


def _view(shape: tuple[int, int]) -> Geometry:
    return Geometry.parallel([0.0], shape, pixel_pitch=1.0, axis_col=0.0, axis_row=0.0)


def cpu() -> On:
    """The detector size is not a multiple of the 4 rows and 16 columns that the kernels process at a time."""
    angles, shape, axis = (0.3, 0.7, 2.5, -4.0), (24, 30), 13.3
    beams = {
        "parallel": Geometry.parallel(angles, shape, pixel_pitch=PITCH, axis_col=axis),
        "leaning": Geometry.parallel(
            angles, shape, pixel_pitch=PITCH, axis_col=axis, axis_row=10.0, roll=(0.2, -0.1, 0.0, 0.05), tilt=-0.3
        ),
        "cone": Geometry.cone(angles, shape, 0.8, 25.0, 40.0, axis_col=axis).about(
            [(0.5, -0.3, 0.4), (-0.4, 0.2, 0.1), (0.0, 0.0, 0.0), (0.1, 0.6, -0.5)]
        ),
    }
    grid, source = Grid((9, 12, 20), 0.6, centre=(0.4, -0.8, 1.1)), Geometry.cone([0.0], (33, 47), 1.0, 10.0, 20.0)
    return On(None, beams, grid, _view((33, 47)), source, far=40.0, reach=15.0, extent=4.0, many=200)


def gpu() -> On:
    """The detector size is not a multiple of a tile."""
    device = importlib.import_module("tests.recon.kernels.gpu.on_gpu").DEVICE
    shape, axis = (11, 13), 5.3
    beams = {
        "parallel": Geometry.parallel([0.7], shape, pixel_pitch=PITCH, axis_col=axis),
        "leaning": Geometry.parallel([2.5], shape, pixel_pitch=PITCH, axis_col=axis, axis_row=4.0, roll=0.2, tilt=-0.3),
        "cone": Geometry.cone([-4.0], shape, 0.8, 25.0, 40.0, axis_col=axis).about([(0.5, -0.3, 0.4)]),
    }
    grid, source = Grid((5, 6, 9), 0.6, centre=(0.4, -0.8, 1.1)), Geometry.cone([0.0], shape, 1.0, 10.0, 20.0)
    return On(device, beams, grid, _view(shape), source, far=30.0, reach=10.0, extent=3.0, many=15)
