"""Prepared projections made of line integrals, for tests of what follows the correction."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.projections.prepared import PreparedProjections
from recon.base.geometry import Geometry
from recon.prep.correct import Projections


def prepared_views(
    data: NDArray[np.float32], geometry: Geometry, weights: NDArray[np.float32] | None = None, **more: Any
) -> PreparedProjections:
    """The views of these line integrals [view, row, col], numbered in order; `more` fields by name."""
    n = geometry.n_views
    masked = np.zeros(geometry.detector_shape, np.bool_)
    whole = Projections(data, np.arange(n), 0.0, np.ones(n, np.float32), masked, weights=weights)
    return PreparedProjections(whole, geometry, geometry.axis_col, None, **{
        "held_out": None, "n_projections": n, "length_unit": "mm", "quantity": "counts", **more
    })  # fmt: skip
