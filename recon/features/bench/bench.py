"""Measures speed and quality on this machine: one standard case for kernels and steps, one for volumes.

The clock is an argument. Times are medians over repeats within one run: on a shared machine only ratios are comparable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from recon.assess.metrics import psnr, ssim3d
from recon.base.arrays import F32
from recon.base.choices import N_GAUSSIANS, SIDE
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method, RunControl
from recon.base.volume import Grid
from recon.kernels.cpu.engine import Active, Gradients, Scratch, render_view, view_table
from recon.kernels.cpu.footprints import HU, HV
from recon.reconstruction import reconstruct
from recon.splatting.gaussians import Gaussians
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project

_FAINT, _SIGMAS = 1e-3, 3.5


@dataclass(frozen=True)
class Timing:
    """The time that a call takes.

    Attributes:
        ms: median of the repeats.
        spread_ms: between their quartiles.
        pairs: Gaussian-pixel pairs that it computes; 0 without such pairs.
    """

    name: str
    ms: float
    spread_ms: float
    pairs: float = 0.0

    @property
    def ns_per_pair(self) -> float:
        return 1e6 * self.ms / self.pairs if self.pairs else math.nan


@dataclass(frozen=True)
class VolumeRow:
    """One reconstruction of the standard sample: settings, time and quality."""

    method: str
    settings: str
    seconds: float
    psnr: float
    ssim3d: float


def timed(name: str, call: Callable[[], object], now: Clock, repeats: int = 21, pairs: float = 0.0) -> Timing:
    """Median time of a call; the first one, which may compile, does not count."""
    call()
    times = []
    for _ in range(repeats):
        begin = now()
        call()
        times.append(1e3 * (now() - begin))
    low, middle, high = np.percentile(times, (25, 50, 75))
    return Timing(name, float(middle), float(high - low), pairs)


def standard_case(n: int = N_GAUSSIANS, side: int = SIDE) -> tuple[Gaussians, Geometry]:
    """n Gaussians of 1.2 to 2.2 pixels in a cube, ordered in space, and one view of side x side pixels."""
    rng = np.random.default_rng(0)
    means = (rng.random((n, 3)) - 0.5) * (0.86 * side)
    means = means[np.argsort((means[:, 2] // 16) * 1000 + means[:, 0] // 16)]
    g = Gaussians.from_physical(means, rng.uniform(1.2, 2.2, (n, 3)), rng.uniform(0.5, 1, n), rng.normal(size=(n, 4)))
    return g, Geometry.parallel([0.7], (side, side))


def kernel_timings(now: Clock, n: int = N_GAUSSIANS, side: int = SIDE, repeats: int = 21) -> list[Timing]:
    """Times of footprints, a view (footprints and image) and its backward pass, of the standard case."""
    gaussians, view = standard_case(n, side)
    a = gaussians.arrays()
    active = Active.of(a["means"], a["log_scales"], a["quaternions"], a["raw_densities"], gaussians.density_unit)
    table = view_table(active, view, 0, _FAINT, _SIGMAS)
    pairs = float((2 * np.maximum(table[:, HU], 0) * 2 * np.maximum(table[:, HV], 0)).sum())
    scratch, image = Scratch.of(n, view.detector_shape), np.empty(view.detector_shape, np.float32)
    slope = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    into, centres = Gradients.zeros(n), np.empty((n, 2), np.float32)
    seen = render_view(active, view, 0, _FAINT, _SIGMAS, image=image, scratch=scratch)
    calls: dict[str, Callable[[], object]] = {
        "footprints": lambda: view_table(active, view, 0, _FAINT, _SIGMAS),
        "forward": lambda: render_view(active, view, 0, _FAINT, _SIGMAS, image=image, scratch=scratch),
        "backward": lambda: seen.backward(slope, into, centres),
    }
    return [timed(name, call, now, repeats, pairs) for name, call in calls.items()]


def step_timing(now: Clock, n: int = N_GAUSSIANS, side: int = SIDE, repeats: int = 5, steps: int = 20) -> Timing:
    """A whole step of a fit of the standard case by the fit's own record: projection, loss, total variation, Adam."""
    gaussians, _ = standard_case(n, side)
    views = Geometry.parallel(np.linspace(0, np.pi, 6, endpoint=False), (side, side))
    data = 0.9 * project(gaussians, views).numpy()
    point = Grid((1, 1, 1))
    paces = []
    for _ in range(repeats + 1):
        fit = R2(steps=steps, gaussians=gaussians, fit=FitSettings(policy=None))
        result = reconstruct(data, views, fit, grid=point, control=RunControl(now=now))
        first, last = result.history[0], result.history[-1]
        paces.append(1e3 * (last.seconds - first.seconds) / max(1, last.step - first.step))
    low, middle, high = np.percentile(paces[1:], (25, 50, 75))  # the first step may compile
    return Timing("step", float(middle), float(high - low))


def spheres(side: int = 96, rows: int = 48, views: int = 60, photons: float = 1e4) -> tuple[F32, Geometry, F32]:
    """A sample with a known answer: spheres in a cylinder, exact chords, photon noise.

    Returns:
        Line integrals [view, row, col] with the noise of so many photons a pixel (infinite: none), their geometry, and
        the attenuation [z, y, x] averaged over each voxel.
    """
    rng = np.random.default_rng(3)
    geometry = Geometry.parallel(np.linspace(0, np.pi, views, endpoint=False), (rows, side))
    count, radius = 40, 0.42 * side
    r = rng.uniform(0.02, 0.07, count) * side
    angle, out = rng.uniform(0, 2 * np.pi, count), (radius - r) * np.sqrt(rng.random(count))
    centres = np.stack((out * np.cos(angle), out * np.sin(angle), rng.uniform(-0.4, 0.4, count) * rows), 1)
    dense = rng.uniform(0.5, 1.0, count) * 3 / side
    thin = 0.5 / side

    sub = (np.arange(3) - 1) / 3
    u = (np.arange(side) - geometry.axis_col)[:, None] + sub
    v = (np.arange(rows) - geometry.axis_row)[:, None] + sub
    exact = np.empty((views, rows, side))
    for k, theta in enumerate(geometry.angles):
        image = np.broadcast_to(2 * thin * np.sqrt(np.maximum(radius**2 - u**2, 0)), (rows, 3, side, 3)).copy()
        for (x, y, z), size, mu in zip(centres, r, dense, strict=True):
            far = (u - x * np.cos(theta) - y * np.sin(theta))[None, None] ** 2 + (v - z)[:, :, None, None] ** 2
            image += 2 * mu * np.sqrt(np.maximum(size**2 - far, 0))
        exact[k] = image.mean(axis=(1, 3))
    if math.isfinite(photons):
        exact = -np.log(np.maximum(rng.poisson(photons * np.exp(-exact)), 1) / photons)

    grid = Grid.matching(geometry)
    zs, ys, xs = (axis[:, None] + sub for axis in grid.coordinates())
    truth = np.empty(grid.shape, np.float32)
    for k in range(rows):
        plane = np.zeros((3, side, 3, side, 3))
        plane += thin * (ys[:, :, None, None] ** 2 + xs**2 <= radius**2)
        for (x, y, z), size, mu in zip(centres, r, dense, strict=True):
            if abs(zs[k] - z).min() > size:
                continue
            flat = (ys[:, :, None, None] - y) ** 2 + (xs - x) ** 2
            plane += mu * (flat[None] + ((zs[k] - z) ** 2)[:, None, None, None, None] <= size**2)
        truth[k] = plane.mean(axis=(0, 2, 4))
    return exact.astype(np.float32), geometry, truth


def volume_rows(now: Clock, methods: Iterable[Method]) -> Iterator[VolumeRow]:
    """Reconstructions of `spheres` by each method."""
    data, geometry, truth = spheres()
    for method in methods:
        result = reconstruct(data, geometry, method, control=RunControl(now=now))
        settings = ""
        if result.gaussians is None:  # the first run may have compiled its kernels
            result = reconstruct(data, geometry, method, control=RunControl(now=now))
        else:
            settings = f"{result.history[-1].step} steps, {result.gaussians.n} Gaussians"
        quality = psnr(truth, result.volume.data), ssim3d(truth, result.volume.data)
        yield VolumeRow(method.name, settings, result.seconds, *quality)
