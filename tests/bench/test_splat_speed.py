"""How fast the splat kernels are; run with  pytest -m bench -s tests/bench."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.kernels.project_cpu import moments, render
from recon.splat import Active, view_table

N, SIDE = 50_000, 256


def _median_ms(call: Callable[[], object], repeats: int = 31) -> tuple[float, float]:
    """Median and the spread between the quartiles, in ms; the first call compiles and does not count."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    low, middle, high = np.percentile(times, (25, 50, 75))
    return float(middle), float(high - low)


@pytest.mark.bench
def test_projection_and_its_backward_pass() -> None:
    # 50k Gaussians with boxes of 9 to 15 pixels, ordered in space, on 256 x 256: the standard case of the project.
    rng = np.random.default_rng(0)
    means = (rng.random((N, 3)) - 0.5) * 220
    means = means[np.argsort((means[:, 2] // 16) * 1000 + means[:, 0] // 16)]
    g = Gaussians.from_physical(means, rng.uniform(1.2, 2.2, (N, 3)), rng.uniform(0.5, 1, N), rng.normal(size=(N, 4)))
    a = g.arrays()
    active = Active.of(a["means"], a["log_scales"], a["quaternions"], a["raw_densities"], g.density_unit)
    view = Geometry.parallel([0.7], (SIDE, SIDE))
    table = view_table(active, view, 0, 1e-3, 3.5)
    image = np.empty((SIDE, SIDE), np.float32)
    slope = rng.normal(size=image.shape).astype(np.float32)
    pairs = float((2 * np.maximum(table[:, 6], 0) * 2 * np.maximum(table[:, 7], 0)).sum())
    for name, call in (
        ("footprints", lambda: view_table(active, view, 0, 1e-3, 3.5)),
        ("render", lambda: render(table, image)),
        ("moments", lambda: moments(table, slope)),
    ):
        middle, spread = _median_ms(call)
        print(
            f"{name:11s} {middle:6.2f} ms (quartiles {spread:.2f}), {1e6 * middle / pairs:.3f} ns a pair of {pairs:.3g}"
        )
        assert math.isfinite(middle)
