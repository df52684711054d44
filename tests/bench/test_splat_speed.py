"""Speed of a step on the CPU, and where the time goes; pytest -m bench -s tests/bench/test_splat_speed.py.

Each time is the best with the median and the quartiles behind it; ratios are of bests in the same run, since other
work on the machine only ever adds (set GOMP_SPINCOUNT=2000 where there is any). The floor is what the machine's
multiply-adds alone would take: RENDER_OPERATIONS or MOMENTS_OPERATIONS a pair of pixel and Gaussian, sixteen at once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.kernels.cpu import lanes
from recon.kernels.cpu.activation import OPTIONS
from recon.kernels.cpu.engine import Active, Gradients, camera, grid_layout, relative_to_centre
from recon.kernels.cpu.footprints import HU, HV, KV, SHEAR, K, U, V, W, footprint_table, footprints
from recon.kernels.cpu.project import moments, render, render_layers
from recon.splatting import optimise as fit
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import DensityPolicy, FitSettings
from recon.splatting.splat import project
from recon.warm_up import warm_up
from tests.recon.helpers import run_steps

F32 = NDArray[np.float32]
N, SIDE = 50_000, 256
SIZES = (10_000, 256), (50_000, 128), (50_000, 256), (50_000, 512), (100_000, 256), (400_000, 512)
RENDER_OPERATIONS, MOMENTS_OPERATIONS = 3, 7  # two products of the recurrence and the sums
Timing = tuple[float, ...]


def view_table(active: Active, geometry: Geometry, view: int, faint: float, sigmas: float) -> F32:
    """Footprints [n, 8] of all Gaussians in one view, rectified and affine; `faint` in units of the image."""
    table = footprint_table(active.densities.shape[0])
    a = relative_to_centre(active, geometry, view)
    parameters = (a.means, a.scales, a.rotations, a.densities)
    footprints(*parameters, camera(geometry, view), faint, sigmas, table, kernel=a.kernel)
    return table


def _times(call: Callable[[], object], repeats: int = 21) -> Timing:
    """Best, median and quartiles in ms; the first call compiles and does not count."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - begin))
    return tuple(float(t) for t in np.percentile(times, (0, 50, 25, 75)))


def _line(name: str, timing: Timing, note: str = "") -> None:
    print(f"{name:28s} {timing[0]:8.3f} ms (median {timing[1]:.3f}, {timing[2]:.3f} .. {timing[3]:.3f}) {note}")


def _model(n: int, side: int) -> Gaussians:
    """Gaussians with boxes of 9 to 15 pixels that fill the field, ordered in space: the project's standard case."""
    rng = np.random.default_rng(0)
    means = (rng.random((n, 3)) - 0.5) * 220 * side / 256
    means = means[np.argsort((means[:, 2] // 16) * 1000 + means[:, 0] // 16)]
    return Gaussians.from_physical(
        means, rng.uniform(1.2, 2.2, (n, 3)), rng.uniform(0.5, 1, n) / side, rng.normal(size=(n, 4))
    )


def _active(g: Gaussians) -> Active:
    a = g.arrays()
    return Active.of(a["means"], a["log_scales"], a["quaternions"], a["raw_densities"], g.density_unit)


def _table(n: int, side: int) -> tuple[Active, F32, float]:
    """A model, its footprints in one view, and the number of pairs in their boxes."""
    active = _active(_model(n, side))
    table = view_table(active, Geometry.parallel([0.7], (side, side)), 0, 1e-5, 3.5)
    return active, table, float((4 * np.maximum(table[:, HU], 0) * np.maximum(table[:, HV], 0)).sum())


@njit(**OPTIONS)
def _multiply_add(rounds: int, out: F32) -> None:
    for thread in prange(out.shape[0]):
        a = lanes.iota() * np.float32(1e-3)
        # Eight chains that differ, or they would be folded into one.
        c0, c1, c2, c3, c4, c5, c6, c7 = a, a * 2, a * 3, a * 4, a * 5, a * 6, a * 7, a * 8
        for _ in range(rounds):
            c0, c1, c2, c3 = c0 * a + a, c1 * a + a, c2 * a + a, c3 * a + a
            c4, c5, c6, c7 = c4 * a + a, c5 * a + a, c6 * a + a, c7 * a + a
        lanes.store(out, thread, 0, c0 + c1 * c2 + c3 * c4 + c5 * c6 + c7)


def _multiply_adds_a_ms() -> float:
    rounds, out = 200_000, np.empty((get_num_threads(), 16), np.float32)
    return 8 * 16 * rounds * out.shape[0] / _times(lambda: _multiply_add(rounds, out), 15)[0]


def _scatter(table: torch.Tensor, side: int) -> torch.Tensor:
    """The readable way: every box as indices and values, added into the image by index; buckets of equal boxes."""
    image = torch.zeros((side + 32) * (side + 32))
    radii = torch.maximum(table[:, HU], table[:, HV]).detach().ceil().long()
    for radius in radii.unique().tolist():
        t = table[radii == radius]
        steps = torch.arange(-radius, radius + 1)
        cols, rows = (t[:, c].detach().round().long()[:, None] + steps for c in (U, V))
        across, down = (cols - t[:, U, None])[:, None, :], (rows - t[:, V, None])[:, :, None]
        k, shear, kv, w = (t[:, c, None, None] for c in (K, SHEAR, KV, W))
        value = w * torch.exp(-0.5 * (k * (across - shear * down) ** 2 + kv * down**2))
        index = (rows + 16)[:, :, None] * (side + 32) + (cols + 16)[:, None, :]
        image = image.index_add(0, index.reshape(-1), value.reshape(-1))
    return image.reshape(side + 32, side + 32)[16:-16, 16:-16]


@pytest.mark.bench
def test_projection_against_the_machine_and_the_scatter_reference() -> None:
    _, table, pairs = _table(N, SIDE)
    image, layers = np.empty((SIDE, SIDE), np.float32), render_layers(SIDE, SIDE)
    slope, room = np.random.default_rng(1).normal(size=image.shape).astype(np.float32), np.empty((N, 6), np.float32)
    rate = _multiply_adds_a_ms()
    print(f"\n{N} Gaussians, {pairs:.3g} pairs on {SIDE}², {get_num_threads()} threads, {rate / 1e6:.0f} GFMA/s")
    total = 0.0
    for name, call, operations in (
        ("render", lambda: render(table, image, layers), RENDER_OPERATIONS),
        ("moments", lambda: moments(table, slope, room), MOMENTS_OPERATIONS),
    ):
        timing = _times(call, 41)
        floor = operations * pairs / rate
        _line(
            name, timing, f"{1e6 * timing[0] / pairs:.3f} ns a pair, {timing[0] / floor:.1f} x its floor {floor:.3f} ms"
        )
        total += timing[0]
    leaf = torch.from_numpy(table).requires_grad_()

    def there_and_back() -> None:
        leaf.grad = None
        _scatter(leaf, SIDE).backward(torch.from_numpy(slope))

    reference = _times(there_and_back, 5)
    _line("render + moments", (total,) * 4)
    _line("scatter reference, with autograd", reference, f"{reference[0] / total:.0f} x as long")
    render(table, image, layers)
    np.testing.assert_allclose(image, _scatter(leaf, SIDE).detach().numpy(), atol=0.01 * float(image.max()))
    assert reference[0] > 10 * total


@pytest.mark.bench
def test_a_whole_step_and_its_parts() -> None:
    g = _model(N, SIDE)
    views = Geometry.parallel(np.linspace(0, math.pi, 4, endpoint=False), (SIDE, SIDE))
    noise = np.random.default_rng(2).normal(1, 0.05, (4, SIDE, SIDE)).astype(np.float32)
    data = project(g, views).numpy() * noise
    settings = FitSettings(policy=None, views_per_step=1)
    problem = fit.problem_of(Views(data, views), Grid.matching(views), g.density_unit, settings)
    state = fit.init(g, 0)
    p, unit, n = state.parameters, 1 / problem.half_field, state.n
    step = _times(lambda: fit.step(state, problem, settings, 0.3, view=2))
    active = Active.of(p["means"], p["log_scales"], p["quaternions"], p["raw"], unit)
    cut = settings.truncation
    table = view_table(active, views, 2, cut.faint, cut.sigmas)
    image, layers, found = np.empty((SIDE, SIDE), np.float32), render_layers(SIDE, SIDE), np.empty((n, 6), np.float32)
    parts = {
        "footprints": _times(lambda: view_table(active, views, 2, cut.faint, cut.sigmas)),
        "render": _times(lambda: render(table, image, layers)),
        "moments": _times(lambda: moments(table, image, found)),
    }
    print(f"\na step at {N} Gaussians on {SIDE}²")
    for name, timing in parts.items():
        _line("  " + name, timing)
    pair = parts["render"][0] + parts["moments"][0]
    _line("whole step", step, f"{step[0] / pair:.2f} x render + moments")
    layout = grid_layout(active, Grid((SIDE, SIDE, SIDE)), 1e-7, cut.sigmas)
    _line(f"voxelise {SIDE}³", _times(layout.fill, 3))
    assert step[0] > pair


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("steps", "side"), [(10_000, 256), (30_000, 256), (10_000, 512)])
def test_a_whole_fit_of_published_length(steps: int, side: int) -> None:
    """One view a step and 50k Gaussians throughout, with losses, total variation, density control at its limit."""
    g = _model(N, side)
    views = Geometry.parallel(np.linspace(0, math.pi, 50, endpoint=False), (side, side))
    data = project(g, views).numpy() * np.random.default_rng(2).normal(1, 0.02, (50, side, side)).astype(np.float32)
    settings = FitSettings(views_per_step=1, pace=1.0, tv_size=32, policy=DensityPolicy(growth=1.0))
    warm_up()
    problem = fit.problem_of(Views(data, views), Grid.matching(views), g.density_unit, settings)
    start = replace(g, means=g.means + 0.3 * torch.randn(g.means.shape, generator=torch.Generator().manual_seed(0)))
    state = fit.init(start, 0)
    before = fit.misfit_of(state, problem, settings)
    begin, worked = time.perf_counter(), time.process_time()
    run_steps(state, problem, settings, steps)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - worked
    after = fit.misfit_of(state, problem, settings)
    print(f"\n{steps} steps, {state.n} Gaussians, {side}²: {seconds:.1f} s ({cpu:.1f} CPU s)")
    print(f"{1e3 * seconds / steps:.2f} ms a step; residual {before:.4f} -> {after:.4f} (noise 0.02)")
    assert after < before


@pytest.mark.bench
def test_time_is_linear_in_pairs() -> None:
    print("\nGaussians   side     Mpairs  render + moments ms   ms/Mpair    MB held")
    found = []
    for n, side in SIZES:
        active, table, pairs = _table(n, side)
        image, layers = np.empty((side, side), np.float32), render_layers(side, side)
        result = np.empty((n, 6), np.float32)
        begin = time.process_time()
        both = _times(lambda: (render(table, image, layers), moments(table, image, result)), 9)[0]  # noqa: B023
        worked = time.process_time() - begin
        held = sum(
            a.nbytes
            for a in (table, layers, result, *vars(active).values(), *vars(Gradients.zeros(n)).values())
            if isinstance(a, np.ndarray)
        )
        print(f"{n:9d} {side:6d} {pairs / 1e6:10.2f} {both:21.3f} {1e6 * both / pairs:10.4f} {held / 1e6:10.1f}")
        found.append((pairs, both, worked))
    pairs, both, worked = np.array(found).T
    slope, start = np.polyfit(pairs / 1e6, both, 1, w=1 / both)
    print(f"slope {slope:.4f} ms a million pairs, start {start:.3f} ms")
    line = np.polyval(np.polyfit(pairs, worked, 1, w=1 / worked), pairs)
    assert np.abs(line / worked - 1).max() < 0.5  # in processor seconds, which other work does not lengthen
