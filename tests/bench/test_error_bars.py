"""Error bars on simulated scans: the share of voxels within one standard deviation, and the time they take.

pytest -m bench -s tests/bench/test_error_bars.py    (slabs of real samples need ../shared/data; some minutes)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

import recon
from recon.base.decisions import Decisions
from recon.base.method import ReconProblem, RunControl
from recon.base.view_data import Views
from recon.error_bars import error_bars
from recon.voxels.field_edges import busiest_rows, slab_of
from tests.bench.quality_cases import Case, dense_battery, slab

pytestmark = pytest.mark.bench
ROWS = 20
METHODS: dict[str, recon.Method] = {"fbp": recon.Fbp(), "fista-tv": recon.FistaTv(), "r2": recon.R2()}
# Sample, views, photons a pixel. The factors were chosen on twelve scans: grains, thorax, foam, shell, battery and
# kernel, of 60 to 180 views. CHOSEN are four of these. CHECKED had no part in it.
CHOSEN = [("grains", 90, 5000), ("thorax", 90, 5000), ("foam", 120, 5000), ("shell", 60, 3000)]
CHECKED = [("battery", 180, 3000), ("teapot", 120, 5000), ("kernel", 120, 4000), ("thorax", 180, 2000)]


def few_rows(case: Case) -> Case:
    """The rows with most matter."""
    rows = busiest_rows(case.projections, ROWS)
    views, box = slab_of(case.geometry, case.grid, rows.start, rows.stop)
    data, truth = np.ascontiguousarray(case.projections[:, rows]), np.ascontiguousarray(case.truth[rows])
    return replace(case, projections=data, geometry=views, grid=box, truth=truth)


def regions(truth: NDArray[np.float32]) -> dict[str, NDArray[np.bool_]]:
    """Voxels of a truth: edges, dense and weak matter that is flat, and air; those with one voxel in a hundred."""
    unit = float(np.percentile(truth[truth > 0], 99.5))
    _, y, x = np.indices(truth.shape)
    n = truth.shape[1]
    inside = np.hypot(y - (n - 1) / 2, x - (n - 1) / 2) < n / 2 - 2
    edge = maximum_filter(truth, 3) - minimum_filter(truth, 3) > 0.2 * unit
    parts = {
        "flat": truth > 0.35 * unit,
        "weak": (truth > 0.02 * unit) & (truth <= 0.35 * unit),
        "air": truth <= 0.02 * unit,
    }
    found = {"edge": edge & inside, **{name: part & ~edge & inside for name, part in parts.items()}}
    return {name: part for name, part in found.items() if part.mean() > 0.01}


def case_of(folder: Path, name: str, views: int, photons: float) -> Case:
    if name == "battery":
        return few_rows(dense_battery(views, 128, photons))
    return few_rows(slab(folder, name, views, photons))


Found = TypeVar("Found")


def timed(work: Callable[..., Found], *arguments: object) -> tuple[float, Found]:
    before = time.process_time()
    found = work(*arguments)
    return time.process_time() - before, found


@pytest.mark.parametrize(("name", "views", "photons"), CHOSEN + CHECKED)
def test_voxels_of_the_truth_within_one_deviation(shared_data: Path, name: str, views: int, photons: float) -> None:
    case = case_of(shared_data, name, views, photons)
    problem = ReconProblem(Views(case.projections, case.geometry), case.grid)
    parts = regions(case.truth)
    for label, method in METHODS.items():
        decide = Decisions(0)
        run, made = timed(method.run, problem, RunControl(decide=decide))
        bars, found = timed(error_bars, method, problem, made.volume, decide.made, RunControl())
        within = np.abs(made.volume.data - case.truth) <= found.deviation  # type: ignore[union-attr]
        shares = {part: float(within[parts[part]].mean()) for part in ("flat", "weak", "edge", "air") if part in parts}
        said = "  ".join(f"{part} {share:4.0%}" for part, share in shares.items())
        print(
            f"\n{name:8s} {views:4d} views {photons:6.0f} photons {label:9s} {said}  time x {1 + bars / run:.2f}",
            end="",
        )
        assert all(share > 0.3 for share in shares.values())
        assert not method.fitted or bars < run
