"""End slices of a volume against its middle; pytest -m bench -s tests/bench/test_end_slices.py.

Bodies that fill all 40 slices, by both beams, with the views of the simulator's projector. Either the body ends with
the field or it goes on beyond the first and last row: then the views of a cone see parts of slices without a voxel.
PUBLISHED_SECONDS=N in the environment gives the published method N processor seconds instead of 40.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.method import RunControl
from recon.base.volume import Grid
from recon.features.published.r2_published import R2Published
from recon.warm_up import warm_up
from tests.bench.quality_cases import F32, OBJECTS, first_of, noisy, padded, seen_by_simulator

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
SIDE, SLICES, VIEWS, FINE = 64, 40, 50, 4  # FINE: voxels of the body along one of the volume
BEYOND = {"ends": 0, "goes on": 4}  # slices of the body beyond either end of the volume
BODIES: dict[str, Callable[[Path], F32]] = {
    "thorax": lambda folder: padded(OBJECTS["thorax"](folder), 256),
    "walnut": lambda folder: np.clip(first_of(folder / "walnut_fdk_256.npz") / 0.06, 0, 1),
}
METHODS: dict[str, Any] = {
    "FBP, FDK": recon.Fbp(),
    "SIRT": recon.Sirt(),
    "FISTA-TV": recon.FistaTv(),
    "R2 of ours": recon.R2(),
    "R2 as published": R2Published(gaussians=2000, steps=None, seconds=float(os.environ.get("PUBLISHED_SECONDS", 40))),
}


def views_of(beam: str, rows: int) -> Geometry:
    """A parallel beam with a pixel a voxel; the published cone, whose pixels are 0.71 voxels at the axis."""
    if beam == "parallel":
        return Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (SLICES, SIDE), pixel_pitch=2 / SIDE)
    return Geometry.cone(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False), (rows, 2 * SIDE), 2 / SIDE, 5.0, 7.0)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("body", BEYOND)
@pytest.mark.parametrize("beam", ["parallel", "cone"])
def test_end_slices_against_the_middle(shared_data: Path, beam: str, body: str, name: str) -> None:
    """A line a method: PSNR of the first and last slice, of the outer tenth, of the rest; peak 1."""
    high = FINE * (SLICES // 2 + BEYOND[body])
    fine = BODIES[name](shared_data)[128 - high : 128 + high]
    inside = fine[FINE * BEYOND[body] :][: FINE * SLICES]
    truth = inside.reshape(SLICES, FINE, SIDE, FINE, SIDE, FINE).mean(axis=(1, 3, 5))
    geometry = views_of(beam, 56 if BEYOND[body] else 72)  # 56 rows see 40 slices at the axis; 72 see them all
    data = noisy(seen_by_simulator(fine, geometry, 2 / SIDE / FINE))
    z = np.arange(SLICES)
    away = np.minimum(z, SLICES - 1 - z)
    y, x = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    seen = np.hypot(y, x) < SIDE / 2 - 1
    print()
    for label, method in METHODS.items():
        warm_up(method, geometry)
        begin = time.process_time()
        found = recon.reconstruct(
            data, geometry, method, grid=Grid(truth.shape, 2 / SIDE), control=RunControl(now=time.process_time)
        )
        busy, volume = time.process_time() - begin, np.clip(found.volume.data, 0, None)
        parts = [
            psnr(truth[chosen][:, seen], volume[chosen][:, seen], 1.0) for chosen in (away < 1, away < 2, away > 1)
        ]
        print(
            f"{name:7} {beam:9}{body:8} {label:16}" + "".join(f"{part:7.2f}" for part in parts) + f" dB  "
            f"{parts[1] - parts[2]:+6.2f}  {busy:6.1f} CPU s",
            flush=True,
        )
