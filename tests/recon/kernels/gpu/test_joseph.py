"""The voxel projector and its transpose: the Triton kernels compared with the CPU kernels."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from tests.recon.kernels.gpu.on_gpu import DEVICE

joseph = importlib.import_module("recon.kernels.gpu.joseph")

ANGLES = [0.0, 0.7, np.pi / 2, -2.2]
SHIFTS = [[0.0, 0.0], [1.3, -0.8], [-0.4, 0.6], [2.0, 1.0]]
SHAPE = (7, 12)  # no multiple of a tile


def _parallel(pitch: float = 0.7, **where: Any) -> Geometry:
    return Geometry.parallel(ANGLES, SHAPE, pixel_pitch=pitch, **where)


def _cone(pitch: float = 1.1, sod: float = 22.0) -> Geometry:
    return Geometry.cone(ANGLES, SHAPE, pitch, sod, 45.0, axis_col=5.1, axis_row=3.4, shifts=SHIFTS)


CASES = {
    "rows on slices": (_parallel(), Grid((7, 9, 11), 0.7)),
    "rows a slice off": (_parallel(axis_row=4.0, shifts=[[0.3, 1.0]] * 4), Grid((5, 9, 11), 0.7)),
    "rows between slices": (_parallel(axis_col=4.8, shifts=SHIFTS), Grid((6, 9, 11), 0.7, (0.3, 1.0, -0.7), 0.9)),
    "one slice": (_parallel(shifts=SHIFTS), Grid((1, 18, 9), 0.7)),
    "cone": (_cone(), Grid((7, 9, 11), 0.55)),
    "cone, off the axis": (_cone(), Grid((5, 9, 8), 0.6, (0.4, 1.5, -1.2), 0.5)),
    "fan": (Geometry.fan(ANGLES, 20, 1.1, 22.0, 45.0, axis_col=8.0), Grid((1, 17, 19), 0.55)),
    "wide fan": (Geometry.fan(ANGLES, 20, 4.0, 8.0, 20.0), Grid((1, 12, 9), 0.8)),
    "coarse voxels": (_parallel(0.3), Grid((4, 5, 6), 0.8)),
    "coarse voxels near the source": (_cone(2.0, sod=6.0), Grid((3, 5, 6), 0.9)),
    "fine voxels": (_cone(2.5), Grid((9, 9, 8), 0.4)),
    "out of sight": (_parallel(), Grid((4, 5, 6), 0.7, (0.0, 40.0, 50.0))),
}  # fmt: skip


def _forward(volume: Tensor, rays: Any, views: Tensor) -> Tensor:
    out = torch.full_like(views, torch.nan)
    joseph.forward(volume, rays, out)
    return out


def _adjoint(views: Tensor, rays: Any, volume: Tensor) -> Tensor:
    out = torch.full_like(volume, torch.nan)
    joseph.adjoint(views, rays, out)
    return out


def _case(name: str, rng: np.random.Generator) -> tuple[Projector, Any, Tensor, Tensor]:
    """Joseph's samples alone, not spread over a pixel, with a random volume and random views."""
    geometry, grid = CASES[name]
    projector = Projector(geometry.seen_with(RayWidth(pixel=1e-6)), grid, matched=False)
    (nz, ny, nx), (n_views, rows, cols) = grid.shape, projector.projection_shape
    volume, views = (rng.random(shape, dtype=np.float32) for shape in ((ny, nx, nz), (n_views, cols, rows)))
    rays = joseph.JosephRays.of(geometry, grid, DEVICE)
    return projector, rays, torch.from_numpy(volume).to(DEVICE), torch.from_numpy(views).to(DEVICE)


@pytest.mark.parametrize("name", CASES)
def test_both_directions_equal_the_cpu_and_are_transposes(name: str, rng: np.random.Generator) -> None:
    projector, rays, volume, views = _case(name, rng)
    forward, adjoint = _forward(volume, rays, views).cpu().numpy(), _adjoint(views, rays, volume).cpu().numpy()
    for found, expected in (
        (forward, projector.forward_lines(volume.cpu().numpy())),
        (adjoint, projector.adjoint_lines(views.cpu().numpy())),
    ):
        assert expected.any() == (name != "out of sight")
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * float(expected.max()))
    left = np.vdot(forward.astype(np.float64), views.cpu().numpy())
    assert left == pytest.approx(np.vdot(volume.cpu().numpy().astype(np.float64), adjoint), rel=3e-7)


@pytest.mark.parametrize("name", ["rows between slices", "cone"])
def test_a_ray_and_a_voxel_have_the_same_weight_in_both_directions(name: str, rng: np.random.Generator) -> None:
    """Entry by entry of the matrix, also where a weight is hardly more than the rounding of a place."""
    _, rays, volume, views = _case(name, rng)
    one = torch.zeros_like(views)
    one[1, 5, 3] = 1
    column = _adjoint(one, rays, volume)
    voxels = torch.nonzero(column)
    for y, x, z in voxels[rng.choice(len(voxels), 2, replace=False)].tolist():
        voxel = torch.zeros_like(volume)
        voxel[y, x, z] = 1
        assert float(_forward(voxel, rays, views)[1, 5, 3]) == pytest.approx(float(column[y, x, z]), rel=3e-7)


def test_the_same_input_gives_the_same_bits(rng: np.random.Generator) -> None:
    _, rays, volume, views = _case("cone", rng)
    assert torch.equal(_forward(volume, rays, views), _forward(volume, rays, views))
    assert torch.equal(_adjoint(views, rays, volume), _adjoint(views, rays, volume))


def test_no_views_leave_an_empty_volume(rng: np.random.Generator) -> None:
    _, rays, volume, views = _case("cone", rng)
    assert not _adjoint(views[:0], rays, volume).any()
    assert _forward(volume, rays, views[:0]).shape == (0, *views.shape[1:])


def test_leaning_views_and_a_box_at_the_source_are_refused() -> None:
    with pytest.raises(ValueError, match="has roll, tilt or centres"):
        joseph.JosephRays.of(_parallel(roll=0.1), Grid((7, 9, 11), 0.7), DEVICE)
    with pytest.raises(ValueError, match="reaches the X-ray source"):
        joseph.JosephRays.of(_cone(), Grid((7, 60, 60), 0.7), DEVICE)
