"""Measures the table in recon/assess/time_model.py: dB above FBP against steps, by binning and number of Gaussians.

Run with  pytest -m bench -s tests/bench/test_quality_curves.py ; it prints the table as it stands in that module. It
takes some minutes, and only its ratios of times mean something on another machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.assess.metrics import psnr
from recon.assess.time_model import CURVES, Curve
from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.base.volume import Grid
from recon.splatting.initialise import default_count
from recon.voxels.fbp import fbp
from recon.warm_up import warm_up
from simulators.frame.detector import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.battery import battery

F32 = NDArray[np.float32]
STEPS = (30, 60, 125, 250, 500, 1000)
KINDS = ((1, 0.25), (1, 0.5), (1, 1.0), (1, 2.0), (2, 0.25))


def walnut(shared_data: Path) -> tuple[F32, Geometry, F32]:
    """Measured: 60 views of a slab of 40 rows, against the FDK of 1201 views."""
    with h5py.File(shared_data / "walnut_parallel_rebinned_240x96x256.h5") as file:
        angles = np.radians(file["exchange/theta"][...])
        pitch = float(file.attrs["pixel_size_mm"])
        views = parse_views("fixed:60", angles)
        data = np.stack([file["exchange/data"][int(v), 28:68] for v in views]).astype(np.float32)
    with np.load(shared_data / "walnut_fdk_256.npz") as file:
        truth = np.asarray(file[file.files[0]][98:138], np.float32)
    return data, Geometry.parallel(angles[views], data.shape[1:], pitch, 127.5), truth


def particles(shared_data: Path) -> tuple[F32, Geometry, F32]:
    """Simulated: 90 views of a battery, 5000 photons a pixel."""
    rng = np.random.default_rng(7)
    pitch, shape = 0.72 / 160, (48, 160)
    phantom = Phantom.of(battery(rng, (0.72, 48 * pitch), 50))
    geometry = Geometry.parallel(np.linspace(0, np.pi, 90, endpoint=False), shape, pitch)
    detector = Detector.centred(shape, pitch)
    exact = np.stack([phantom.line_integrals(angle, detector) for angle in geometry.angles])
    counts = rng.poisson(5000 * np.exp(-exact))
    data = -np.log(np.maximum(counts, 1) / 5000).astype(np.float32)
    return data.astype(np.float32), geometry, phantom.attenuation(Grid.matching(geometry))


def measured(data: F32, geometry: Geometry, truth: F32) -> dict[tuple[int, float], list[tuple[float, float]]]:
    """(CPU s a step, dB above FBP) for each of STEPS, by kind; CPU time is the same on a busy machine."""
    base = psnr(truth, fbp(data, geometry, filter="hann"))
    grid = Grid.matching(geometry)
    count = default_count(Grid.of_field(geometry, grid.voxel_size))
    out: dict[tuple[int, float], list[tuple[float, float]]] = {}
    for binning, share in KINDS:
        for steps in STEPS:
            fit, control = (
                recon.R2(steps=steps, gaussians=round(share * count)),
                recon.RunControl(now=time.process_time),
            )
            binned, coarse = bin_views(data, binning), geometry.binned(binning)
            result = recon.reconstruct(binned, coarse, fit, grid=grid, control=control)
            first, last = result.history[0], result.history[-1]
            pace = (last.seconds - first.seconds) / max(1, last.step - first.step)
            out.setdefault((binning, share), []).append((pace, psnr(truth, result.volume.data) - base))
        print(binning, share, " ".join(f"{1e3 * p:.2f}ms/{g:+.2f}dB" for p, g in out[binning, share]), flush=True)
    return out


@pytest.mark.bench
@pytest.mark.timeout(1800)
def test_the_curves_that_budgets_are_planned_by(shared_data: Path) -> None:
    warm_up()
    scans: tuple[Callable[[Path], tuple[F32, Geometry, F32]], ...] = (walnut, particles)
    tables = [measured(*scan(shared_data)) for scan in scans]
    found = []
    for kind in KINDS:
        gains = np.mean([[gain for _, gain in table[kind]] for table in tables], axis=0)
        paces = [np.median([p for p, _ in t[kind]]) / np.median([p for p, _ in t[1, 1.0]]) for t in tables]
        points = tuple((steps, round(float(gain), 2)) for steps, gain in zip(STEPS, gains, strict=True))
        found.append(Curve(*kind, round(float(np.mean(paces)), 2), points))
        print(f"    {found[-1]},")
    # The table need not be that of this very machine, but it must still say the truth.
    by_kind = {(c.binning, c.share): c for c in CURVES}
    for curve in found:
        kept = by_kind[curve.binning, curve.share]
        differences = [abs(a - b) for (_, a), (_, b) in zip(curve.points, kept.points, strict=True)]
        assert max(differences) < 0.7
