"""Weak matter on a real scan: the cap of Diamond's resin dome, which a volume without negative densities lost.

pytest -m bench -s tests/bench/test_weak_matter.py    (needs ../shared/data; minutes)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.storage.readers.open import open_scan

pytestmark = pytest.mark.bench
CAP, AIR, RADIUS = slice(27, 37), slice(4, 19), 40  # slices of the cap, slices above it; voxels about the middle
METHODS = {"FISTA-TV": recon.FistaTv(), "r2": recon.R2(), "SIRT": recon.Sirt()}


def _volume(shared_data: Path, method: recon.Method, air: str) -> NDArray[np.float32]:
    with open_scan(shared_data / "diamond_24737_parallel_91x135x160.h5") as scan:
        prepared = prepare_projections(scan, Selection(steps=(Air(air),)), lambda _: None)
    return recon.reconstruct(prepared.projections.data, prepared.geometry, method).volume.data


def mass(volume: NDArray[np.float32]) -> float:
    """Of the cap, above the volume's own air."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in volume.shape[1:])
    near = np.hypot(y[:, None], x) < RADIUS
    return float((volume[CAP][:, near] - volume[AIR][:, near].mean()).sum())


@pytest.mark.parametrize("name", METHODS)
def test_the_cap_keeps_its_mass(shared_data: Path, name: str) -> None:
    shown = mass(_volume(shared_data, recon.Fbp(), "none"))
    kept, before = (mass(_volume(shared_data, METHODS[name], wanted)) / shown for wanted in ("auto", "none"))
    print(f"\n{name:10s} {kept:.2f} of the mass that FBP shows; {before:.2f} by a line through the air at both sides")
    assert 0.9 < kept < 1.1
    assert before < 0.3
