"""What is measured is what is said: medians on a given clock, pairs counted, a sample whose answer is known."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from recon.base.volume import Grid, Volume
from recon.features.bench.bench import kernel_timings, spheres, standard_case, step_timing, timed, volume_rows
from recon.splatting.r2 import R2
from recon.splatting.splat import project
from recon.voxels.direct import Fbp
from recon.voxels.projector import data_residual


def test_the_median_on_a_clock_of_known_ticks() -> None:
    """Calls take 1, 2, ... ms; the first is not counted."""
    time, calls = 0.0, 0

    def now() -> float:
        return time

    def call() -> None:
        nonlocal time, calls
        calls += 1
        time += 1e-3 * calls

    found = timed("x", call, now, repeats=5, pairs=1e6)
    assert calls == 6
    assert [found.ms, found.spread_ms] == pytest.approx([4.0, 2.0])
    assert found.ns_per_pair == pytest.approx(4.0)
    assert math.isnan(timed("x", call, now).ns_per_pair)


def test_the_standard_case_has_the_pairs_that_its_images_show() -> None:
    """A box reaches 3.5 standard deviations at most, so that pairs lie between those of 2 and of 3.5."""
    timings = {t.name: t for t in kernel_timings(time.perf_counter, n=400, side=48, repeats=2)}
    assert set(timings) == {"footprints", "forward", "backward"}
    pairs = timings["forward"].pairs / 400
    assert (2 * 2 * 1.2) ** 2 < pairs < (2 * 3.5 * 2.2) ** 2
    assert all(t.ms > 0 for t in timings.values())
    gaussians, view = standard_case(400, 48)
    assert project(gaussians, view).numpy().max() > 0


def test_a_step_takes_longer_than_its_kernels_and_is_timed_by_its_own_record() -> None:
    found = step_timing(time.perf_counter, n=300, side=32, repeats=2, steps=4)
    assert 0 < found.ms < 5000


def test_the_sample_and_its_views_belong_together() -> None:
    """The voxel projector, which knows nothing of spheres, finds the line integrals of the sample again."""
    data, geometry, truth = spheres(64, 24, 12, math.inf)
    grid = Grid.matching(geometry)
    apart = data_residual(Volume(truth, grid), data, geometry)
    assert apart < 0.02  # spheres of 1.3 pixels and more have edges that voxels only approach
    for axis in range(3):  # one voxel off in any direction is something else
        assert data_residual(Volume(np.roll(truth, 1, axis), grid), data, geometry) > 3 * apart
    noisy, _, _ = spheres(64, 24, 12, 1e4)
    # Of n counted photons -log n scatters by 1 / sqrt(n).
    expected = np.sqrt(np.exp(data) / 1e4)
    assert np.std((noisy - data) / expected) == pytest.approx(1, abs=0.03)


def test_rows_of_quality(monkeypatch: pytest.MonkeyPatch) -> None:
    small = spheres(32, 8, 12)
    monkeypatch.setattr("recon.features.bench.bench.spheres", lambda: small)
    rows = list(volume_rows(time.perf_counter, (Fbp(), R2(steps=3), R2(steps=40))))
    assert [row.method for row in rows] == ["fbp", "r2", "r2"]
    assert rows[2].psnr > rows[1].psnr
    assert rows[1].settings.startswith("3 steps, ") and rows[0].settings == ""
