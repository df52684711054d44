"""Machine speed: how long each operation of `recon.base.work` takes here, from runs of some hundredths of a second.

An operation is timed at two sizes, which tell its two rates. The least of some runs counts, since others may use the
machine, too. All operations of a method take a fraction of a second together, but for compiling them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module

import numpy as np

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Clock
from recon.base.registry import in_folders
from recon.base.volume import Grid, Volume
from recon.base.work import Rate, SizedRun
from recon.kernels.cpu import tv as tv_cpu
from recon.kernels.cpu.patches import denoise, patch_scratch
from recon.kernels.cpu.vectors import add_product
from recon.splatting import optimise
from recon.splatting.backend import backend_for
from recon.splatting.gaussians import Gaussians
from recon.splatting.in_time import covered
from recon.splatting.initialise import count_for, sample_gaussians
from recon.splatting.settings import FitSettings
from recon.splatting.splat import voxelize
from recon.voxels.direct import direct, direct_work
from recon.voxels.projector import Projector
from recon.voxels.voxel_problem import Sweeps, TotalVariationProx

_TV_STEPS = 3
_SERIAL = ("draw",)  # operations of one thread
RUNS = 3  # the quickest counts; one more comes first, and loads the code and the data


def measured_rate(operation: str, now: Clock, threads: int = 1) -> Rate:
    """Measure the rate of an operation on this machine while no other program runs.

    Args:
        operation: its name, as of `OPERATIONS`, with what follows a comma.
        now: processor time of this process, all threads together: that is the same where others use the machine.
        threads: that share it.

    Raises:
        KeyError: there is no such operation.
    """
    kind, _, which = operation.partition(", ")
    rate = rate_of(OPERATIONS[kind](which), now)
    return rate if kind in _SERIAL else Rate(rate.first / threads, rate.second / threads)


def rate_of(timed: tuple[SizedRun, ...], now: Clock) -> Rate:
    """The two rates from runs of two sizes; where one rate would be negative, the larger run gives the other alone."""
    seconds = []
    for size in timed:
        size.run()
        times = []
        for _ in range(RUNS):
            begin = now()
            size.run()
            times.append(now() - begin)
        seconds.append(min(times))
    (a, b, _), (c, d, _) = timed[0], timed[-1]
    short, long = seconds[0], seconds[-1]
    if (scale := a * d - b * c) != 0:
        first, second = (short * d - long * b) / scale, (a * long - c * short) / scale
        if first >= 0 and second >= 0:
            return Rate(first, second)
    return Rate(0.0, long / d) if d > 0 else Rate(long / c, 0.0)


def _geometry(beam: str, rows: int, cols: int, views: int) -> Geometry:
    angles = np.linspace(0, np.pi, views, endpoint=False)
    if beam == "cone":
        return Geometry.cone(2 * angles, (rows, cols), 1.0, 4 * cols, 8 * cols)
    return Geometry.parallel(angles, (rows, cols), tilt=0.05 if beam == "posed" else 0.0)


def _sweeps(beam: str, single: bool = False) -> tuple[SizedRun, ...]:
    several = ((2, 256), (64, 192)) if single else ((8, 160), (96, 192))
    sizes = ((1, 96), (1, 512)) if beam == "slice" else several
    return tuple(_swept(beam, *size, single) for size in sizes)


def _swept(beam: str, rows: int, cols: int, single: bool) -> SizedRun:
    """Lines and voxels of a few views, together or one by one."""
    geometry = _geometry(beam, rows, cols, 4 if single or beam == "posed" else 16)
    grid = Grid.matching(geometry)
    nz, ny, nx = grid.shape
    projector, x = Projector(geometry, grid), np.ones((ny, nx, nz), np.float32)
    lines = float(geometry.n_views * ny * nx)
    if not single:
        return SizedRun(lines, lines * nz, lambda: projector.adjoint_lines(projector.forward_lines(x), x))
    sweeps = Sweeps(projector, projector.forward_lines(x), None, list(np.arange(geometry.n_views)[:, None]))
    return SizedRun(lines, lines * nz, lambda: sweeps.run(x, 1.0, True, None))


def _on_volume(make: Callable[[tuple[int, int, int]], Callable[[], object]], times: int = 1) -> tuple[SizedRun, ...]:
    """Lines and voxels of a volume that is passed so many times."""
    return tuple(
        SizedRun(float(times * a * b), float(times * a * b * c), make((a, b, c)))
        for a, b, c in ((160, 160, 8), (192, 192, 96))
    )


def _noise(shape: tuple[int, ...]) -> F32:
    return np.random.default_rng(0).random(shape, np.float32)


def _passed(shape: tuple[int, int, int]) -> Callable[[], object]:
    x, y, z = _noise(shape), _noise(shape), _noise(shape)
    return lambda: add_product(x, 1e-3, y, z, True)


def _smoothed(shape: tuple[int, int, int]) -> Callable[[], object]:
    prox, x = TotalVariationProx(shape, (1.0, 1.0, 1.0), True, _TV_STEPS), _noise(shape)
    return lambda: prox(x, 1e-2)


def _sloped(shape: tuple[int, int, int]) -> Callable[[], object]:
    x, out = _noise(shape), _noise(shape)
    return lambda: tv_cpu.gradient(x, 1e-4, (1.0, 1.0, 1.0), out)


def _patched(shape: tuple[int, int, int]) -> Callable[[], object]:
    x, scratch, out = _noise(shape), patch_scratch(shape), _noise(shape)
    return lambda: denoise(x, 0.1, True, scratch, out)


_FBP = {  # rows, columns and views for which FBP takes either way
    "rays": ((48, 96, 60), (16, 320, 60)),
    "gridding": ((16, 512, 180),),
}


def _direct(operation: str, beam: str, rows: int, cols: int, views: int) -> SizedRun:
    """A direct method, for one of its operations."""
    geometry, grid, data = views_of_disc(beam, rows, cols, views)
    return SizedRun(*direct_work(geometry, grid).amounts[operation], partial(direct, data, geometry, grid, "hann"))


def _filtered(which: str) -> tuple[SizedRun, ...]:
    return tuple(_direct(f"fbp, {which}", "parallel", *size) for size in _FBP[which])


def _back_projected(which: str) -> tuple[SizedRun, ...]:
    return tuple(_direct(f"back-projection, {which}", which, *size, 12) for size in ((8, 96), (32, 128)))


def views_of_disc(beam: str, rows: int, cols: int, views: int) -> tuple[Geometry, Grid, F32]:
    """Views of a disc with a hole, and the grid that matches them."""
    geometry = _geometry(beam, rows, cols, views)
    grid = Grid.matching(geometry)
    return geometry, grid, Projector(geometry, grid).forward(_disc(grid).data)


def _disc(grid: Grid) -> Volume:
    """A disc with a hole, of density 1 over the grid's width."""
    width = grid.shape[2] * grid.voxel_size
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    disc = (np.hypot(x, y) < 0.4 * width) & ~(np.hypot(x - 0.1 * width, y) < 0.1 * width)
    return Volume((disc / width).astype(np.float32), grid)


def _step(beam: str, rows: int, cols: int, steps: int = 4) -> SizedRun:
    """Views of some steps of a fit, and what its Gaussians cover in them."""
    geometry, grid, data = views_of_disc(beam, rows, cols, 12)
    settings = FitSettings(policy=None)
    gaussians = _drawn(grid, geometry.is_cone)
    state = optimise.init(gaussians, 0)
    problem = optimise.problem_of(data, geometry, grid, state.unit, settings)
    views = steps * settings.views_per_step

    def run() -> None:
        for _ in range(steps):
            optimise.step(state, problem, settings, 0.0)

    return SizedRun(views, views * covered(math.prod(grid.shape), gaussians.n), run)


def _views_of_fit(rows: int, cols: int) -> SizedRun:
    geometry, grid, data = views_of_disc("parallel", rows, cols, 12)
    make = partial(optimise.problem_of, data, geometry, grid, 1.0, FitSettings(), backend_for("cpu"))
    return SizedRun(geometry.n_views, data.size, make)


def _drawn(grid: Grid, cone: bool = False) -> Gaussians:
    return sample_gaussians(
        _disc(grid), count_for(grid, cone), np.random.default_rng(0), field_radius=math.inf,
        kernel=FitSettings().kernel,
    )  # fmt: skip


def _draw(rows: int, cols: int) -> SizedRun:
    grid = Grid((rows, cols, cols))
    return SizedRun(count_for(grid, False), math.prod(grid.shape), partial(_drawn, grid))


def _fill(rows: int, cols: int) -> SizedRun:
    gaussians = _drawn(grid := Grid((rows, cols, cols)))
    return SizedRun(gaussians.n, math.prod(grid.shape), partial(voxelize, gaussians, grid))


def _of_feature(module: str, which: str) -> tuple[SizedRun, ...]:
    timed: tuple[SizedRun, ...] = import_module(module).timed(which)
    return timed


OPERATIONS: Mapping[str, Callable[[str], tuple[SizedRun, ...]]] = {
    "sweep": _sweeps,  # a projection and its adjoint: lines x views, voxels x views; of a kind of beam
    "single sweep": partial(_sweeps, single=True),  # the same, with a correction of the volume after each view
    "pass": lambda which: _on_volume(_passed),  # sums of volumes: lines, voxels
    "tv": lambda which: _on_volume(
        _smoothed, _TV_STEPS + 1
    ),  # a dual step of total variation, or the end of some: lines, voxels
    "slope": lambda which: _on_volume(_sloped),  # of total variation: lines, voxels
    "patches": lambda which: _on_volume(_patched),  # lines, voxels
    "fbp": _filtered,  # rays, s on the machine of docs/performance.md; by rays or by gridding
    "back-projection": _back_projected,  # lines x views, voxels x views; of a cone or of views in any pose
    "views": lambda which: (_views_of_fit(16, 96), _views_of_fit(64, 160)),  # the data of a fit: views, rays
    "view": lambda beam: (
        _step(beam, 16, 96),
        _step(beam, 48, 128),
    ),  # of a step of a fit: views, views x what Gaussians cover; of a kind of beam
    "draw": lambda which: (_draw(8, 64), _draw(32, 128)),  # first Gaussians: Gaussians, voxels
    "fill": lambda which: (_fill(8, 64), _fill(32, 128)),  # the volume of Gaussians: Gaussians, voxels
    **{kind: partial(_of_feature, module) for kind, module in in_folders("recon.features", "OPERATIONS").items()},
}
"""By name, with those of features: the folder of one names for each a module, whose `timed` makes them."""
