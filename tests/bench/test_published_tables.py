"""The published comparison at the size of a CPU: classical methods, neural fields, Gaussians; one line a method.

    pytest -m bench -s tests/bench/test_published_tables.py -k "teapot-50"
    pytest -m bench -s tests/bench/test_published_tables.py -k "walnut_halved-50"

Cone views with the published noise (see `quality_cases`), of SIZE³ voxels. A method runs with its defaults, and once
more so long that it takes as much processor time as any other. Neural fields, where splatline_neural is installed, have
this time alone: what is published would take them half a day. In the environment, TABLE_SIZE gives the voxels,
TABLE_SECONDS the processor seconds (0: by default alone), and TABLE_ROWS names of rows apart by commas; all if it is
absent. TABLE_EQUAL=1 leaves out what splatting methods do by default: the two published ones take a quarter of an hour.
The views come from the simulator's projector. Of real scans, the walnut is compared with an FDK of all views, Diamond
with views held out.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import recon
from recon.assess.metrics import psnr, ssim2d, ssim3d
from recon.base.method import DataUse, RunControl
from recon.features.published.r2_published import R2Published, published_fit
from recon.methods import with_settings
from recon.warm_up import warm_up
from tests.bench.quality_cases import F32, Case, cone, diamond, seen_by_simulator, walnut_halved

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]
SIZE, SECONDS = int(os.environ.get("TABLE_SIZE", "64")), float(os.environ.get("TABLE_SECONDS", "60"))
EQUAL_ONLY = os.environ.get("TABLE_EQUAL") == "1"
FIT = published_fit()
COUNT = max(2000, round(50_000 * (SIZE / 256) ** 3))  # as many Gaussians a voxel as published
METHODS: dict[str, Any] = {
    "FDK": recon.Fbp(),
    "SART": recon.Sart(),
    "ASD-POCS": recon.AsdPocs(),
    "SIRT": recon.Sirt(),
    "FISTA-TV": recon.FistaTv(),
    "plain splatting": R2Published(gaussians=COUNT, fit=replace(FIT, rays=replace(FIT.rays, rectified=False))),
    "R2 as published": R2Published(gaussians=COUNT),
    "R2 of ours": recon.R2(),
}
FIELDS: tuple[str, ...] = ()
if find_spec("splatline_neural"):
    neural = import_module("splatline_neural")
    fields = {"IntraTomo-class": neural.IntraTomo, "NAF": neural.NAF, "SAX-NeRF": neural.SaxNerf}
    METHODS |= {label: kind(steps=10**6) for label, kind in fields.items()}
    FIELDS = tuple(fields)
ROWS = os.environ.get("TABLE_ROWS", ",".join(METHODS)).split(",")


class Memory:
    """Largest growth of this process's memory within a context, in bytes, looked at every 20 ms."""

    def __enter__(self) -> Memory:
        self._process, self._over = psutil.Process(), threading.Event()
        self._first = self.most = self._process.memory_info().rss
        self._watch = threading.Thread(target=self._look)
        self._watch.start()
        return self

    def _look(self) -> None:
        while not self._over.wait(0.02):
            self.most = max(self.most, self._process.memory_info().rss)

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._watch.join()
        self.grown = self.most - self._first


def figures(case: Case, volume: F32) -> tuple[float, float]:
    """PSNR in dB and SSIM; without a truth -20 log10 of the residual of unseen views, and their mean SSIM."""
    if case.unseen is None:
        clipped = np.clip(volume, 0, None)
        return psnr(case.truth, clipped, case.peak), ssim3d(case.truth, clipped)
    measured, geometry, counts = case.unseen
    taller = np.pad(volume, ((1, 1), (0, 0), (0, 0)), "edge")  # the simulator's slices fade into the air above
    seen = seen_by_simulator(taller, geometry, case.grid.voxel_size)
    residual = np.linalg.norm((seen - measured)[counts]) / np.linalg.norm(measured[counts])
    alike = [ssim2d(one, other) for one, other in zip(measured, np.where(counts, seen, measured), strict=True)]
    return -20 * math.log10(residual), float(np.mean(alike))


def row(case: Case, label: str, method: Any) -> int:
    """Print the line of one run, whose clock are processor seconds; the iterations that SECONDS are enough for."""
    begin, wall = time.process_time(), time.perf_counter()
    with Memory() as memory:
        found = recon.reconstruct(
            case.projections,
            case.geometry,
            method,
            grid=case.grid,
            use=DataUse(case.weights),
            control=RunControl(now=time.process_time),
        )
    busy, wall = time.process_time() - begin, time.perf_counter() - wall
    quality, alike = figures(case, found.volume.data)
    assert quality > figures(case, 0 * found.volume.data)[0], "an empty volume is as good"
    work = found.history[-1].step if found.history else 1
    print(
        f"{case.name} {case.geometry.n_views} {label:28} {quality:6.2f} dB  {alike:.3f}  "
        f"{work:6d} steps  {busy:6.1f} CPU s  {wall:6.0f} s  "
        f"{memory.grown / 1e6:5.0f} MB",
        flush=True,
    )
    at = {progress.step: progress.seconds for progress in found.history}  # a fit reports its last step twice
    if len(at) < 2:
        return 0
    pace = float(np.median(np.diff(list(at.values())) / np.diff(list(at))))  # the first step may have compiled
    return max(1, round((SECONDS - busy) / pace) + work)


@pytest.mark.parametrize("views", [75, 50, 25])
@pytest.mark.parametrize("name", ["teapot", "shell", "thorax"])
def test_the_published_methods_by_default_and_at_equal_time(shared_data: Path, name: str, views: int) -> None:
    rows_of(cone(shared_data, name, views, SIZE, seen_by_simulator))


@pytest.mark.parametrize("views", [75, 50, 25])
@pytest.mark.parametrize("scan", [walnut_halved, diamond])
def test_the_published_methods_on_real_scans(shared_data: Path, scan: Callable[[Path, int], Case], views: int) -> None:
    rows_of(scan(shared_data, views))


def rows_of(case: Case) -> None:
    """Each method of ROWS with its defaults, and at equal time."""
    print()
    for label in ROWS:
        method = METHODS[label]
        warm_up(method, case.geometry, weighted=case.weights is not None)
        if label in FIELDS:
            row(case, f"{label}, equal time", replace(method, seconds=SECONDS))
            continue
        enough = 0 if EQUAL_ONLY and not hasattr(method, "iterations") else row(case, label, method)
        if not method.fitted or not SECONDS:
            continue
        if hasattr(method, "iterations"):
            longer = with_settings(method, {"iterations": enough})
        else:
            longer = replace(method, steps=None, seconds=SECONDS)
        row(case, f"{label}, equal time", longer)
