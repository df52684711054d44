"""Solvers give the same volumes on GPU and CPU, to rounding. Without a GPU, Triton's interpreter is used."""

from __future__ import annotations

import numpy as np
import pytest

import recon
from recon import FistaTv, PnpDct
from recon.base.geometry import Geometry
from recon.base.method import DataUse
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid
from recon.voxels.devices import CPU, projector_on, voxel_device
from recon.voxels.direct import direct
from recon.voxels.projector import Projector
from tests.recon.kernels.gpu.on_gpu import DEVICE
from tests.slow_cases import others_slow

ROWS, COLS, VIEWS = 4, 12, 16
ANGLES = np.linspace(0, np.pi, VIEWS, endpoint=False)
PARALLEL = Geometry.parallel(ANGLES, (ROWS, COLS), pixel_pitch=0.1)
CONE = Geometry.cone(2 * ANGLES, (ROWS, COLS), 0.2, 20.0, 40.0)
LEANED = Geometry.parallel(ANGLES, (ROWS, COLS), pixel_pitch=0.1, roll=0.05)  # projected on the CPU: fast
FEW = slice(None, None, 4)  # views, where the interpreter projects


@pytest.mark.parametrize("geometry", others_slow([LEANED, PARALLEL, PARALLEL.seen_with(RayWidth(arc=0.2)), CONE], 2))
def test_projections_on_a_gpu_are_those_of_the_cpu(geometry: Geometry) -> None:
    few, device = geometry.select(FEW), voxel_device("cuda")
    projector, rng = Projector(few, Grid.matching(few)), np.random.default_rng(1)
    there, here = projector_on(device, projector), projector_on(CPU, projector)
    volume, views = rng.random((COLS, COLS, ROWS), np.float32), rng.random((few.n_views, COLS, ROWS), np.float32)
    seen, back = here.forward_lines(volume), here.adjoint_lines(views)
    np.testing.assert_allclose(device.numpy(there.forward_lines(device.array(volume))), seen, atol=3e-6 * seen.max())
    into = device.zeros(volume.shape)
    assert into.device.type == DEVICE.type
    there.adjoint_lines(device.array(views), into)
    np.testing.assert_allclose(device.numpy(into), back, atol=3e-6 * back.max())


def views_of(geometry: Geometry) -> np.ndarray:
    grid, rng = Grid.matching(geometry), np.random.default_rng(3)
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    disc = np.where(np.hypot(x, y) < 0.3 * COLS * grid.voxel_size, 1 + 0.3 * np.sin(9 * x), 0).astype(np.float32)
    clean = Projector(geometry, grid).forward(disc)
    return (clean + rng.normal(0, 0.01, clean.shape)).astype(np.float32)


@pytest.mark.parametrize("beam", others_slow([LEANED, CONE]))
def test_filtered_back_projection_on_a_gpu_is_that_of_the_cpu(beam: Geometry) -> None:
    few, told = beam.select(FEW), list[tuple[int, int]]()
    grid, data = Grid.matching(few), views_of(few)
    here = direct(data, few, grid, "hann")
    there = direct(data, few, grid, "hann", lambda *done: told.append(done), device="cuda")
    np.testing.assert_allclose(there, here, atol=3e-6 * here.max())
    assert told == [(COLS, COLS)]


def assert_same_volumes(geometry: Geometry, method: recon.Method, weighted: bool, off: float = 2e-5) -> None:
    data = views_of(geometry)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, data.shape).astype(np.float32) if weighted else None
    here, there = (
        recon.reconstruct(data, geometry, method, use=DataUse(weights), device=device).volume.data
        for device in ("cpu", "cuda")
    )
    np.testing.assert_allclose(there, here, atol=off)


CHOSEN, GIVEN, PATCHES, FINISH = (
    FistaTv(iterations=2), FistaTv(iterations=2, tv_weight=0.02), PnpDct(iterations=6), recon.R2(steps=0)
)  # fmt: skip


@pytest.mark.parametrize(
    ("method", "weighted"),
    others_slow([(GIVEN, True), (CHOSEN, False), (PATCHES, True), (FINISH, False)]),
)
def test_volumes_made_on_a_gpu_are_those_of_the_cpu(method: recon.Method, weighted: bool) -> None:
    off = 1e-3 if isinstance(method, recon.R2) else 2e-5  # 35 steps of patches: at a threshold rounding decides
    assert_same_volumes(LEANED, method, weighted, off)


@pytest.mark.slow
def test_a_gpu_that_projects_makes_the_volume_of_the_cpu() -> None:
    few = PARALLEL.select(FEW).rows(1, 3).binned(2)  # each projection takes the interpreter a second
    assert_same_volumes(few, FistaTv(iterations=1, subsets=1, tv_weight=0.02), True)
