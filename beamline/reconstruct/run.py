"""Run: a method on prepared views, the one call by which every command makes a volume, and its share of the time."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

import recon
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections, with_held_out
from beamline.reconstruct.measure import residual_share
from beamline.reconstruct.options import OutputPaths
from drivers.base.clock import Clock
from recon.assess.time_model import duration_text
from recon.base.arrays import F32, bin_views
from recon.base.decisions import Stop
from recon.base.geometry import Geometry
from recon.base.method import BoundedMethod, DataUse, Method, Reconstruction, RunControl
from recon.base.volume import Grid
from recon.methods import by_name, with_settings
from recon.splatting.fit_method import FitMethod
from recon.splatting.in_time import first_sweep_seconds
from recon.splatting.initialise import sweeps_of_start


def run_on(
    method: Method,
    prepared: PreparedProjections,
    grid: Grid,
    seed: int,
    control: RunControl,
    device: str = "cpu",
    reconstruct: Callable[..., Reconstruction] = recon.reconstruct,
) -> Reconstruction:
    """Run a method on these views, with those held out if it takes any, until it ends or is stopped.

    Raises:
        ValueError: the method does not take these views.
    """
    data, geometry, use = views_for(method, prepared)
    return reconstruct(data, geometry, method, grid=grid, seed=seed, device=device, use=use, control=control)


def views_for(method: Method, prepared: PreparedProjections) -> tuple[F32, Geometry, DataUse]:
    """Line integrals [view, row, col], geometry and use of the views as the method takes them."""
    data, geometry, held_out = prepared.projections.data, prepared.geometry, list[int]()
    if method.traits.held_out:
        data, geometry, held_out = with_held_out(data, geometry, prepared.held_out)
    # Rays that weigh nothing were filled on disk, as a direct method does it.
    filled = method.traits.direct and prepared.on_disk
    emission = prepared.emission  # of pixels that were binned, or beside views held out, the line integrals speak alone
    alike = emission is not None and emission.counts.shape == (geometry.n_views, *geometry.detector_shape)
    use = DataUse(
        None if filled else prepared.ray_weights(len(held_out)),
        held_out,
        emission if alike else None,
        prepared.times if method.traits.in_time else None,
        prepared.energies if method.traits.by_energy else None,
    )
    return data, geometry, use


def binned(prepared: PreparedProjections, factor: int) -> PreparedProjections:
    """The same views with factor x factor binning: means of line integrals."""
    if factor == 1:
        return prepared
    projections, counted = prepared.projections, prepared.projections.weights
    data, weights = bin_views(projections.data, factor), None
    if counted is not None:  # the mean of the rays that are known, each by what it says
        weights = bin_views(counted, factor)
        sums = bin_views(counted * projections.data, factor)
        data = np.divide(sums, weights, out=data, where=weights > 0)
    held, unseen, measured = prepared.held_out, prepared.held_out_weights, prepared.measured
    if measured is not None:
        measured = bin_views(measured[None].astype(np.float32), factor)[0] == 1
    return replace(
        prepared,
        projections=replace(projections, data=data, weights=weights),
        geometry=prepared.geometry.binned(factor),
        measured=measured,
        shares=None if prepared.shares is None else bin_views(prepared.shares, factor),
        held_out=None if held is None else (bin_views(held[0], factor), held[1].binned(factor)),
        held_out_weights=None if unseen is None else bin_views(unseen, factor),
    )


_REPORT = 5.0  # s, its pictures
_BYTES = 1e8  # of a volume, written and read back in a second
_BUSIEST = 4.0  # largest slow-down of this by other programs
_FORWARD = 0.5  # of a sweep
_LEAST = 0.1  # of a sweep: the time of a start from coarse views and one step


def fit_within(
    method: BoundedMethod,
    prepared: PreparedProjections,
    target: OutputPaths,
    started: tuple[float, float],
    clock: Clock,
    warn: Warn,
) -> tuple[BoundedMethod, Stop]:
    """The fit with the seconds that its call leaves it, before measuring, report and writing; and when these begin.

    If they are too few, `warn` is told the expected duration before the fit.

    Args:
        method: `seconds` are those of the call.
        started: when the call began, by the clock and in seconds of this process's work.
    """
    assert method.seconds is not None
    geometry, grid = prepared.geometry, Grid.matching(prepared.geometry)
    sweep = first_sweep_seconds(geometry, grid, clock.now)
    spent = clock.now() - started[0]
    busy = min(max(spent / max(time.process_time() - started[1], 1e-3), 1.0), _BUSIEST)
    pages = target.report is not None
    after = busy * (_REPORT * pages + 4 * math.prod(grid.shape) / _BYTES)
    measuring = _FORWARD * sweep * residual_share(geometry, grid, prepared.held_out)
    remaining, least = method.seconds - spent - measuring - after, _LEAST * sweep
    if remaining < least:
        sentence = (
            f"{duration_text(method.seconds)} do not suffice for this scan: reading and correcting it took "
            f"{duration_text(spent)}, measuring the volume, the report and writing take about "
            f"{duration_text(measuring + after)}, so nothing is left for the {by_name(method.name).label} method"
        )
        if isinstance(method, FitMethod):
            start = sweeps_of_start(geometry, method.start) * sweep
            sentence += (
                f". The start of a fit of all pixels takes {duration_text(start)}. With a start from coarse pixels the "
                f"end is in about {duration_text(least + measuring + after)}"
            )
        warn(f"{sentence}.")
    before_report = Stop(deadline=started[0] + method.seconds - after, now=clock.now)
    return with_settings(method, {"seconds": max(remaining, 0.0)}), before_report


@contextmanager
def warnings_told(warn: Warn) -> Iterator[None]:
    """Within the context Python's warnings are passed on as sentences, without file and line."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *_: warn(str(message))
        yield
