"""Corrected projections of real scans, for tests of later steps."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

import recon


def tooth_views(shared_data: Path) -> tuple[NDArray[np.float32], recon.Geometry]:
    """Line integrals [view, row, col] of the tooth, and their geometry."""
    with h5py.File(shared_data / "aps2bm_tooth_181x2x640.h5") as file:
        exchange = file["exchange"]
        dark, flat = (exchange[name][:].mean(axis=0).astype(np.float32) for name in ("data_dark", "data_white"))
        counts, angles = exchange["data"][:], np.radians(exchange["theta"][:])
    views = recon.correct(counts, np.arange(len(counts), dtype=float), recon.References(dark, ((0.0, flat),))).data
    return views, recon.Geometry.parallel(angles, views.shape[1:], axis_col=295.6)
