"""Few photons: the likelihood of counts against their logarithm, for the fit and for OS-SIRT-TV."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from recon.prep.counts import Counts
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.battery import battery
from tests.bench.quality_cases import F32, OBJECTS, padded

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
SIDE, VIEWS, THICKEST = 64, 60, 3.0  # pixels and voxels a side; the largest line integral
PHOTONS = (10, 30, 100, 300, 1000)
TV_WEIGHTS = (0.004, 0.008, 0.016, 0.032, 0.064)
GEOMETRY = recon.Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), (SIDE, SIDE), pixel_pitch=1 / SIDE)
GRID = recon.Grid.matching(GEOMETRY)


def _samples() -> Iterator[tuple[str, F32, F32]]:
    """Name, line integrals and truth; two rays a pixel and side."""
    fine = Detector.centred((2 * SIDE, 2 * SIDE), 0.5 / SIDE)
    can = Phantom.of(battery(np.random.default_rng(0), (1.0, 1.0), 40))
    clean = np.stack([can.line_integrals(a, fine) for a in GEOMETRY.angles])
    yield "battery", _joined(clean), can.attenuation(GRID)
    twice = recon.Geometry.parallel(GEOMETRY.angles, (2 * SIDE, 2 * SIDE), pixel_pitch=0.5 / SIDE)
    for name in ("shell", "thorax"):
        large = padded(OBJECTS[name](DATA), 4 * SIDE).reshape(2 * SIDE, 2, 2 * SIDE, 2, 2 * SIDE, 2)
        volume = large.mean(axis=(1, 3, 5), dtype=np.float32)
        clean = Projector(twice, recon.Grid.matching(twice)).forward(volume)
        yield name, _joined(clean), volume.reshape(SIDE, 2, SIDE, 2, SIDE, 2).mean(axis=(1, 3, 5), dtype=np.float32)


def _joined(clean: Any) -> F32:
    return np.asarray(clean.reshape(VIEWS, SIDE, 2, SIDE, 2).mean(axis=(2, 4)), np.float32)


def _db(volume: F32, truth: F32) -> float:
    return float(10 * np.log10(truth.max() ** 2 / np.mean((np.maximum(volume, 0) - truth) ** 2)))


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
def test_few_photons() -> None:
    """dB (volume's sum over the truth's) at each number of photons without the sample; OS-SIRT-TV at its best."""
    print("\n| sample | photons | data | R² | OS-SIRT-TV | R² CPU s |\n|---|---|---|---|---|---|")
    gains = []
    for name, clean, truth in _samples():
        scale = THICKEST / float(clean.max())
        clean, truth = clean * scale, truth * scale
        for photons in PHOTONS:
            n = np.random.default_rng(1).poisson(photons * np.exp(-clean))
            weights = (np.maximum(n, 0.5) / photons).astype(np.float32)
            half = -np.log(np.maximum(n, 0.5) / photons)
            given: dict[str, tuple[Any, recon.DataUse]] = {
                "log, floor 1e-4": (-np.log(np.maximum(n / photons, 1e-4)), recon.DataUse()),
                "log, floor half a photon": (half, recon.DataUse()),
                "the same, weighed by counts": (half, recon.DataUse(weights=weights)),
                "counts": (Counts(n, np.full((SIDE, SIDE), float(photons))), recon.DataUse()),
            }
            found = {}
            for data, (values, use) in given.items():
                begin = time.process_time()
                fit = recon.reconstruct(values, GEOMETRY, recon.R2(steps=500), use=use).volume.data
                seconds = time.process_time() - begin
                voxels = [
                    recon.reconstruct(values, GEOMETRY, recon.OsSirtTv(iterations=20, tv_weight=w), use=use).volume.data
                    for w in TV_WEIGHTS
                ]
                best = max(voxels, key=lambda v: _db(v, truth))
                found[data] = _db(fit, truth)
                cells = [f"{_db(v, truth):.1f} ({v.sum() / truth.sum():.2f})" for v in (fit, best)]
                print(f"| {name} | {photons} | {data} | {cells[0]} | {cells[1]} | {seconds:.1f} |", flush=True)
            gains.append(found["counts"] - found["log, floor 1e-4"])
    assert np.mean(gains) > 1
