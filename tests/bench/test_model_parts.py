"""What each part of the model gains on the two real scans: views held out, edge width, rings.

pytest -m bench -s tests/bench/test_model_parts.py    (needs ../shared/data; minutes)
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.corrections.width import Width
from beamline.projections.prepare import prepare_projections
from beamline.projections.protocols import PrepStep
from beamline.projections.selection import Selection
from beamline.storage.readers.open import open_scan
from recon.voxels.held_out import split_views
from recon.voxels.projector import Projector
from tests.recon.prep.ring_score import ring_score

pytestmark = [pytest.mark.bench, pytest.mark.timeout(3600)]
F32 = NDArray[np.float32]
SCANS = {"Diamond": ("diamond_24737_parallel_91x135x160.h5", 70), "tooth": ("aps2bm_tooth_181x2x640.h5", 0)}
TERMS = {"background": ("background",), "geometry": ("axis", "roll", "tilt", "shifts"), "gains": ("gains",)}
PARTS: dict[str, tuple[PrepStep, ...]] = {
    "air by columns alone": (Air("columns"),),
    "default": (),
    **{f"calibrate {name}": (Calibrate(terms),) for name, terms in TERMS.items()},
    "ray width: pixel": (Width("pixel"),),
}
PLATEAU, AROUND = 4, 8  # pixels on either side of an edge


def edge_width(image: F32) -> float:
    """Median distance from 10 to 90 % of the outer edge of the sample, in pixels, along rows of a slice."""
    found = []
    half = 0.5 * float(np.percentile(image, 95))
    for row in image[len(image) // 3 : -len(image) // 3]:
        at = int(np.argmax(row > half))
        if not AROUND < at < row.size - AROUND:
            continue
        part = np.asarray(row[at - AROUND : at + AROUND], np.float64)
        low, high = part[:PLATEAU].mean(), part[-PLATEAU:].mean()
        share = np.maximum.accumulate((part - low) / (high - low))
        found.append(np.interp(0.9, share, np.arange(share.size)) - np.interp(0.1, share, np.arange(share.size)))
    return float(np.median(found))


@pytest.mark.parametrize("scan", SCANS)
def test_each_part_of_the_model(shared_data: Path, scan: str) -> None:
    file, at = SCANS[scan]
    print(f"\n{scan:22s} held out, all rays   with matter   edge px   rings   CPU s")
    left = {}
    for name, steps in PARTS.items():
        begin = time.process_time()
        with open_scan(shared_data / file) as source:
            prepared = prepare_projections(source, Selection(steps=steps), lambda _: None)
        spent = time.process_time() - begin
        data, views = prepared.projections.data, prepared.geometry
        seen, unseen = split_views(views, 6)
        volume = recon.reconstruct(data[seen], views.select(seen), recon.FistaTv()).volume
        off = data[unseen] - Projector(views.select(unseen), volume.grid).forward(volume.data)
        matter = data[unseen] > 0.1 * np.percentile(data, 99)
        whole = recon.reconstruct(data, views, recon.FistaTv()).volume.data[at]
        left[name] = float(np.sqrt(np.mean(off**2)))
        score = ring_score(whole, ((len(whole) - 1) / 2, (whole.shape[1] - 1) / 2)) * 1e5
        print(
            f"{name:22s} {left[name]:18.4f} {np.sqrt(np.mean(off[matter] ** 2)):13.4f} {edge_width(whole):9.2f} "
            f"{score:7.1f} {spent:7.1f}"
        )
    assert left["default"] <= left["air by columns alone"] * 1.001
