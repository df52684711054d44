"""The table of README: what a user would take instead, on volumes that no setting was tuned on.

pytest -m bench -s tests/bench/test_front_page.py [-k thorax]; 50 views, 10⁵ photons, one thread. FISTA-TV has the
weight of six that is best by the truth, which a user does not have. With PUBLISHED=1 in the environment, R² as
published, too, which takes many minutes.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base.method import Method
from recon.features.published.r2_published import R2Published
from recon.warm_up import warm_up
from tests.bench.quality_cases import SLABS, Case
from tests.bench.test_patch_prior import HELD_BACK, TEXTURED

WEIGHTS = 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2
COUNT = 50_000 / 256**3  # published Gaussians a voxel


def _made(case: Case, method: Method) -> tuple[float, float]:
    """PSNR of the volume in dB, and its CPU seconds."""
    warm_up(method, case.geometry, weighted=False)
    begin = time.process_time()
    made = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid)
    seconds = time.process_time() - begin
    return psnr(case.truth, np.maximum(made.volume.data, 0), case.peak), seconds


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", list(HELD_BACK))
def test_what_a_user_would_take_instead(shared_data: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for textured, load in TEXTURED.items():
        monkeypatch.setitem(SLABS, textured, load)
    case = HELD_BACK[name](shared_data, name)
    by_weight = {weight: _made(case, recon.FistaTv(tv_weight=weight)) for weight in WEIGHTS}
    best = max(by_weight, key=lambda weight: by_weight[weight][0])
    assert best not in (WEIGHTS[0], WEIGHTS[-1])
    rows = {
        "FBP, Ram-Lak": _made(case, recon.Fbp(filter="ram-lak")),
        "FISTA-TV, best weight": by_weight[best],
        "splatline": _made(case, recon.Auto()),
    }
    if os.environ.get("PUBLISHED"):
        rows["R² as published"] = _made(case, R2Published(gaussians=max(2000, round(COUNT * case.truth.size))))
    for label, (quality, seconds) in rows.items():
        print(f"\n| {name} {case.truth.shape} | {label} | {quality:.2f} dB | {seconds:.1f} CPU s |", end="", flush=True)
    assert rows["splatline"][0] > rows["FBP, Ram-Lak"][0]
