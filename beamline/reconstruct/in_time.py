"""In time: divides the seconds of a whole call between the fit and the work after it."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.measure import residual_share
from beamline.reconstruct.output_paths import OutputPaths
from drivers.base.clock import Clock
from recon.assess.time_model import duration_text
from recon.base.method import BoundedMethod
from recon.base.stop import Stop
from recon.base.volume import Grid
from recon.methods import by_name, with_settings
from recon.splatting.fit_method import FitMethod
from recon.splatting.in_time import first_sweep_seconds
from recon.splatting.initialise import sweeps_of_start

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
