"""Budget: selects the methods that `auto` may try within a time limit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

from beamline.core.sinks import Warn
from recon.assess.time_model import duration_text
from recon.base.geometry import Geometry
from recon.base.method import Clock, Method
from recon.base.volume import Grid
from recon.forecast import Timing

_TIMED_VOXELS = 2**17  # number of voxels of the part that is reconstructed to measure the time


def in_budget(
    method: Method, budget: float, geometry: Geometry, grid: Grid, now: Clock, warn: Warn
) -> tuple[Method, str]:
    """`method`, restricted to the candidates that end in time; if none of them does, the fastest candidate. The second
    result is a sentence that says which methods remain, and why.

    A few iterations of each method are timed. The times predicted from them are compared with the remaining seconds.
    The remaining methods then run to their usual end, as without a time limit.

    Args:
        warn: function that gets a sentence if even the fastest method will be late.

    Raises:
        ValueError: no method can use these projections.
    """
    end = now() + budget
    timing = Timing(geometry, grid, now, _TIMED_VOXELS)
    affordable, seconds, refusals = list[Method](), dict[str, float](), list[str]()
    for each in method.alternatives:
        try:
            seconds[each.name] = timing.of(each).most
            affordable.append(each)
        except ValueError as error:
            refusals.append(f"{each.name}: {error}")
    if not affordable:
        raise ValueError("; ".join(refusals))
    chosen, expected, out = _without_slow(method, affordable), 0.0, list[str]()
    while (expected := timing.of(chosen).most) > end - now() and len(affordable) > 1:
        slowest = max(affordable, key=lambda each: seconds[each.name])
        affordable.remove(slowest)
        chosen = _without_slow(method, affordable)
        out.append(f"with {slowest.name}, tests and volume would take about {duration_text(expected)}")
    if (excess_seconds := expected - (end - now())) > 0:
        fastest_name = affordable[0].name
        warn(
            f"{duration_text(budget)} is too short for this scan: even the fastest method, {fastest_name}, which is "
            f"used now, will end about {duration_text(excess_seconds)} after this limit."
        )
    if out:
        out.append(f"about {duration_text(max(0.0, end - now()))} remained")
    names = " or ".join(each.name for each in affordable)
    return chosen, "; ".join((f"{duration_text(budget)} for {names}", *out))


def _without_slow(method: Method, affordable: list[Method]) -> Method:
    """The method that chooses only among `affordable`; if only one method is left, that method."""
    return (
        affordable[0]
        if len(affordable) == 1
        else cast(Method, replace(cast(Any, method), candidates=tuple(affordable)))
    )
