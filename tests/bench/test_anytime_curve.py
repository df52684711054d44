"""Quality of the live volume after each quarter of a scan, compared with FBP and a fit to the same projections.

Run with  pytest -m bench -s tests/bench/test_anytime_curve.py ; about 5 minutes of CPU time. Rendered views are the
measure of compute that is the same on any machine: a stream renders so many while a view is taken, and the fit from
scratch as many as the stream has in all until then.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import recon
from beamline.plan.plan import fixed, golden, interlaced
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting.finish import finish
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project
from recon.splatting.stream import StreamingFit
from recon.voxels.fbp import fbp
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.composed import battery
from tests.clock import SteppedClock

F32 = NDArray[np.float32]
Scan = tuple[F32, Geometry, F32]

ROWS, SIDE, VIEWS, PHOTONS = 14, 128, 90, 5000
QUARTERS = tuple(round(q * VIEWS) for q in (0.25, 0.5, 0.75, 1.0))
LAST = 400  # views rendered after the scan
ORDERS = {"sequential": fixed(VIEWS), "interlaced": interlaced(VIEWS, 6), "golden": golden(VIEWS)}


def _noisy(exact: NDArray[np.float64]) -> F32:
    counts = np.random.default_rng(0).poisson(PHOTONS * np.exp(-exact))
    return (-np.log(np.maximum(counts, 1) / PHOTONS)).astype(np.float32)


def particles(angles: NDArray[np.float64]) -> Scan:
    """Middle rows of a battery, four rays a pixel."""
    pitch = 0.72 / SIDE
    phantom = Phantom.of(battery(np.random.default_rng(7), (0.72, 0.36), 120))
    fine = Detector.centred((2 * ROWS, 2 * SIDE), pitch / 2)
    exact = [phantom.line_integrals(a, fine).reshape(ROWS, 2, SIDE, 2).mean(axis=(1, 3)) for a in angles]
    geometry = Geometry.parallel(angles, (ROWS, SIDE), pixel_pitch=pitch)
    return _noisy(np.stack(exact)), geometry, phantom.attenuation(Grid.matching(geometry))


def smooth(angles: NDArray[np.float64]) -> Scan:
    """A density that changes slowly, projected at twice the resolution."""
    shape = (2 * ROWS, 2 * SIDE, 2 * SIDE)
    waves = gaussian_filter(np.random.default_rng(5).normal(size=shape), 8)
    y, x = np.indices(shape[1:]) - (SIDE - 0.5)
    fine = np.maximum(1 + 0.5 * waves / waves.std(), 0) * np.clip((0.84 * SIDE - np.hypot(y, x)) / 12, 0, 1)
    clean = Projector(Geometry.parallel(angles, shape[:2], pixel_pitch=0.5), Grid(shape, 0.5)).forward(
        fine.astype(np.float32)
    )
    scale = 2 / float(clean.max())
    exact = scale * clean.reshape(VIEWS, ROWS, 2, SIDE, 2).mean(axis=(2, 4), dtype=np.float64)
    truth = scale * fine.reshape(ROWS, 2, SIDE, 2, SIDE, 2).mean(axis=(1, 3, 5))
    return _noisy(exact), Geometry.parallel(angles, (ROWS, SIDE), pixel_pitch=1.0), truth.astype(np.float32)


@dataclass(frozen=True)
class QualityCurve:
    """PSNR in dB after each quarter of a scan, at its end after the last round, and after the finish on voxels."""

    quarters: list[float]
    end: float
    finished: float
    seconds: float

    def told(self, name: str) -> None:
        cells = " | ".join(f"{value:.2f}" for value in (*self.quarters, self.end, self.finished))
        print(f"| {name} | {cells} | {self.seconds:.0f} |", flush=True)


def streamed(scan: Scan, renders: int) -> QualityCurve:
    """A stream that renders so many views while one is taken, and LAST in its last round."""
    data, geometry, truth = scan
    begin, grid = time.process_time(), Grid.matching(geometry)
    model = StreamingFit(geometry, grid, now=SteppedClock(tick=1.0))  # which counts steps
    share = model.settings.views_per_step
    found = []
    for view in range(VIEWS):
        model.add_views(data[view : view + 1], geometry.angles[view : view + 1])
        model.advance(renders / share)
        if view + 1 in QUARTERS:
            found.append(psnr(truth, model.snapshot().data))
    model.finish(LAST / share)
    seconds, volume, gaussians = time.process_time() - begin, model.snapshot(), model.gaussians
    assert gaussians is not None
    refined = finish(volume, gaussians, ReconProblem(Views(data, geometry), grid), settings=model.settings).volume
    return QualityCurve(found, psnr(truth, volume.data), psnr(truth, refined.data), seconds)


def from_scratch(scan: Scan, renders: int) -> QualityCurve:
    """Fits to the views so far, each with all that a stream could have rendered until then."""
    data, geometry, truth = scan

    def quality(views: int, more: int, sweeps: int | None = 0) -> float:
        method = recon.R2(steps=(renders * views + more) // 2, finish=sweeps)
        return psnr(truth, recon.reconstruct(data[:views], geometry.select(range(views)), method).volume.data)

    found = [quality(views, 0) for views in QUARTERS]
    begin = time.process_time()
    end = quality(VIEWS, LAST)
    seconds = time.process_time() - begin
    return QualityCurve(found, end, quality(VIEWS, LAST, None), seconds)


def direct(scan: Scan) -> list[float]:
    data, geometry, truth = scan
    return [psnr(truth, fbp(data[:n], geometry.select(range(n)), filter="hann")) for n in QUARTERS]


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("renders", [10, 50])
@pytest.mark.parametrize("sample", [particles, smooth])
def test_quality_at_every_quarter(sample: Callable[[NDArray[np.float64]], Scan], renders: int) -> None:
    print(f"\n{sample.__name__}, {renders} views rendered a view taken")
    for order, angles in ORDERS.items():
        if renders > 10 and order != "golden":
            continue
        scan = sample(angles)
        stream, batch = streamed(scan, renders), from_scratch(scan, renders)
        print(f"| FBP, {order} | " + " | ".join(f"{value:.2f}" for value in direct(scan)) + " | | | |")
        batch.told(f"from scratch, {order}")
        stream.told(f"stream, {order}")
        assert stream.finished > batch.finished - 0.2


def two_cores() -> float:
    """Seconds of two cores that are all ours: other work on the machine does not count."""
    return time.process_time() / 2


def slab(rows: int, side: int, count: int, views: int) -> tuple[F32, Geometry]:
    """Views of many small Gaussians in golden order, with noise."""
    rng = np.random.default_rng(0)
    radius, turn = 0.42 * side * rng.random(count) ** 0.5, rng.uniform(0, 2 * np.pi, count)
    means = np.stack((radius * np.cos(turn), radius * np.sin(turn), rng.uniform(-0.5, 0.5, count) * rows), 1)
    model = Gaussians.from_physical(means, rng.uniform(1, 3, (count, 3)), rng.uniform(0.5, 1, count) / side)
    geometry = Geometry.parallel(golden(views), (rows, side))
    data = project(model, geometry).numpy()
    return (data + rng.normal(0, 0.005 * data.max(), data.shape)).astype(np.float32), geometry
