"""Iterative reconstruction on voxels, one call: SIRT, SART, CGLS, ASD-POCS, FISTA-TV, ordered-subset SIRT with TV.

    volume = solve("fista-tv", Projector(geometry, grid), projections)

All work in float32. TV weights are fractions of the density unit (the 99.5th percentile of the positive voxels), so
they hold for any unit of attenuation. Inside, lengths, line integrals and weights are about one, whatever their units:
sums of their squares would leave float32's range.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from recon.base.masks import masked
from recon.base.volume import Grid, Volume
from recon.voxels import solvers
from recon.voxels.fbp import fbp
from recon.voxels.fdk import fdk, has_direct_method
from recon.voxels.projector import Projector, projection_images, projection_lines, volume_lines, volume_slices
from recon.voxels.solvers import AsdPocs, Cgls, FistaTv, OsSirtTv, Problem, Sart, Sirt

Method = Literal["sirt", "sart", "cgls", "asd-pocs", "fista-tv", "os-sirt-tv"]
Settings = Sirt | Sart | Cgls | AsdPocs | FistaTv | OsSirtTv

F32 = NDArray[np.float32]


def default_settings(method: Method) -> Settings:
    """The settings that `solve` takes for a method's name.

    Raises:
        ValueError: for an unknown name.
    """
    match method:
        case "sirt":
            return Sirt()
        case "sart":
            return Sart()
        case "cgls":
            return Cgls()
        case "asd-pocs":
            return AsdPocs()
        case "fista-tv":
            return FistaTv()
        case "os-sirt-tv":
            return OsSirtTv()
    raise ValueError(f"unknown method {method!r}; use one of {', '.join(get_args(Method))}")


def solve(
    method: Method | Settings,
    projector: Projector,
    projections: F32,
    *,
    iterations: int | None = None,
    weight: F32 | None = None,
    start: Volume | None = None,
    nonnegative: bool = True,
    on_iteration: Callable[[int, float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    seed: int = 0,
) -> Volume:
    """Line integrals to a volume on the projector's grid.

    Memory: as each method's settings say, in volumes of the grid and in copies of the projections, float32.

    Args:
        method: a name, or the settings of a method.
        projections: [view, row, col], line integrals, finite where they weigh anything.
        iterations: None: as the settings say.
        weight: of each ray, [view, row, col], 0 or more: 0 for pixels that are not to be trusted, or the inverse
            variance; only their ratios count. None: all alike.
        start: the volume to begin with; None: zero.
        nonnegative: voxels below zero are clipped in every step ("cgls": at the end).
        on_iteration: told each iteration's number, from 1, and ||A x - p|| / ||p|| (rays weighed) at the point where
            its correction was computed: the volume it leaves is better. "cgls", "asd-pocs": of the volume itself.
        should_stop: asked after each iteration; if true, what there is comes back.
        seed: of the order of views and subsets.

    Raises:
        ValueError: for an unknown method, shapes that disagree, values that are not finite, weights below zero or all
            zero, projections that are zero everywhere, or no iterations.
    """
    settings = default_settings(method) if isinstance(method, str) else method
    count = settings.iterations if iterations is None else operator.index(iterations)
    if count < 1:
        raise ValueError(f"at least one iteration is needed, got {count}")
    data, rays = _checked(projector, projections, weight)
    lines = _start(projector, start)
    units = _Units.of(projector, data, rays)
    inside = units.enter(projector, data, rays, lines)

    def go_on(iteration: int, residual: float) -> bool:
        if on_iteration is not None:
            on_iteration(iteration, residual)
        return not (should_stop is not None and should_stop())

    problem = Problem(
        inside, data, rays, nonnegative, np.random.default_rng(seed), go_on, lambda: _direct(inside, data, rays)
    )
    found = _run(problem, replace(settings, iterations=count), lines)
    return Volume(volume_slices(_times_power(found, units.density)), projector.grid)


@dataclass(frozen=True)
class _Units:
    """Powers of two near the lengths, line integrals and weights at hand: to change to them rounds nothing."""

    length: int
    integral: int
    weight: int

    @classmethod
    def of(cls, projector: Projector, data: F32, rays: F32 | None) -> _Units:
        largest = max(float(data.max()), -float(data.min()))
        weight = 1.0 if rays is None else float(rays.max())
        return cls(*(math.frexp(size)[1] for size in (projector.grid.voxel_size, largest, weight)))

    @property
    def density(self) -> int:
        return self.integral - self.length

    def enter(self, projector: Projector, data: F32, rays: F32 | None, lines: F32) -> Projector:
        """The projector in these units; the arrays change to them in place."""
        _times_power(data, -self.integral)
        _times_power(lines, -self.density)
        if rays is not None:
            _times_power(rays, -self.weight)
        views, box = projector.geometry, projector.grid
        pitch, sod, sdd = (math.ldexp(n, -self.length) for n in (views.pixel_pitch, views.sod, views.sdd))
        edge, slices = (math.ldexp(n, -self.length) for n in (box.voxel_size, box.spacing[0]))
        z, y, x = (math.ldexp(n, -self.length) for n in box.centre)
        return Projector(
            replace(views, pixel_pitch=pitch, sod=sod, sdd=sdd), Grid(box.shape, edge, (z, y, x), slices)
        )  # fmt: skip


def _times_power(array: F32, power: int) -> F32:
    """array *= 2^power, in steps that float32 holds."""
    while power:
        step = min(max(power, -100), 100)
        array *= np.float32(2.0**step)
        power -= step
    return array


def _direct(projector: Projector, data: F32, rays: F32 | None) -> F32 | None:
    """FBP or FDK [y, x, z] of the views that weigh anything, the rays that weigh nothing filled; None: neither can."""
    images, geometry = projection_images(data), projector.geometry
    if rays is not None:
        seen = np.flatnonzero(rays.any(axis=(1, 2)))
        geometry = geometry.select(seen)
        images = masked(images[seen], projection_images(rays[seen]))[0]
    if not has_direct_method(geometry):
        return None
    return volume_lines((fdk if geometry.is_cone else fbp)(images, geometry, projector.grid))


def _run(problem: Problem, settings: Settings, x: F32) -> F32:
    match settings:
        case Sirt():
            return solvers.sirt(problem, settings, x)
        case Sart():
            return solvers.sart(problem, settings, x)
        case Cgls():
            return solvers.cgls(problem, settings, x)
        case AsdPocs():
            return solvers.asd_pocs(problem, settings, x)
        case FistaTv():
            return solvers.fista_tv(problem, settings, x)
        case OsSirtTv():
            return solvers.os_sirt_tv(problem, settings, x)


def _checked(projector: Projector, projections: F32, weight: F32 | None) -> tuple[F32, F32 | None]:
    """Data and weights as lines; values that weigh nothing are zero."""
    expected = projector.projection_shape
    for name, array in (("projections", projections), ("weight", weight)):
        if array is not None and array.shape != expected:
            raise ValueError(f"{name} [view, row, col] have shape {array.shape}, the geometry says {expected}")
    finite = np.isfinite(projections)
    if weight is not None:
        if not (np.isfinite(weight).all() and weight.min() >= 0 and weight.max() > 0):
            raise ValueError("weights must be finite, 0 or more, and not all zero")
        finite |= weight == 0
    if not finite.all():
        raise ValueError(
            f"{int((~finite).sum())} of {finite.size} projection values are not finite: correct them, or give them "
            "weight 0"
        )
    data = projection_lines(projections)
    rays = None if weight is None else projection_lines(weight)
    if rays is not None:
        data[rays == 0] = 0
    if not data.any():
        raise ValueError("projections are zero everywhere: there is nothing to reconstruct")
    return data, rays


def _start(projector: Projector, start: Volume | None) -> F32:
    nz, ny, nx = projector.grid.shape
    if start is None:
        return np.zeros((ny, nx, nz), np.float32)
    if start.data.shape != projector.grid.shape or not np.isfinite(start.data).all():
        raise ValueError(
            f"the starting volume must be finite and of shape {projector.grid.shape}, got {start.data.shape}"
        )
    return volume_lines(start.data)
