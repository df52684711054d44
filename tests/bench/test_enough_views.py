"""Measures the rule of enough views: how many it saves, and how far below the whole scan the volume stays.

Run with  pytest -m bench -s tests/bench/test_enough_views.py . Golden-ratio order; the volumes judged are those of the
fit with its finish, from the views until the stop and from all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.reconstruct.followed_views import GROWTH, EnoughViews
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.enough_views import Goal
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.bench.quality_cases import walnut

F32 = NDArray[np.float32]
GOLDEN = (5**0.5 - 1) / 2
PHOTONS, BODIES, VIEWS = (500, 2000, 8000, 50_000), (10, 40, 120), 120
GOALS = (0.3, 0.5, 1.0)


def scene(seed: int, side: int = 64, rows: int = 16) -> tuple[F32, Geometry, F32]:
    """A can with ellipsoids: views in golden-ratio order, their geometry, and the true attenuation."""
    rng = np.random.default_rng(seed)
    photons, height, pitch = PHOTONS[seed % 4], rows * 0.72 / side, 0.72 / side
    bodies = []
    for _ in range(BODIES[seed % 3]):
        r, turn, z = 0.28 * rng.random() ** 0.5, rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4) * height
        axes = tuple(rng.uniform(0.01, 0.06, 3).tolist())
        bodies.append(Ellipsoid(axes, float(rng.uniform(1, 6)), centre=(r * np.cos(turn), r * np.sin(turn), z)))
    phantom = Phantom.of((Cylinder(0.33, 0.9 * height, 2.0), *bodies))
    geometry = Geometry.parallel((np.arange(VIEWS) * GOLDEN % 1) * np.pi, (rows, side), pixel_pitch=pitch)
    detector = Detector.centred((rows, side), pitch)
    exact = np.stack([phantom.line_integrals(angle, detector) for angle in geometry.angles])
    counts = np.maximum(rng.poisson(photons * np.exp(-exact)), 1)
    return -np.log(counts / photons).astype(np.float32), geometry, phantom.attenuation(Grid.matching(geometry))


def measured(data: F32, geometry: Geometry, truth: F32, seed: int) -> list[tuple[int, float]]:
    """(views at the stop, dB lost against all views) for each of GOALS."""
    stops = dict.fromkeys(GOALS, geometry.n_views)
    watch = EnoughViews(Goal(psnr_loss=GOALS[0]), seed)
    n = watch.next_look
    while n < geometry.n_views and stops[GOALS[0]] == geometry.n_views:
        gain = watch.look(data[:n], geometry)
        if gain is not None:
            for limit in GOALS:
                if Goal(psnr_loss=limit).met(gain):
                    stops[limit] = min(stops[limit], n)
        n = int(np.ceil(GROWTH * n))
    quality = {
        n: psnr(truth, recon.reconstruct(data[:n], geometry.select(np.arange(n)), recon.R2()).volume.data)
        for n in {*stops.values(), geometry.n_views}
    }
    return [(stops[limit], quality[geometry.n_views] - quality[stops[limit]]) for limit in GOALS]


def told(name: str, found: list[tuple[int, float]], planned: int) -> None:
    cells = "".join(f" {n} of {planned}, {loss:+.2f} dB |" for n, loss in found)
    print(f"| {name} |{cells}", flush=True)


@pytest.mark.bench
@pytest.mark.timeout(3600)
def test_a_scan_that_is_stopped_loses_little() -> None:
    found = []
    for seed in range(100, 120):
        data, geometry, truth = scene(seed)
        found.append(measured(data, geometry, truth, seed))
        told(f"{PHOTONS[seed % 4]} photons, {BODIES[seed % 3]} bodies", found[-1], VIEWS)
    for k, limit in enumerate(GOALS):
        losses, stops = (np.array([row[k][i] for row in found]) for i in (1, 0))
        print(
            f"psnr_loss {limit}: lost at most 0.3 dB in {np.sum(losses <= 0.3)} of {len(found)}, {losses.max():.2f} dB "
            f"at most; {1 - stops.mean() / VIEWS:.0%} of the views saved"
        )
    assert np.mean([row[0][1] <= 0.3 for row in found]) >= 0.9


@pytest.mark.bench
@pytest.mark.timeout(1800)
def test_the_walnut_slab(shared_data: Path) -> None:
    case = walnut(shared_data, VIEWS)
    order = np.argsort((np.arange(VIEWS) * GOLDEN) % 1).argsort()  # a golden-ratio permutation of the measured angles
    rows = slice(44, 52)
    data = np.ascontiguousarray(case.projections[order, rows])
    geometry = case.geometry.rows(rows.start, rows.stop).select(order)
    found = measured(data, geometry, case.truth[rows], 0)
    told("walnut slab", found, VIEWS)
    assert found[0][1] <= 0.3
