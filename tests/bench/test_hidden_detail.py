"""Detail that a volume may hide, in real scans: a crack in a tooth, plastic around a metal wire.

Run with  pytest -m bench -s tests/bench/test_hidden_detail.py  (some minutes). PSNR, SNR and a small residual do not
see either: the fit alone has the smallest residual on the tooth, and fills its crack.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.projections.corrections.rings.rings import Rings
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.open import open_scan
from recon.base import choices
from tests.bench.quality_cases import F32

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1200)]

METHODS: dict[str, tuple[recon.Method, choices.Rings]] = {
    "FBP hann": (recon.Fbp(), "none"),
    "FBP hann, vo": (recon.Fbp(), "vo"),
    "fit alone": (recon.R2(finish=0), "none"),
    "r2": (recon.R2(), "none"),
    "r2, vo": (recon.R2(), "vo"),
    "FISTA-TV": (recon.FistaTv(), "none"),
    "OS-SIRT-TV": (recon.OsSirtTv(), "none"),
    "ASD-POCS": (recon.AsdPocs(), "none"),
    "SIRT": (recon.Sirt(), "none"),
    "SART": (recon.Sart(), "none"),
    "CGLS": (recon.Cgls(), "none"),
}
SHARP = "FBP hann", "FBP hann, vo", "r2", "r2, vo", "FISTA-TV", "OS-SIRT-TV"
COLUMNS = (375, 385, 395, 405, 415)


def _volume(path: Path, rows: slice, name: str) -> F32:
    method, rings = METHODS[name]
    with warnings.catch_warnings(), open_scan(path) as scan:
        warnings.simplefilter("ignore")
        prepared = prepare_projections(select(scan, Selection(steps=(Rings(rings),))), lambda _: None)
    data = np.ascontiguousarray(prepared.seen.data[:, rows])
    geometry = prepared.geometry.rows(rows.start, rows.start + data.shape[1])
    return recon.reconstruct(data, geometry, method, grid=recon.Grid.matching(geometry)).volume.data


def crack(profile: F32) -> tuple[float, int]:
    """Depth, 1 - darkest / beside, and width in voxels at half of it, of a crack in rows 7 to 19 of the profile."""
    at = 7 + int(np.argmin(profile[7:20]))
    beside = float(np.median(np.concatenate([profile[at - 7 : at - 3], profile[at + 4 : at + 8]])))
    half = (profile[at] + beside) / 2
    low, high = at, at
    while low > 0 and profile[low - 1] < half:
        low -= 1
    while high < len(profile) - 1 and profile[high + 1] < half:
        high += 1
    return 1 - float(profile[at]) / beside, high - low + 1


def width(profile: F32, middle: int, half: float) -> int:
    """How many voxels around `middle` are below `half`."""
    above = np.flatnonzero(profile >= half)
    return int(above[above > middle].min(initial=len(profile)) - above[above < middle].max(initial=-1)) - 1


@pytest.mark.parametrize("name", METHODS)
def test_crack_in_a_tooth(shared_data: Path, name: str) -> None:
    """Slice 0, rows 290 to 315: the crack is two to three voxels wide."""
    volume = _volume(shared_data / "aps2bm_tooth_181x2x640.h5", slice(0, 2), name)
    found = [crack(volume[0, 290:316, column]) for column in COLUMNS]
    print(f"\n{name:12s}", ", ".join(f"{depth:.2f} {width} px" for depth, width in found))
    if name in SHARP:
        assert min(depth for depth, _ in found) > 0.6
        assert max(width for _, width in found) <= 3


@pytest.mark.parametrize("name", METHODS)
def test_plastic_around_a_metal_wire(shared_data: Path, name: str) -> None:
    """Slice 70: its largest bubble, and even plastic; the metal is a hundred times denser.

    Depth: the median of rows 95 to 111, columns 82 to 94, against that of the plastic in rows 112 to 125, columns 50 to
    89. Width: along the columns, mean of rows 105 to 109, at half the plastic.
    """
    volume = _volume(shared_data / "diamond_24737_parallel_91x135x160.h5", slice(54, 86), name)[16]
    bubble, plastic = volume[95:112, 82:95], volume[112:126, 50:90]
    depth = 1 - float(np.median(bubble)) / float(np.median(plastic))
    grain = float(plastic.std() / plastic.mean())
    wide = width(volume[105:110].mean(axis=0), 88, float(np.median(plastic)) / 2)
    print(f"\n{name:12s} bubble {depth:.2f} deep, {wide} px wide, plastic {plastic.mean():.2e}, varies by {grain:.2f}")
    if name in SHARP:
        assert depth > 0.9
        assert grain < 0.7
