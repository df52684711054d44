"""reconstruct: one call from line integrals to a volume, by any method this package has."""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from recon import fit
from recon.fbp import Filter, fbp
from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.initialise import place
from recon.volume import Grid, Volume

Method = Literal["r2", "fbp"]
DEFAULT_STEPS = 2000


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What came out.

    Attributes:
        volume: the attenuation, `volume.data` float32 [z, y, x] in 1/mm.
        seconds: wall time of the reconstruction.
        history: the fit's own curve, empty for a direct method.
        method: how.
        gaussians: the model behind an "r2" volume.
        settings: every parameter that was used.
    """

    volume: Volume
    seconds: float
    history: tuple[fit.Progress, ...]
    method: Method
    gaussians: Gaussians | None
    settings: Mapping[str, Any]


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
    settings: fit.FitSettings | None = None,
    seconds: float | None = None,
    on_progress: Callable[[fit.Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    now: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """Line integrals to a volume.

    Args:
        projections: [view, row, col], -log of the transmission, finite; any real type (a CPU tensor too).
        geometry: of these views.
        grid: of the volume; None gives one voxel a detector pixel. A fit always covers all that the views see, so a
            small box holds what the whole volume holds there.
        method: "r2" (R²-Gaussian fit) or "fbp".
        steps: of the fit, one view each; 0 gives the starting point; None takes 2000, or as many as fit into `seconds`.
        gaussians: how many to start from, or the Gaussians to start from; None derives a number from the detector.
        densify: the fit may clone, split and prune.
        seed: of every random choice; the same seed gives the same volume on the same machine and number of threads.
        filter: of "fbp" ("ram-lak", "shepp-logan" or "hann"). The smooth one is best for few or noisy views.
        settings: of the fit, in full; overrides `densify`.
        seconds: a time budget for the fit; the rates decay along it.
        on_progress: called about ten times a second.
        should_stop: asked between steps; a stopped fit returns what it has.
        now: a clock in s.

    Raises:
        ValueError: for shapes that disagree, values that are not finite, views from one side only, numbers out of
            range, or data without matter.
    """
    _check(method, filter, geometry, steps, seconds)
    data = _line_integrals(projections, geometry)
    begin = now()
    target = grid or Grid.matching(geometry)
    if method == "fbp":
        volume = Volume(fbp(data, geometry, target, filter), target)
        return Reconstruction(volume, now() - begin, (), method, None, MappingProxyType({"filter": filter}))

    chosen = settings or fit.FitSettings()
    if settings is None and not densify:
        chosen = replace(chosen, policy=None)
    field = Grid.of_field(geometry, max(geometry.pixel_pitch, target.voxel_size))
    start = (
        gaussians
        if isinstance(gaussians, Gaussians)
        else place(data, geometry, field, gaussians, np.random.default_rng(seed))
    )
    state = fit.init(start, seed, fit.growth(chosen))
    problem = fit.make_problem(data, geometry, field, start.density_unit, chosen)
    if steps is None and seconds is None:
        steps = DEFAULT_STEPS
    planned = steps or 0  # 0 in a history: no number of steps was planned
    history: list[fit.Progress] = []
    fit_begin = said = now()
    while steps is None or state.step < steps:
        spent = now() - fit_begin
        if seconds is not None and spent >= seconds and state.step > 0:
            break
        fraction = max(state.step / planned if planned else 0.0, spent / seconds if seconds else 0.0)
        fit.step(state, problem, chosen, min(1.0, fraction))
        if now() - said > 0.1 or state.step == 1:
            said = now()
            history.append(_progress(state, planned, said - begin, geometry.n_views))
            if on_progress is not None:
                on_progress(history[-1])
        if should_stop is not None and should_stop():
            break
    history.append(_progress(state, planned, now() - begin, geometry.n_views))
    if on_progress is not None:
        on_progress(history[-1])
    volume = fit.volume_of(state, target, chosen)
    used = {**asdict(chosen), "steps": state.step, "seed": seed, "gaussians_at_start": start.n, "gaussians": state.n}
    return Reconstruction(
        volume, now() - begin, tuple(history), method, fit.gaussians_of(state), MappingProxyType(used)
    )


def _check(method: str, filter: str, geometry: Geometry, steps: int | None, seconds: float | None) -> None:
    for name, value, legal in (("method", method, get_args(Method)), ("filter", filter, get_args(Filter))):
        if value not in legal:
            raise ValueError(f"{name} must be one of {legal}, got {value!r}")
    # Views half a turn apart hold the same rays, so |sin| of the angle between two tells whether they differ.
    if np.abs(np.sin(geometry.angles - geometry.angles[0])).max() < 1e-6:
        raise ValueError(
            f"{geometry.n_views} views from one side ({np.rad2deg(geometry.angles[0]):g} degrees): one view does not "
            "determine a volume; give at least two, at different angles"
        )
    if steps is not None and operator.index(steps) < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
    if seconds is not None and not (math.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"seconds must be a time of 0 or more, got {seconds}")


def _line_integrals(projections: ArrayLike, geometry: Geometry) -> NDArray[np.float32]:
    given = np.asarray(projections.detach() if isinstance(projections, Tensor) else projections)
    if given.dtype.kind not in "fiub":
        raise ValueError(f"projections must be real numbers, got {given.dtype}")
    expected = (geometry.n_views, *geometry.detector_shape)
    if given.shape != expected:
        raise ValueError(f"projections have shape {given.shape}, the geometry says {expected} [view, row, col]")
    with np.errstate(over="ignore"):  # what float32 cannot hold is told as not finite
        data = np.ascontiguousarray(given, np.float32)
    if not np.isfinite(data).all():
        raise ValueError(f"{int((~np.isfinite(data)).sum())} of {data.size} projection values are not finite")
    return data


def _progress(state: fit.FitState, planned: int, seconds: float, n_views: int) -> fit.Progress:
    return fit.Progress(state.step, planned, seconds, state.loss, state.residual, state.n, n_views)
