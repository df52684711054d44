"""FDK back-projection: the Triton kernel compared with the CPU kernel."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels import direct
from tests.recon.kernels.gpu.on_gpu import DEVICE

gpu = importlib.import_module("recon.kernels.gpu.back_project")

ANGLES = [0.0, 0.7, np.pi / 2, -2.2]
SHIFTS = [[0.0, 0.0], [1.3, -0.8], [-0.4, 0.6], [2.0, 1.0]]
LEANS = {"roll": [0.0, 0.2, -0.1, 1.4], "tilt": [0.1, 0.0, 0.3, -0.4]}
SHAPE = (7, 12)


def _parallel(**where: Any) -> Geometry:
    return Geometry.parallel(ANGLES, SHAPE, pixel_pitch=0.7, axis_col=5.1, axis_row=3.4, shifts=SHIFTS, **where)


def _cone(**where: Any) -> Geometry:
    return Geometry.cone(ANGLES, SHAPE, 1.1, 22.0, 45.0, axis_col=5.1, axis_row=3.4, shifts=SHIFTS, **where)


CASES = {
    "cone": (_cone(), Grid((7, 9, 11), 0.55)),
    "leaning cone": (_cone(**LEANS), Grid((6, 9, 11), 0.55)),
    "leaning, parallel": (_parallel(**LEANS), Grid((5, 10, 9), 0.7)),
    "off the axis": (_cone(**LEANS), Grid((5, 9, 8), 0.6, (0.4, 1.5, -1.2), 0.5)),
    "wider than the field": (_cone(**LEANS), Grid((12, 20, 19), 0.7)),
    "one slice": (_cone(), Grid((1, 18, 9), 0.55)),
    "fan": (Geometry.fan(ANGLES, 20, 1.1, 22.0, 45.0, axis_col=8.0), Grid((1, 17, 19), 0.55)),
    "one pixel": (Geometry.cone(ANGLES, (1, 1), 9.0, 22.0, 45.0), Grid((5, 6, 4), 0.9)),
    "out of sight": (_cone(), Grid((4, 5, 6), 0.7, (12.0, 0.0, 0.0))),
}  # fmt: skip


def _arguments(name: str, rng: np.random.Generator) -> list[Any]:
    """What both kernels take before the volume, with random views."""
    geometry, grid = CASES[name]
    filtered = rng.normal(size=(geometry.n_views, *geometry.detector_shape[::-1])).astype(np.float32)
    each, (z, y, x) = range(geometry.n_views), grid.coordinates()
    axes, origins = (np.array([of(v) for v in each]) for of in (geometry.axes, geometry.origin))
    distances = (geometry.sod, geometry.sdd) if geometry.is_cone else (0.0, 0.0)
    return [filtered, axes, origins, *distances, geometry.pixel_pitch, x, y, z]


def _added(arguments: list[Any], to: np.ndarray) -> np.ndarray:
    there, (filtered, *others) = torch.tensor(to, device=DEVICE), arguments
    gpu.back_project(torch.tensor(filtered, device=DEVICE), *others, there)
    return there.cpu().numpy()


@pytest.mark.parametrize("name", CASES)
def test_voxels_sum_what_they_do_on_the_cpu(name: str, rng: np.random.Generator) -> None:
    arguments = _arguments(name, rng)
    before = rng.normal(size=[c.size for c in (arguments[-2], arguments[-3], arguments[-1])]).astype(np.float32)
    expected = before.copy()
    direct._along_rays(*arguments, expected)
    assert (expected != before).any() == (name != "out of sight")
    found = _added(arguments, before)
    if name == "wider than the field":
        assert (expected == before).any()
        np.testing.assert_array_equal(found == before, expected == before)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * float(np.abs(expected).max()))


@pytest.mark.parametrize("name", ["cone", "leaning cone", "leaning, parallel"])
def test_views_are_filtered_as_on_the_cpu(name: str, rng: np.random.Generator) -> None:
    geometry, zeros, (rows, cols) = CASES[name][0], (3, 0), SHAPE
    views, weights = rng.normal(size=(4, cols, rows)).astype(np.float32).swapaxes(1, 2), rng.random((4, cols))
    views.setflags(write=False)  # as of a file in memory
    responses = [direct._response(rows, cols + 3, float(roll), geometry.sample_pitch, "hann") for roll in geometry.roll]
    found = gpu.filtered(views, geometry, weights, zeros, responses)
    expected = [direct._prepared(views[v], geometry, v, weights[v], zeros, responses[v]) for v in range(4)]
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=0, atol=1e-6 * float(np.max(expected)))


@pytest.mark.parametrize(("roll", "shape"), [(0.0, (2048, 4)), (np.pi / 2, (4, 2048))], ids=["rows", "columns"])
def test_voxels_of_a_high_box_are_placed_to_a_fraction_of_a_pixel(roll: float, shape: tuple[int, int]) -> None:
    """By a view whose pixels are 0 and 1 in turn, which shows where between two of them a voxel is."""
    geometry = Geometry.cone([0.4], shape, 1.0, 9000.0, 10_000.0, shifts=[[0.3, 0.4]], tilt=0.1, roll=roll)
    filtered = (np.indices(shape[::-1])[int(np.argmax(shape[::-1]))] % 2)[None].astype(np.float32)
    z, y, x = Grid((2048, 1, 1), 0.899).coordinates()
    where = geometry.axes(0)[None], np.array([geometry.origin(0)])
    arguments = [filtered, *where, geometry.sod, geometry.sdd, 1.0, x, y, z]
    expected = np.zeros((1, 1, 2048), np.float32)
    direct._along_rays(*arguments, expected)
    assert np.unique(expected.round(2)).size > 90
    found = _added(arguments, 0 * expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)


def test_the_same_input_gives_the_same_bits(rng: np.random.Generator) -> None:
    arguments, empty = _arguments("leaning cone", rng), np.zeros((9, 11, 6), np.float32)
    np.testing.assert_array_equal(_added(arguments, empty), _added(arguments, empty))


def test_no_views_change_nothing(rng: np.random.Generator) -> None:
    filtered, axes, origins, *others = _arguments("cone", rng)
    before = rng.normal(size=(9, 11, 7)).astype(np.float32)
    np.testing.assert_array_equal(_added([filtered[:0], axes[:0], origins[:0], *others], before), before)
