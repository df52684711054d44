"""Run: runs a method on prepared projections within the time limit, and computes error bars."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import recon
from beamline.core.errors import ConfigError
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.slab_run import busiest_first
from beamline.storage.disk_file import scratch_array
from drivers.base.clock import Clock
from recon.assess.time_model import duration_text
from recon.base.arrays import F64
from recon.base.decisions import Stop
from recon.base.geometry import Geometry
from recon.base.method import DataUse, Method, ReconProblem, Reconstruction, RunControl
from recon.base.slabs import Slab, part_of, slabs_of
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.error_bars import HALO, LEAST_VIEWS, ErrorBars, error_bars
from recon.methods import by_name, with_settings
from recon.splatting.fit_method import Fit


def run_on(
    method: Method,
    views: Views,
    grid: Grid,
    seed: int,
    control: RunControl,
    device: str = "cpu",
    reconstruct: Callable[..., Reconstruction] = recon.reconstruct,
    times: F64 | None = None,
) -> Reconstruction:
    """Run a method on these projections (and the held-out ones if it uses them) until it ends or is stopped.

    Args:
        times: time of the exposure of each projection in s, for a method that makes a volume for each of several times.

    Raises:
        ValueError: the method cannot use these projections.
    """
    views, use = views_for(method, views), DataUse(times=times if "times" in method.takes else None)
    return reconstruct(views, method=method, grid=grid, seed=seed, device=device, use=use, control=control)


def views_for(method: Method, views: Views) -> Views:
    """The projections in the form that the method expects, with their weights in memory. In data on disk, rays of
    weight 0 are already filled as a direct method would fill them, so a direct method gets no weights.
    """
    wanted = method.views_wanted(views.seen.geometry)
    if not wanted.all():
        views = views.using(np.flatnonzero(wanted))
    views = views if "held_out" in method.takes else views.seen
    unweighed = views.weights is None or (isinstance(views.data, np.memmap) and not method.weighs)
    return replace(views, weights=None if unweighed else views.weights[...])


def without_outside(prepared: PreparedProjections, result: Reconstruction) -> PreparedProjections:
    """Subtract the part of the sample outside the volume from the projections, in place, so that the volume and FBP are
    compared with the rest. If nothing is known about the sample outside, the projections are not changed.
    """
    if result.outside is None:
        return prepared
    lines = prepared.lines
    for first in range(0, len(lines.data), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        lines.data[block] -= result.outside(lines.geometry.select(block))
    assert lines.reach is not None
    within = replace(lines.reach, sample=None, tall=False, measured=True)
    return replace(prepared, lines=replace(lines, reach=within))


_AT_ONCE = 32  # number of projections that are computed together
_REPORT = 5.0  # time in s for the pictures of the report
_BYTES = 1e8  # number of bytes of a volume that are written and read back in a second
_BUSIEST = 4.0  # largest factor by which other programs may slow this down
_MEASURING = 0.05  # fraction of the time limit for checks of the volume; checks are left out when they have used it


def fit_within(
    method: Method,
    limit: float,
    geometry: Geometry,
    target: OutputPaths,
    started: tuple[float, float],
    clock: Clock,
    warn: Warn,
) -> tuple[Method, Stop]:
    """The fit with its time limit, and the stop request for the checks. The time limit of the fit is that of the call,
    minus the time already used and the time for checks, report and writing. If no time is left, `warn` gets a sentence
    before the fit.

    Args:
        limit: time limit of the call in s.
        started: time of the clock when the call started, and the CPU time in s that the process had used by then.
    """
    grid, pages = Grid.matching(geometry), target.report is not None
    spent = clock.now() - started[0]
    busy = min(max(spent / max(time.process_time() - started[1], 1e-3), 1.0), _BUSIEST)
    after = busy * (_REPORT * pages + 4 * math.prod(grid.shape) / _BYTES)
    measuring = _MEASURING * limit
    remaining = limit - spent - measuring - after
    if remaining <= 0:
        measuring_text = duration_text(measuring + after)
        warn(
            f"{duration_text(limit)} is not enough for this scan: reading and correction took "
            f"{duration_text(spent)}, and checks, report and writing need about {measuring_text}. No time is left for "
            f"the {by_name(method.name).label} method, so it makes only one step."
        )
    before_report = Stop(deadline=started[0] + limit - after, now=clock.now)
    return with_settings(method, {"seconds": max(remaining, 0.0)}), before_report


@contextmanager
def warnings_shown(warn: Warn) -> Iterator[None]:
    """A context manager that forwards Python's warnings as sentences, without file and line."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *_: warn(str(message))
        yield


DecisionValues = Mapping[str, Sequence[Any]]


def refuse_views(method: Method, geometry: Geometry) -> None:
    """Raise ConfigError, before any work, if error bars cannot be computed from these projections."""
    if geometry.n_views < LEAST_VIEWS:
        raise ConfigError(
            f"--uncertainty needs at least {LEAST_VIEWS} projections, because the projections are split into two "
            f"halves; the scan has {geometry.n_views} projections. Leave out --uncertainty, or use more projections."
        )
    if isinstance(method, Fit) and method.finish_sweeps == 0:
        raise ConfigError(
            f"--uncertainty needs the voxel refinement of {method.name}, but --finish 0 switches it off. Leave out "
            "one of the two options."
        )


def deviation_of(
    volume: Volume, method: Method, views: Views, options: ReconOptions, decided: DecisionValues, control: RunControl
) -> Volume | None:  # fmt: skip
    """The standard deviation of each voxel of a volume in memory; None if `control` stopped the computation.

    Raises:
        ValueError: as `recon.error_bars.error_bars`.
    """
    bars = _bars(method, views, options, volume, decided, control)
    if control.stop():  # a direct method does not check for a stop request by itself
        return None
    return None if bars is None else Volume(bars.deviation, volume.grid)


def deviation_by_slabs(
    volume: Volume,
    method: Method,
    prepared: PreparedProjections,
    options: ReconOptions,
    slabs: Sequence[Slab],
    decided: DecisionValues,
    control: RunControl,
    say: Callable[[str], None],
) -> Volume | None:
    """The standard deviation of each voxel of a volume on disk, stored on the disk of the output; None if `control`
    stopped the computation.

    The slab with the most material comes first. The other slabs use the decisions that were made for it.
    """
    grid = Grid.matching(prepared.geometry)
    parts = slabs_of(grid.shape[0], slabs[0].own.stop, max(method.halo, HALO))
    out = scratch_array(Path(options.target.output).parent, grid.shape)
    for done, n in enumerate(busiest_first(prepared, grid, parts), 1):
        slab = parts[n]
        rows, geometry, box = part_of(prepared.geometry, grid, slab.slices)
        part = prepared.of_rows(rows, geometry).views
        if not part.seen.data.any():
            continue
        here = Volume(np.ascontiguousarray(volume.data[slab.slices]), box)
        bars = _bars(method, part, options, here, decided, control)
        if bars is None or control.stop():
            return None
        decided = bars.decided
        for z, share, values in zip(range(*slab.slices.indices(len(out))), slab.share, bars.deviation, strict=True):
            if share > 0:
                out[z] += share * values
        say(f"Error bars of slab {done} of {len(parts)}.")
    return Volume(out, grid)


def _bars(
    method: Method, views: Views, options: ReconOptions, volume: Volume, decided: DecisionValues, control: RunControl
) -> ErrorBars | None:  # fmt: skip
    views = views_for(method, views.seen)
    problem = ReconProblem(views, volume.grid, seed=options.seed, device=options.device)
    return error_bars(method, problem, volume, decided, replace(control, decide=None))
