"""Prepared projections: from a scan as a reconstruction prepares it, or from given line integrals."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.projections.correction import ScanCorrectionPlan
from beamline.projections.growing import FedCorrection, feed
from beamline.projections.prepare import DiskBuffer, prepare_projections
from beamline.projections.prepared import Corrected, PreparedProjections, ScanOrigin
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.prep.projections import Projections, merge_and_empty


def prepare(
    scan: Any, selection: Selection, buffer: DiskBuffer | None = None, **opened: Any
) -> tuple[PreparedProjections, list[str]]:
    """The prepared projections of a source, or of a file opened with `opened`, and the messages about them."""
    told: list[str] = []
    with ExitStack() as until:
        source = until.enter_context(SourceOptions(scan, **opened).open()) if isinstance(scan, Path) else scan
        return prepare_projections(select(source, selection), told.append, buffer), told


def feed_batches(
    plan: ScanCorrectionPlan, batches: list[NDArray[np.int64]], *, ended: bool = True, warn: Warn = pytest.fail
) -> tuple[Projections, FedCorrection]:
    """Line integrals of batches of frames that are fed one after the other, and the state after them.

    Args:
        ended: the last batch is fed as the last one; otherwise the end comes later.
    """
    state, parts = FedCorrection(plan), list[Projections]()
    for n, batch in enumerate(batches if ended else [*batches, np.arange(0)], 1):
        lines, state = feed(state, batch, last=n == len(batches) + (not ended), warn=warn)
        parts += [] if lines is None else [lines]
    return merge_and_empty(parts), state


def prepared_views(
    data: NDArray[np.float32], geometry: Geometry, weights: NDArray[np.float32] | None = None, **more: Any
) -> PreparedProjections:
    """Prepared projections from line integrals [view, row, col], numbered in order; `more`: further fields by name."""
    n = geometry.n_views
    masked = np.zeros(geometry.detector_shape, np.bool_)
    whole = Projections(data, np.arange(n), 0.0, np.ones(n, np.float32), masked, weights=weights)
    lines = Views(data, geometry, weights, np.arange(n))
    origin = ScanOrigin(geometry.axis_col, None, n, "mm", "counts")
    return PreparedProjections(lines, Corrected.of(whole), origin, **more)
