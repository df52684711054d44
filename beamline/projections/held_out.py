"""Views held out: kept from the fit, handed to it all the same, so that its record says how it does on unseen data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.projections.prepare import PreparedProjections
from recon.base.geometry import Geometry

_EVERY = 10  # one of so many views is kept back where all of them were chosen

F32 = NDArray[np.float32]
Views = tuple[F32, Geometry]


def with_held_out(projections: F32, geometry: Geometry, held_out: Views | None) -> tuple[F32, Geometry, list[int]]:
    """Views to fit and views to judge by as one set for `recon.reconstruct`, and the numbers of the latter in it.

    The two share everything but their angles.
    """
    if held_out is None:
        return projections, geometry, []
    data, others = held_out
    together = geometry.at(np.concatenate((geometry.angles, others.angles)))
    return np.concatenate((projections, data)), together, list(range(geometry.n_views, together.n_views))


def keep_back(prepared: PreparedProjections) -> PreparedProjections:
    """The same views with every tenth held out, where none is yet.

    Raises:
        ConfigError: fewer than three views.
    """
    if prepared.held_out is not None:
        return prepared
    n, geometry, projections = prepared.geometry.n_views, prepared.geometry, prepared.projections
    if n < 3:
        raise ConfigError(f"{n} views leave none to hold out; choose more with --views, or leave out --early-stop.")
    # Not the first and last: a view next to nothing is no fair question.
    held = np.arange(min(_EVERY, n) // 2, n, _EVERY)
    used = np.setdiff1d(np.arange(n), held)
    return replace(
        prepared,
        projections=replace(
            projections, data=projections.data[used], view_ids=projections.view_ids[used], air=projections.air[used]
        ),
        geometry=geometry.select(used),
        held_out=(projections.data[held], geometry.select(held)),
    )
