"""The published R²-Gaussian beside ours, and what each departure from it gains; pytest -m bench -s tests/bench."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr, ssim3d
from recon.base.kernel import Kernel
from recon.splatting.density_control import DensityPolicy
from recon.splatting.published import R2Published, published_fit
from tests.bench.quality_cases import Case, cone

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
VIEWS, SIZE = 50, 128
PUBLISHED, FIT = R2Published(gaussians=20_000), published_fit()
DEPARTURES = {
    "as published": PUBLISHED,
    "10 000 steps": replace(PUBLISHED, steps=10_000),
    "not rectified": replace(PUBLISHED, fit=replace(FIT, rays=replace(FIT.rays, rectified=False))),
    "our start": replace(PUBLISHED, start="fbp"),
    "our split and clone": replace(PUBLISHED, fit=replace(FIT, policy=DensityPolicy(start=1 / 60, growth=10.0))),
    "compact kernel": replace(PUBLISHED, fit=replace(FIT, kernel=Kernel.COMPACT)),
    "total variation moves centres": replace(PUBLISHED, fit=replace(FIT, tv_moves=True)),
    "total variation by noise, larger box": replace(PUBLISHED, fit=replace(FIT, tv_weight=None, tv_size=None)),
    "finish on voxels": replace(PUBLISHED, finish=None),
    "400 steps, 26 times the rates": replace(PUBLISHED, steps=400, fit=replace(FIT, pace=26.0, views_per_step=2)),
    "ours": recon.R2(),
}
"""One change each of the published settings; 20 000 Gaussians, as many a voxel as 50 000 at 256³ are after growth."""


def line(case: Case, label: str, method: recon.R2) -> str:
    cpu, wall = time.process_time(), time.perf_counter()
    found = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    volume = np.clip(found.volume.data, 0, None)
    return (
        f"{case.name:8} {label:38} {psnr(case.truth, volume, case.peak):6.2f} dB  {ssim3d(case.truth, volume):.3f}"
        f"  {found.settings['gaussians']:>6} Gaussians  {cpu:6.0f} CPU s  {wall:6.0f} s"
    )


@pytest.mark.parametrize("label", DEPARTURES)
@pytest.mark.parametrize("name", ["teapot", "shell", "thorax"])
def test_what_a_departure_gains(shared_data: Path, name: str, label: str) -> None:
    """A row; PUBLISHED_STEPS=N in the environment takes so many steps instead of 30 000."""
    method = DEPARTURES[label]
    if (steps := os.environ.get("PUBLISHED_STEPS")) and method.steps == PUBLISHED.steps:
        method = replace(method, steps=int(steps))
    print("\n" + line(cone(shared_data, name, VIEWS, SIZE), label, method), flush=True)
