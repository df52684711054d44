"""The published comparison at the size of a CPU: classical methods, neural fields, Gaussians; one line a method.

    pytest -m bench -s tests/bench/test_published_tables.py -k "teapot-50"

Cone views with the published noise (see `quality_cases`), of SIZE³ voxels. A method runs with its defaults, and once
more so long that it takes as much processor time as any other. A neural field has this time alone: what is published
would take it half a day. In the environment, TABLE_SIZE gives the voxels, TABLE_SECONDS the processor seconds, and
TABLE_ROWS names of rows apart by commas; all if it is absent. TABLE_EQUAL=1 leaves out what splatting methods do by
default: the two published ones take a quarter of an hour. The views come from the simulator's projector.
"""

from __future__ import annotations

import math
import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import recon
from recon.assess.metrics import psnr, ssim3d
from recon.base.method import RunControl
from recon.fields.train import FieldMethod
from recon.methods import with_settings
from recon.splatting.published import R2Published, published_fit
from recon.warm_up import warm_up
from tests.bench.quality_cases import Case, cone, seen_by_simulator

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
    "IntraTomo-class": recon.IntraTomo(steps=10**6),
    "NAF": recon.NAF(steps=10**6),
    "SAX-NeRF": recon.SaxNerf(steps=10**6),
    "plain splatting": R2Published(gaussians=COUNT, fit=replace(FIT, rays=replace(FIT.rays, rectified=False))),
    "R2 as published": R2Published(gaussians=COUNT),
    "R2 of ours": recon.R2(),
}
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


def row(case: Case, label: str, method: Any) -> float:
    """Print the line of one run; its processor seconds, which are also its clock."""
    begin, wall = time.process_time(), time.perf_counter()
    with Memory() as memory:
        found = recon.reconstruct(
            case.projections, case.geometry, method, grid=case.grid, control=RunControl(now=time.process_time)
        )
    busy, wall = time.process_time() - begin, time.perf_counter() - wall
    volume = np.clip(found.volume.data, 0, None)
    work = found.history[-1].step if found.history else 1
    print(
        f"{case.name} {case.geometry.n_views} {label:28} {psnr(case.truth, volume, case.peak):6.2f} dB  "
        f"{ssim3d(case.truth, volume):.3f}  {work:6d} steps  {busy:6.1f} CPU s  {wall:6.0f} s  "
        f"{memory.grown / 1e6:5.0f} MB",
        flush=True,
    )
    return busy


@pytest.mark.parametrize("views", [75, 50, 25])
@pytest.mark.parametrize("name", ["teapot", "shell", "thorax"])
def test_the_published_methods_by_default_and_at_equal_time(shared_data: Path, name: str, views: int) -> None:
    case = cone(shared_data, name, views, SIZE, seen_by_simulator)
    print()
    for label in ROWS:
        method = METHODS[label]
        warm_up(method, case.geometry)
        if isinstance(method, FieldMethod):
            row(case, f"{label}, equal time", replace(method, seconds=SECONDS))
            continue
        busy = math.nan if EQUAL_ONLY and not hasattr(method, "iterations") else row(case, label, method)
        if method.traits.direct:
            continue
        if hasattr(method, "iterations"):
            longer = with_settings(method, {"iterations": max(1, round(method.iterations * SECONDS / busy))})
        else:
            longer = replace(method, steps=None, seconds=SECONDS)
        row(case, f"{label}, equal time", longer)
