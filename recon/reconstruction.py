"""reconstruct: one call from line integrals to a volume, by any method this package has."""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.masks import masked
from recon.base.volume import Grid, Volume
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import Start
from recon.splatting.optimise import Progress
from recon.splatting.settings import FitSettings
from recon.splatting.train import FitRequest, run_fit
from recon.voxels import iterative
from recon.voxels.fbp import Filter, fbp
from recon.voxels.fdk import fdk
from recon.voxels.projector import Projector
from recon.voxels.solvers import FistaTv, OsSirtTv

Method = Literal["r2", "fbp", "sirt", "sart", "cgls", "asd-pocs", "fista-tv", "os-sirt-tv"]
DEFAULT_STEPS = 1000

# The methods that take an option; one that is not listed is of the fit.
_FIT: tuple[Method, ...] = ("r2",)
_TAKEN_BY: Mapping[str, tuple[Method, ...]] = MappingProxyType(
    {"filter": ("fbp",), "iterations": get_args(iterative.Method), "tv_weight": ("fista-tv", "os-sirt-tv")}
)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What came out.

    Attributes:
        volume: the attenuation, `volume.data` float32 [z, y, x] in 1/mm.
        seconds: wall time of the reconstruction.
        history: the fit's or the iterations' own curve, empty for a direct method.
        method: how.
        gaussians: the model behind an "r2" volume.
        settings: every parameter that was used.
        checkpoint: the state of an "r2" fit, which `resume` takes up again; see `checkpoint.arrays_of`.
    """

    volume: Volume
    seconds: float
    history: tuple[Progress, ...]
    method: Method
    gaussians: Gaussians | None
    settings: Mapping[str, Any]
    checkpoint: Mapping[str, NDArray[Any]] | None = None


def reconstruct(
    projections: ArrayLike | Tensor,
    geometry: Geometry,
    grid: Grid | None = None,
    method: Method = "r2",
    steps: int | None = None,
    gaussians: int | Gaussians | None = None,
    densify: bool = True,
    seed: int = 0,
    *,
    filter: Filter = "hann",
    settings: FitSettings | None = None,
    seconds: float | None = None,
    start: Start = "fbp",
    held_out: Sequence[int] = (),
    early_stop: bool = False,
    resume: Mapping[str, NDArray[Any]] | None = None,
    device: str = "cpu",
    polish: int = 0,
    iterations: int | None = None,
    tv_weight: float | None = None,
    weights: NDArray[np.float32] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    on_checkpoint: Callable[[Mapping[str, NDArray[Any]]], None] | None = None,
    checkpoint_every: float = 60.0,
    now: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """Line integrals to a volume.

    Args:
        projections: [view, row, col], -log of the transmission; any real type (a CPU tensor too). Values that are not
            finite are filled from their neighbours and weigh nothing.
        geometry: of these views.
        grid: of the volume; None gives one voxel a detector pixel. A fit always covers all that the views see, so a
            small box holds what the whole volume holds there.
        method: "r2" (R²-Gaussian fit), "fbp" (FDK for a cone), or a classical iterative one, see `iterative.solve`.
        steps: of the fit; 0 gives the starting point; None takes 1000, or as many as fit into `seconds`.
        gaussians: how many to start from, or the Gaussians to start from; None derives a number from the detector.
        densify: the fit may clone, split and prune.
        seed: of every random choice; the same seed gives the same volume on the same machine and number of threads.
        filter: of "fbp" ("ram-lak", "shepp-logan" or "hann"). The smooth one is best for few or noisy views.
        settings: of the fit, in full; overrides `densify`.
        seconds: a time budget for the fit; the rates decay along it.
        start: the volume that Gaussians are drawn from, see `initialise.first_volume`.
        held_out: views that the fit does not see; their residual is in the history.
        early_stop: end the fit when that residual has not fallen for a while, and return the model that had it lowest.
        resume: the checkpoint of a fit with the same data and settings, to be taken up where it was left.
        device: that the fit computes on, "cpu" or "cuda" (the current CUDA device).
        polish: sweeps over the views after the fit that add on voxels what Gaussians could not say, see
            `polish.polish`; `gaussians` stays the model as it was fitted.
        iterations, tv_weight: of a classical method; None: its defaults. The weight is in density units.
        weights: of each ray [view, row, col], 0 or more. "fbp" fills rays of weight 0 from their neighbours, and to it
            all others are alike.
        on_progress: called about ten times a second, or after each iteration ("fbp" has none).
        should_stop: asked between steps or iterations; what is stopped returns what it has.
        on_checkpoint: given the checkpoint of an "r2" fit every `checkpoint_every` s.
        now: a clock in s.

    Raises:
        ValueError: for shapes that disagree, views from one side only, numbers out of range, options of another
            method, or data without matter.
    """
    options = {
        "method": (method, get_args(Method)),
        "filter": (filter, get_args(Filter)),
        "start": (start, get_args(Start)),
    }
    _check(options, geometry, steps, seconds, polish)
    said = {
        "steps": steps is not None, "seconds": seconds is not None, "gaussians": gaussians is not None,
        "densify": not densify, "settings": settings is not None, "start": start != "fbp",
        "held_out": len(held_out) > 0, "early_stop": early_stop, "resume": resume is not None,
        "device": device != "cpu", "polish": polish != 0, "on_checkpoint": on_checkpoint is not None,
        "filter": filter != "hann", "iterations": iterations is not None, "tv_weight": tv_weight is not None,
    }  # fmt: skip
    _refuse_foreign(method, [name for name, given in said.items() if given])
    data = _line_integrals(projections, geometry)
    begin = now()
    target = grid or Grid.matching(geometry)
    if method == "r2":
        if steps is None and seconds is None:
            steps = DEFAULT_STEPS
        chosen = settings or FitSettings()
        if settings is None and not densify:
            chosen = replace(chosen, policy=None)
        request = FitRequest(
            chosen, steps, seconds, gaussians, seed, start, tuple(held_out), early_stop, resume, device,
            operator.index(polish),
        )  # fmt: skip
        fitted = run_fit(
            data, weights, geometry, target, request, on_progress, should_stop, now, on_checkpoint, checkpoint_every
        )
        return Reconstruction(
            fitted.volume, now() - begin, fitted.history, method, fitted.gaussians, MappingProxyType(fitted.settings),
            fitted.checkpoint,
        )  # fmt: skip
    if method == "fbp":
        filled = masked(data, weights)[0]
        volume = Volume((fdk if geometry.is_cone else fbp)(filled, geometry, target, filter), target)
        return Reconstruction(volume, now() - begin, (), method, None, MappingProxyType({"filter": filter}))
    how = iterative.default_settings(method)
    if tv_weight is not None and isinstance(how, FistaTv | OsSirtTv):
        how = replace(how, tv_weight=tv_weight)
    if iterations is not None:
        how = replace(how, iterations=iterations)
    history: list[Progress] = []

    def told(iteration: int, residual: float) -> None:
        history.append(
            Progress(iteration, how.iterations, now() - begin, residual, residual, 0, geometry.n_views)
        )  # fmt: skip
        if on_progress is not None:
            on_progress(history[-1])

    filled, known = masked(data, weights)
    volume = iterative.solve(
        how, Projector(geometry, target), filled, weight=known, on_iteration=told, should_stop=should_stop, seed=seed
    )  # fmt: skip
    used = {**asdict(how), "seed": seed}
    return Reconstruction(volume, now() - begin, tuple(history), method, None, MappingProxyType(used))


def _check(
    options: Mapping[str, tuple[str, Sequence[str]]],
    geometry: Geometry,
    steps: int | None,
    seconds: float | None,
    polish: int,
) -> None:
    for name, (value, legal) in options.items():
        if value not in legal:
            raise ValueError(f"{name} must be one of {tuple(legal)}, got {value!r}")
    # Parallel views half a turn apart hold the same rays, so |sin| of the angle between two tells whether they differ;
    # a cone's, and those that look down on the rotation axis, differ up to the whole turn.
    turn = (geometry.angles - geometry.angles[0]) / (2 if geometry.is_cone or geometry.tilt.any() else 1)
    if np.abs(np.sin(turn)).max() < 1e-6:
        raise ValueError(
            f"{geometry.n_views} views from one side ({np.rad2deg(geometry.angles[0]):g} degrees): one view does not "
            "determine a volume; give at least two, at different angles"
        )
    if steps is not None and operator.index(steps) < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
    if polish and not geometry.is_straight:
        raise ValueError(
            "polish works on voxels, whose projector takes straight views only: these are rolled or tilted"
        )
    if operator.index(polish) < 0:
        raise ValueError(f"polish must be 0 sweeps or more, got {polish}")
    if seconds is not None and not (math.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"seconds must be a time of 0 or more, got {seconds}")


def _refuse_foreign(method: Method, said: Sequence[str]) -> None:
    """Raises ValueError for options that would silently do nothing."""
    foreign = [name for name in said if method not in _TAKEN_BY.get(name, _FIT)]
    if foreign:
        owners = ", ".join(f"{name} (of {', '.join(_TAKEN_BY.get(name, _FIT))})" for name in foreign)
        raise ValueError(f"method {method!r} does not take {owners}: leave that out, or choose another method")


def _line_integrals(projections: ArrayLike, geometry: Geometry) -> NDArray[np.float32]:
    given = np.asarray(projections.detach() if isinstance(projections, Tensor) else projections)
    if given.dtype.kind not in "fiub":
        raise ValueError(f"projections must be real numbers, got {given.dtype}")
    expected = (geometry.n_views, *geometry.detector_shape)
    if given.shape != expected:
        raise ValueError(f"projections have shape {given.shape}, the geometry says {expected} [view, row, col]")
    with np.errstate(over="ignore"):  # what float32 cannot hold counts as not finite
        return np.ascontiguousarray(given, np.float32)
