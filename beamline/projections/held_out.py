"""Views held out: chosen out of a scan's views, and handed to `recon.reconstruct` beside the views that it uses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamline.core.errors import ConfigError
from beamline.projections.prepared import PreparedProjections
from recon.base.arrays import F32, I64
from recon.base.geometry import Geometry

Views = tuple[F32, Geometry]


def with_held_out(projections: F32, geometry: Geometry, held_out: Views | None) -> tuple[F32, Geometry, list[int]]:
    """Views used and views held out as one set, and the numbers of the views held out in it.

    The two geometries are of the same set-up.
    """
    if held_out is None:
        return projections, geometry, []
    data, others = held_out
    together = geometry.followed_by(others)
    return np.concatenate((projections, data)), together, list(range(geometry.n_views, together.n_views))


def hold_out(
    prepared: PreparedProjections, one_in: int, *, most: int | None = None, advice: str
) -> PreparedProjections:
    """One of `one_in` views held out, evenly spread; unchanged where the selection already left some out.

    Args:
        most: number of views held out at most.
        advice: how to do without, for the error.

    Raises:
        ConfigError: fewer than two views would be left.
    """
    if prepared.held_out is not None:
        return prepared
    n = prepared.geometry.n_views
    count = max(1, n // one_in)
    count = count if most is None else min(count, most)
    if n - count < 2:
        raise ConfigError(f"{n} views are too few to hold some out; choose more with --views, or {advice}.")
    # Neither the first nor the last: they have a neighbour on one side only.
    # Neither the first nor the last: they have a neighbour on one side only.
    held = np.unique((np.arange(count) + 0.5) * n // count).astype(np.int64)
    return with_views_held_out(prepared, held)


def with_views_held_out(prepared: PreparedProjections, held: I64) -> PreparedProjections:
    """The same with the views of these numbers held out, sorted."""
    projections, counted = prepared.projections, prepared.projections.weights
    return replace(
        prepared.of_views(np.setdiff1d(np.arange(prepared.geometry.n_views), held)),
        held_out=(projections.data[held], prepared.geometry.select(held)),
        held_out_ids=projections.view_ids[held],
        held_out_weights=None if counted is None else counted[held],
    )
