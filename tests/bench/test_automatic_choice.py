"""`recon.Auto` beside its candidates: how far its choice stays behind the best of them, on scans of many kinds.

Run with  pytest -m bench -s tests/bench/test_automatic_choice.py  (an hour). A row holds the PSNR of each candidate
with its defaults on the whole scan, what the choice was, and what it lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.auto import Auto
from recon.base.method import DataUse, Method, ReconProblem, RunControl
from tests.bench.quality_cases import OBJECTS, SLABS, Case, cone, dense_battery, slab, walnut

_LOSS, _SHARE = 0.3, 0.95


def _cases(folder: Path) -> list[Case]:
    slabs = [slab(folder, name, views, photons) for name in SLABS for views, photons in ((50, 5000), (120, 1000))]
    cones = [cone(folder, name, views, 128) for name in OBJECTS for views in (25, 50, 75)]
    return [
        *slabs,
        *cones,
        *(walnut(folder, views) for views in (25, 50, 75)),
        *(dense_battery(views) for views in (45, 90)),
    ]


@pytest.mark.bench
@pytest.mark.timeout(7200)
def test_the_choice_is_near_the_best_of_its_candidates(shared_data: Path) -> None:
    losses, auto = [], Auto()
    for case in _cases(shared_data):

        def quality(method: Method, case: Case = case) -> float:
            volume = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid).volume.data
            return psnr(case.truth, np.maximum(volume, 0), case.peak)

        found = {method: quality(method) for method in auto.candidates}
        problem = ReconProblem(case.projections, case.geometry, case.grid, DataUse(), 0, "cpu")
        chosen = auto.candidates[auto.choose(problem, RunControl())[0]]
        losses.append(max(found.values()) - found[chosen])
        listed = ", ".join(f"{method.name} {value:.2f}" for method, value in found.items())
        print(f"{case.name}, {case.geometry.n_views} views: {listed} dB; {chosen.name}: {-losses[-1]:+.2f}", flush=True)
    near = np.mean(np.array(losses) <= _LOSS)
    print(f"within {_LOSS} dB of the best: {near:.0%} of {len(losses)}")
    assert near >= _SHARE
