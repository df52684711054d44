"""How fast the GPU kernels and a step are; run on a CUDA machine with  pytest -m "gpu and bench" -s tests/bench."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
import torch

from recon.backend import backend_for
from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.volume import Grid

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.bench,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def _median_ms(call: Callable[[], object], repeats: int = 51) -> tuple[float, float]:
    """Median and the spread between the quartiles, in ms of wall time; the first calls compile and do not count."""
    for _ in range(3):
        call()
    torch.cuda.synchronize()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - begin))
    low, middle, high = np.percentile(times, (25, 50, 75))
    return float(middle), float(high - low)


def _device_ms(call: Callable[[], object], repeats: int = 50) -> float:
    """Mean ms on the device with launches queued ahead, so that what the host needs for each is hidden if shorter."""
    for _ in range(3):
        call()
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize()
    begin.record()
    for _ in range(repeats):
        call()
    end.record()
    torch.cuda.synchronize()
    return float(begin.elapsed_time(end)) / repeats


def _bytes_a_second() -> float:
    """What a plain copy reaches on this device, reading and writing."""
    source = torch.empty(2**26, device="cuda")
    target = torch.empty_like(source)
    return 2 * 4 * 2**26 / (1e-3 * _device_ms(lambda: target.copy_(source)))


def _model(n: int, extent: float) -> tuple[list[torch.Tensor], float]:
    """n Gaussians in a cylinder's cube, boxes of 9 to 15 pixels, ordered in space as a fit orders them."""
    rng = np.random.default_rng(0)
    means = (rng.random((n, 3)) - 0.5) * extent
    means = means[np.lexsort((means[:, 0] // 16, means[:, 1] // 16, means[:, 2] // 16))]
    g = Gaussians.from_physical(means, rng.uniform(1.2, 2.2, (n, 3)), rng.uniform(0.5, 1, n), rng.normal(size=(n, 4)))
    tensors = (g.means, g.log_scales, g.quaternions, g.raw_densities)
    return [tensor.cuda().contiguous() for tensor in tensors], g.density_unit


@pytest.mark.parametrize(("n", "side"), [(20_000, 512), (50_000, 256), (200_000, 512)])
def test_kernels(n: int, side: int) -> None:
    from recon.kernels.gpu.images import render  # this module must load where triton is missing

    # 20k on 512 x 512 is the published case: 0.31 ms forward and 0.44 ms backward (FaCT-GS, device not stated).
    rate = _bytes_a_second()
    backend = backend_for("cuda")
    raw, unit = _model(n, 0.86 * side)
    view, grid = Geometry.parallel([0.7], (side, side)), Grid((32, 32, 32))
    run = backend.begin(*raw, unit)
    seen, placed = run.view(view, 0, 1e-3, 3.5), run.box(grid, 1e-3, 3.5)
    slope, target, box = (torch.randn(*shape, device="cuda") for shape in ((side, side), (side, side), (32, 32, 32)))
    loss = backend.projection_loss((side, side), 0.25)
    maps = loss.target_maps(target)
    spans = seen.footprints.table[:, 6:8].clamp(min=0).double() * 2
    pairs = float(spans.prod(1).sum())
    moments = [[torch.zeros_like(p) for p in raw] for _ in range(2)]
    floats = 11 * n
    # Least traffic in bytes: what must be read and written once, were everything else free.
    calls: list[tuple[str, Callable[[], object], float]] = [
        ("activate", lambda: backend.begin(*raw, unit), 4 * (11 + 16 + 16) * n),
        ("footprints and render", lambda: run.view(view, 0, 1e-3, 3.5), 4 * (40 * n + side * side)),
        ("of that, render", lambda: render(seen.footprints, (side, side)), 4 * (12 * n + side * side)),
        ("moments and backward", lambda: seen.backward(slope), 4 * (74 * n + side * side)),
        ("L1 and SSIM", lambda: loss(slope, target, maps), 4 * 5 * side * side),
        ("box: place, fill", lambda: run.box(grid, 1e-3, 3.5), 4 * (16 + 22) * n),
        ("box: total variation", lambda: backend.total_variation(box, 0.1), 4 * 2 * 32**3),
        ("box: backward", lambda: placed.backward(box), 4 * 6 * n),
        ("gradients", lambda: run.gradients(), 4 * (15 + 5) * n),
        ("adam", lambda: backend.adam(raw, raw, *moments, (0.0,) * 4, 10), 4 * 7 * floats),
    ]
    print(f"\n{torch.cuda.get_device_name()}, copy {rate / 1e9:.0f} GB/s; {n} Gaussians on {side}², {pairs:.3g} pairs")
    for name, call, traffic in calls:
        wall, spread = _median_ms(call)
        device = _device_ms(call)
        print(
            f"{name:22s} {wall:7.3f} ms alone (quartiles {spread:.3f}), {device:7.3f} ms queued, "
            f"bandwidth floor {1e3 * traffic / rate:.4f} ms"
        )
        assert device > 0


def test_a_whole_volume() -> None:
    # Published: 1.5 ms forward and 5.6 ms backward for 20k Gaussians in 256³ (FaCT-GS, device not stated).
    backend = backend_for("cuda")
    raw, unit = _model(20_000, 220)
    run = backend.begin(*raw, unit)
    grid = Grid((256, 256, 256))
    placed = run.box(grid, 1e-3, 3.5)
    slope = torch.randn(256, 256, 256, device="cuda")
    print(f"\n{torch.cuda.get_device_name()}; 20000 Gaussians in 256³")
    for name, call in (("place, fill", lambda: run.box(grid, 1e-3, 3.5)), ("backward", lambda: placed.backward(slope))):
        wall, spread = _median_ms(call)
        print(f"{name:22s} {wall:7.3f} ms (quartiles {spread:.3f})")
        assert wall > 0


@pytest.mark.parametrize(("n", "side"), [(50_000, 256), (50_000, 512)])
def test_a_step_and_thirty_thousand(n: int, side: int) -> None:
    backend = backend_for("cuda")
    raw, unit = _model(n, 0.86 * side)
    rng = np.random.default_rng(1)
    views = Geometry.parallel(np.linspace(0, np.pi, 50, endpoint=False), (side, side))
    loss = backend.projection_loss((side, side), 0.25)
    target = backend.array(rng.random((side, side)).astype(np.float32))
    maps = loss.target_maps(target)
    first, second = ([torch.zeros_like(p) for p in raw] for _ in range(2))
    taken = 0

    def step() -> None:
        nonlocal taken
        taken += 1
        run = backend.begin(*raw, unit)
        seen = run.view(views, taken % views.n_views, 1e-3, 3.5)
        _, slope = loss(seen.image, target, maps)
        seen.backward(slope)
        corner = rng.uniform(-0.4 * side, 0.4 * side, 3)
        box = run.box(Grid((32, 32, 32), 1.0, tuple(corner)), 1e-3, 3.5)
        _, slope = backend.total_variation(box.density, 0.1)
        box.backward(slope)
        backend.adam(raw, run.gradients(), first, second, (1e-4,) * 4, taken)

    torch.cuda.reset_peak_memory_stats()
    middle, spread = _median_ms(step)
    begin = time.perf_counter()
    for _ in range(1000):
        step()
    torch.cuda.synchronize()
    queued = time.perf_counter() - begin
    memory = torch.cuda.max_memory_allocated() / 2**20
    print(
        f"\n{torch.cuda.get_device_name()}; {n} Gaussians on {side}²: a step {middle:.3f} ms (quartiles {spread:.3f}), "
        f"1000 steps {queued:.2f} s, so 30 000 in {30 * queued:.0f} s; peak {memory:.0f} MiB"
    )
    assert queued > 0
