"""A changing sample: one joint fit compared with sub-scans and with one volume that ignores time.

pytest -m bench -s tests/bench/test_series.py    (minutes)
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import recon
from recon.base.arrays import F32
from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.sample import sample_at
from simulators.scenes.scene import load_scene

pytestmark = pytest.mark.bench
SIDE, PITCH, PHOTONS, VIEWS = 48, 0.01, 5e4, 72
PARTS = 1, 2, 3, 4, 6  # sub-scans beside which the fit stands
TIMES = (np.arange(12) + 0.5) / 12
FOAM = {"kind": "foam", "diameter": 0.408, "height": 0.408, "n_holes": 120, "largest_um": 107.0, "smallest_um": 35.0,
        "gap_um": 4.0, "candidates": 40_000, "change": {"kind": "settle", "share": 0.25, "over_s": 0.7}}  # fmt: skip
CELL = {"kind": "cathode", "diameter": 0.442, "height": 0.384, "wall_um": 15.0, "size_um": 68.6, "fill": 0.35,
        "change": {"kind": "charge", "factor": 0.5, "from_s": 0.1, "over_s": 0.8, "each_s": 0.08}}  # fmt: skip


def scanned(phantom: dict[str, Any]) -> tuple[recon.TimedViews, F32]:
    """Golden-angle views over a second by exact chords, 2 x 2 rays a pixel, with photon noise; the truth at `TIMES`."""
    sample = load_scene({"phantom": phantom, "beam": {"photons_per_s": 1.0}}).sample
    times = (np.arange(VIEWS) + 0.5) / VIEWS
    angles = np.pi * (np.sqrt(5) - 1) / 2 * np.arange(VIEWS)
    detector = Detector.centred((SIDE, SIDE), PITCH)
    aims = [detector.aimed(row, col) for row in (-0.25, 0.25) for col in (-0.25, 0.25)]
    light = []
    for angle, seconds in zip(angles.tolist(), times.tolist(), strict=True):
        now = sample_at(sample, seconds)
        light.append(np.mean([np.exp(-now.line_integrals(angle, aim)) for aim in aims], 0))
    counts = np.random.default_rng(0).poisson(PHOTONS * np.stack(light)).clip(1)
    geometry = recon.Geometry.parallel(angles, (SIDE, SIDE), pixel_pitch=PITCH)
    truth = np.stack([sample_at(sample, t).attenuation(Grid.matching(geometry)) for t in TIMES.tolist()])
    return recon.TimedViews(-np.log(counts / PHOTONS).astype(np.float32), geometry, times), truth


def of_sub_scans(views: recon.TimedViews, parts: int) -> F32:
    """FISTA-TV of each part, weights by views held out; linear in time between the middles of parts."""
    edges = np.arange(parts + 1) * VIEWS // parts
    cut = [np.arange(first, stop) for first, stop in pairwise(edges)]
    volumes = [
        recon.reconstruct(views.projections[at], views.geometry.select(at), method=recon.FistaTv()).volume.data
        for at in cut
    ]
    middles = np.array([views.times[at].mean() for at in cut])
    shares = np.stack([np.interp(TIMES, middles, row) for row in np.eye(parts)], 1)
    return np.tensordot(shares, np.stack(volumes), 1).astype(np.float32)


@pytest.mark.parametrize(("phantom", "knots", "motion"), [(FOAM, 3, True), (CELL, 4, False)])
def test_one_fit_in_time(phantom: dict[str, Any], knots: int, motion: bool) -> None:
    views, truth = scanned(phantom)

    def psnr(found: F32) -> float:
        return float(10 * np.log10(np.ptp(truth) ** 2 / ((found - truth) ** 2).mean()))

    others = {}
    for parts in PARTS:
        began = time.process_time()
        others[parts] = psnr(of_sub_scans(views, parts))
        print(
            f"\n{phantom['kind']}: {parts} parts {others[parts]:.2f} dB, {time.process_time() - began:.1f} CPU s",
            end="",
        )
    began = time.process_time()
    found = recon.fit_series(views, knots, motion=motion)
    ours = psnr(np.stack([found.at(t) for t in TIMES.tolist()]))
    print(f"\n{phantom['kind']}: {knots} volumes: {ours:.2f} dB, {time.process_time() - began:.1f} CPU s")
    assert ours > max(others.values())
