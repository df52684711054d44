"""The CPU backend follows the protocol: copies, shared memory, sums; and which device gets which backend."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from numba import get_num_threads, set_num_threads

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel
from recon.base.volume import Grid
from recon.splatting.backend import Cpu, backend_for
from recon.splatting.gaussians import Gaussians
from tests.recon.conftest import Make

UNIT = 0.7
CUT = (1e-3, 3.5)  # faint, σ


def begin(backend: Cpu, g: Gaussians):  # type: ignore[no-untyped-def]
    of = g.arrays()
    return backend.begin(of["means"], of["log_scales"], of["quaternions"], of["raw_densities"], UNIT)


def geometry(shape: tuple[int, int]) -> Geometry:
    return Geometry.parallel([0.7, 1.9], shape, pixel_pitch=0.5)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_misfit_is_the_ratio_of_norms(weighted: bool, rng: np.random.Generator) -> None:
    image, target, w = rng.normal(size=(3, 9, 14)).astype(np.float32)
    weights = np.abs(w) if weighted else None
    factor = 1.0 if weights is None else weights.astype(np.float64)
    expected = np.linalg.norm(factor * (image.astype(np.float64) - target)) / np.linalg.norm(factor * target)
    assert Cpu().misfit(image, target, weights) == pytest.approx(expected, rel=1e-6)
    assert Cpu().misfit(image, np.zeros_like(image), weights) == 0


def test_arrays_come_and_go_as_copies() -> None:
    values = np.ones(4, np.float32)
    array = Cpu().array(values)
    back = Cpu().numpy(array)
    values[0], array[1] = 5, 6
    np.testing.assert_array_equal(array, [1, 6, 1, 1])
    np.testing.assert_array_equal(back, 1)


def test_views_of_any_shape_one_after_the_other_are_those_of_a_fresh_backend(
    random_gaussians: Make, rng: np.random.Generator
) -> None:
    # Detectors and models of other sizes take turns, as in a fit that begins on binned pixels and then grows.
    backend, models = Cpu(), (random_gaussians(30, 8.0), random_gaussians(45, 8.0))
    for g, shape, view in ((0, (15, 22), 0), (1, (15, 22), 1), (1, (31, 9), 0), (0, (15, 22), 1), (0, (15, 22), 0)):
        slope = rng.normal(size=shape).astype(np.float32)
        results = []
        for source in (backend, Cpu()):
            run = begin(source, models[g])
            seen = run.view(geometry(shape), view, *CUT, RayModel())
            image = seen.image.copy()
            results.append((image, seen.backward(slope), *run.gradients()))
        for ours, fresh in zip(*results, strict=True):
            np.testing.assert_array_equal(ours, fresh)


def test_memory_made_for_other_threads_gives_the_same_view(random_gaussians: Make) -> None:
    g, views, threads = random_gaussians(30, 8.0), geometry((15, 22)), get_num_threads()
    backend, images = Cpu(), []
    try:
        for count in (1, threads, 1):
            set_num_threads(count)
            images.append(begin(backend, g).view(views, 0, *CUT, RayModel()).image)
    finally:
        set_num_threads(threads)
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], atol=1e-6 * float(images[0].max()))


def test_a_box_leaves_positions_alone_where_asked(random_gaussians: Make, rng: np.random.Generator) -> None:
    g, grid = random_gaussians(20, 8.0), Grid((6, 7, 8), 0.9)
    slope, found = rng.normal(size=grid.shape).astype(np.float32), []
    for means_too in (True, False):
        run = begin(Cpu(), g)
        run.box(grid, *CUT).backward(slope, means_too=means_too)
        found.append(run.gradients())
    assert found[0][0].any() and not found[1][0].any()
    for with_means, without in zip(found[0][1:], found[1][1:], strict=True):
        np.testing.assert_array_equal(with_means, without)


def test_devices_without_a_backend_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(backend_for("cpu"), Cpu)
    for unknown in ("mps", "gpu", "CUDA", "cuda1", "cuda:", "cuda:one", "cuda:-1", "cuda:0,1", ""):
        with pytest.raises(ValueError, match=rf"must be 'cpu' or 'cuda', got '{unknown}'"):
            backend_for(unknown)
    for name in [name for name in sys.modules if name.startswith("recon.kernels.gpu")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "triton", None)  # as if it were not installed
    for device in ("cuda", "cuda:1"):
        with pytest.raises(ImportError, match=r"splatline\[gpu\]"):
            backend_for(device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without a CUDA device")
@pytest.mark.parametrize("device", ["cuda", "cuda:0", "cuda:1"])
def test_a_cuda_device_that_is_not_there_is_said_by_name(device: str) -> None:
    pytest.importorskip("triton")
    from recon.kernels import gpu

    if gpu.interpreted():
        pytest.skip("the interpreter stands in for any device")
    with pytest.raises(RuntimeError, match=rf"{device}.*CUDA.*cpu"):
        backend_for(device)
