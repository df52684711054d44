"""How fast and how good the classical methods are; run with  pytest -m bench -s tests/bench."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from recon import AsdPocs, Cgls, FistaTv, OsSirtTv, Sart, Sirt
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import fdk
from recon.voxels.fbp import fbp
from recon.voxels.iterative import Watch, solve
from recon.voxels.projector import Projector
from simulators.frame.detector import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.battery import battery

F32 = NDArray[np.float32]

WALNUT_PITCH = 0.15217249972911476


def _seconds(call: Callable[[], object], repeats: int = 7) -> tuple[float, float, float]:
    """Median, quickest and processor time (all threads) of a call; the first one compiles and does not count."""
    call()
    wall, busy = [], []
    for _ in range(repeats):
        begin, worked = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - begin)
        busy.append(time.process_time() - worked)
    return float(np.median(wall)), min(wall), float(np.median(busy))


@pytest.mark.bench
@pytest.mark.parametrize("beam", ["parallel", "cone"])
def test_projectors(beam: str) -> None:
    rng = np.random.default_rng(0)
    if beam == "parallel":
        geometry = Geometry.parallel(np.arange(90) * np.pi / 90, (256, 256))
        grid = Grid.matching(geometry)
    else:
        geometry = Geometry.cone(np.arange(50) * np.pi / 25, (256, 256), 4 / 256, 5.0, 7.0)
        grid = Grid((128, 128, 128), 2 / 128)
    projector = Projector(geometry, grid)
    nz, ny, nx = grid.shape
    lines = rng.random((ny, nx, nz), dtype=np.float32)
    rays = projector.forward_lines(lines)
    volume, views = np.ones(grid.shape, np.float32), np.ones(projector.projection_shape, np.float32)
    for name, call in (
        ("forward, lines", lambda: projector.forward_lines(lines)),
        ("adjoint, lines", lambda: projector.adjoint_lines(rays, lines)),
        ("forward", lambda: projector.forward(volume)),
        ("adjoint", lambda: projector.adjoint(views)),
        ("direct", lambda: fdk(views, geometry, grid) if geometry.is_cone else fbp(views, geometry, grid)),
    ):
        middle, best, busy = _seconds(call)
        print(f"{beam:8s} {geometry.n_views} views {nz}³ {name:14s} {middle:.3f} s (best {best:.3f}, cpu {busy:.3f})")
        assert middle > 0


def _walnut(folder: Path) -> tuple[Geometry, F32, F32]:
    with h5py.File(folder / "walnut_parallel_rebinned_240x96x256.h5") as file:
        views = np.asarray(file["exchange/data"][::4], np.float32)
        angles = np.deg2rad(file["exchange/theta"][::4])
    with np.load(folder / "walnut_fdk_256.npz") as file:
        truth = np.maximum(np.asarray(file["volume"][70:166], np.float32), 0)
    return Geometry.parallel(angles, (96, 256), pixel_pitch=WALNUT_PITCH, axis_col=127.5), views, truth


def _battery(side: int = 96, n_views: int = 60, photons: float = 2e4) -> tuple[Geometry, F32, F32]:
    """300 particles in a can; pixels average 2 x 2 rays, counts are Poisson."""
    rng = np.random.default_rng(0)
    pitch = 0.9 / side
    phantom = Phantom.of(battery(rng, (0.9, 0.9), 300))
    angles = np.arange(n_views) * np.pi / n_views
    fine = Detector.centred((2 * side, 2 * side), pitch / 2)
    exact = np.stack([phantom.line_integrals(a, fine).reshape(side, 2, side, 2).mean((1, 3)) for a in angles])
    counts = rng.poisson(photons * np.exp(-exact))
    views = -np.log(np.maximum(counts, 1) / photons).astype(np.float32)
    geometry = Geometry.parallel(angles, (side, side), pixel_pitch=pitch)
    return geometry, views, phantom.attenuation(Grid.matching(geometry))


@pytest.mark.bench
@pytest.mark.parametrize("sample", ["walnut", "battery"])
def test_quality_and_time_of_each_method(sample: str, shared_data: Path) -> None:
    geometry, views, truth = _walnut(shared_data) if sample == "walnut" else _battery()
    projector = Projector(geometry, Grid.matching(geometry))
    methods = (Sirt(), Sart(), Cgls(), AsdPocs(), FistaTv(), OsSirtTv())
    for method in methods:
        solve(method.toy(), projector, views)  # compiles
    begin = time.perf_counter()
    direct = np.maximum(fbp(views, geometry, filter="hann"), 0)
    print(f"{sample} fbp hann {time.perf_counter() - begin:.2f} s, {psnr(truth, direct):.2f} dB")
    for method in methods:
        begin, worked = time.perf_counter(), time.process_time()
        curve: list[float] = []
        volume = solve(method, projector, views, watch=Watch(lambda _, r, curve=curve: curve.append(r)))
        wall, busy = time.perf_counter() - begin, time.process_time() - worked
        steps = method.iterations
        print(
            f"{sample} {method.name:10s} {steps:3d} iterations {wall:6.2f} s (cpu {busy:6.2f}), "
            f"{steps / wall:5.2f} it/s, "
            f"{psnr(truth, volume.data):.2f} dB, residual {curve[-1]:.4f}"
        )
        assert np.isfinite(volume.data).all()
