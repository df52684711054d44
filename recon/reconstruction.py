"""reconstruct: one call from line integrals to a volume, by any method this package has."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

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
    projections: NDArray[np.floating],
    geometry: Geometry,
    grid: Grid | None = None,
    method: Method = "r2",
    steps: int | None = None,
    gaussians: int | Gaussians | None = None,
    densify: bool = True,
    seed: int = 0,
    *,
    filter: Filter = "ram-lak",
    settings: fit.FitSettings | None = None,
    seconds: float | None = None,
    on_progress: Callable[[fit.Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    now: Callable[[], float] = time.perf_counter,
) -> Reconstruction:
    """Line integrals to a volume.

    Args:
        projections: [view, row, col], -log of the transmission, finite.
        geometry: of these views.
        grid: of the volume; None gives one voxel a detector pixel.
        method: "r2" (R²-Gaussian fit) or "fbp".
        steps: of the fit, one view each; None takes 2000, or as many as fit into `seconds`.
        gaussians: how many to start from, or the Gaussians to start from; None derives a number from the grid.
        densify: the fit may clone, split and prune.
        seed: of every random choice; the same seed gives the same volume on the same machine.
        filter: of "fbp" ("ram-lak", "shepp-logan" or "hann").
        settings: of the fit, in full; overrides `densify`.
        seconds: a time budget for the fit; the rates decay along it.
        on_progress: called about ten times a second.
        should_stop: asked between steps; a stopped fit returns what it has.
        now: a clock in s.

    Raises:
        ValueError: for shapes that disagree, values that are not finite, a single view, or data without matter.
    """
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {get_args(Method)}, got {method!r}")
    data = np.ascontiguousarray(projections, np.float32)
    expected = (geometry.n_views, *geometry.detector_shape)
    if data.shape != expected:
        raise ValueError(f"projections have shape {data.shape}, the geometry says {expected} [view, row, col]")
    if not np.isfinite(data).all():
        raise ValueError(f"{int((~np.isfinite(data)).sum())} of {data.size} projection values are not finite")
    if geometry.n_views < 2:
        raise ValueError("one view does not determine a volume; give at least two, at different angles")
    begin = now()
    target = grid or Grid.matching(geometry)
    if method == "fbp":
        volume = Volume(fbp(data, geometry, target, filter), target)
        return Reconstruction(volume, now() - begin, (), method, None, MappingProxyType({"filter": filter}))

    chosen = settings or fit.FitSettings()
    if settings is None and not densify:
        chosen = replace(chosen, policy=None)
    start = (
        gaussians
        if isinstance(gaussians, Gaussians)
        else place(data, geometry, target, gaussians, np.random.default_rng(seed))
    )
    state = fit.init(start, seed, fit.growth(chosen))
    problem = fit.make_problem(data, geometry, target, start.density_unit, chosen)
    planned = steps if steps is not None else (0 if seconds is not None else DEFAULT_STEPS)
    history: list[fit.Progress] = []
    fit_begin = said = now()
    while planned == 0 or state.step < planned:
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


def _progress(state: fit.FitState, planned: int, seconds: float, n_views: int) -> fit.Progress:
    return fit.Progress(state.step, planned, seconds, state.loss, state.residual, state.n, n_views)
