"""Lists of what touches a tile: each box in every tile it touches, and long lists shared out."""

from __future__ import annotations

import importlib

import numpy as np
import torch

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.helpers import in_double
from tests.recon.kernels import reference
from tests.recon.kernels.gpu.on_gpu import AFFINE, DEVICE, WHOLE, raw_of, reference_view

engine = importlib.import_module("recon.kernels.gpu.engine")
tiles = importlib.import_module("recon.kernels.gpu.tiles")


def test_tile_lists_hold_each_box_in_every_tile_it_touches(rng: np.random.Generator) -> None:
    for shape, edge in (((19, 26), 8), ((5, 17, 9), 4), ((1, 1), 8)):
        low = np.stack([rng.integers(0, size, 60) for size in shape], 1)
        high = np.minimum(low + rng.integers(0, 12, low.shape), shape)
        boxes = np.stack((low, high), 2).reshape(60, -1).astype(np.int32)
        boxes[~(high > low).all(1)] = 0
        lists = tiles.tile_lists(torch.from_numpy(boxes).to(DEVICE), shape, edge)
        expected: dict[int, list[int]] = {t: [] for t in range(lists.n_tiles)}
        for i, box in enumerate(boxes.reshape(60, -1, 2)):
            covered = np.zeros(shape, bool)
            covered[tuple(slice(a, b) for a, b in box)] = True
            for t in {int(np.ravel_multi_index(tuple(at // edge), lists.counts)) for at in np.argwhere(covered)}:
                expected[t].append(i)
        starts, owners = lists.starts.cpu().numpy(), lists.owners.cpu().numpy()
        assert starts[-1] == owners.size
        for t, wanted in expected.items():
            assert owners[starts[t] : starts[t + 1]].tolist() == wanted


def test_a_long_list_is_shared_out_and_sums_to_the_same() -> None:
    rng = np.random.default_rng(2)
    g = Gaussians.from_physical(rng.uniform(-3, 3, (90, 3)), rng.uniform(0.8, 2, (90, 3)), rng.uniform(0.2, 1, 90))
    geometry, grid = Geometry.parallel([0.5], (7, 8)), Grid((4, 5, 6))
    run = engine.GpuPass(*(t.detach() for t in raw_of(g, DEVICE)), g.density_unit)
    view, box = run.view(geometry, 0, *WHOLE, AFFINE), run.box(grid, *WHOLE)
    boxes = view.footprints.boxes
    assert tiles.tile_lists(boxes, (7, 8), 8).shares > 1
    assert tiles.tile_lists(torch.zeros_like(boxes), (7, 8), 8).shares == 1
    double = in_double(g)
    expected = reference_view(double, geometry, 0).detach()
    np.testing.assert_allclose(view.image.cpu(), expected, rtol=2e-6)
    z, y, x = (torch.from_numpy(axis) for axis in grid.coordinates())
    volume = reference.voxelize(double.means, double.scales, double.quaternions, double.densities, (z, y, x)).detach()
    np.testing.assert_allclose(box.density.cpu(), volume, rtol=2e-6)
