"""Wide detectors: CPU seconds per slice, and memory in addition to projections and volume; pytest -m bench -s."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.fbp import Filter, fbp_block, fbp_memory, is_gridded, plan_fbp


@pytest.mark.bench
@pytest.mark.parametrize(("views", "cols"), [(900, 256), (900, 512), (900, 1024), (900, 2048), (1800, 2048)])
@pytest.mark.parametrize("filter", ["hann"])
def test_fbp(views: int, cols: int, filter: Filter) -> None:
    rows = 16
    geometry = Geometry.parallel(np.arange(views) * np.pi / views, (rows, cols))
    data = np.random.default_rng(0).random((views, rows, cols), dtype=np.float32)
    volume = np.empty((rows, cols, cols), np.float32)
    tracemalloc.start()
    begin = time.process_time()
    plan = plan_fbp(geometry, Grid.matching(geometry), filter)
    planned, busy = time.process_time() - begin, []
    for _ in range(4):  # the first compiles
        begin = time.process_time()
        fbp_block(plan, data, 0, plan.blocks[0], volume)
        busy.append((time.process_time() - begin) / rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    way = "gridded" if is_gridded(geometry, plan.grid, filter) else "ray by ray"
    print(
        f"\n{views} views, {cols} columns, {way}: plan {planned:.2f} CPU s, {np.median(busy[1:]):.4f} CPU s a slice "
        f"(best {min(busy):.4f}), {peak / 1e9:.2f} GB, {fbp_memory(views, cols) / 1e9:.2f} expected"
    )
    assert peak < 1.2 * fbp_memory(views, cols)
