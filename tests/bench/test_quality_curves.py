"""Measures the table in recon/assess/time_model.py: dB above FBP against steps, by method, binning and Gaussians.

Run with  pytest -m bench -s tests/bench/test_quality_curves.py ; it prints the table as it stands in that module. It
takes 10 to 15 minutes of CPU time, and only its ratios of times mean something on another machine.
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
from recon.assess.time_model import CURVES, QualityCurve
from recon.base.arrays import bin_views
from recon.base.geometry import Geometry
from recon.base.views import parse_views
from recon.base.volume import Grid, Volume
from recon.methods import build, by_name
from recon.splatting.finish import FINISH_SWEEPS
from recon.splatting.in_time import sweep_seconds
from recon.splatting.initialise import default_count
from recon.voxels.fbp import fbp
from recon.voxels.held_out import choice_sweeps
from recon.warm_up import warm_up
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.builders.battery import battery
from tests.bench.spheres import spheres
from tests.recon.helpers import data_residual

F32 = NDArray[np.float32]
Kind = tuple[str, str, int, float, tuple[int, ...]]
# A fit of fewer steps is a poor start of its finish; fewer iterations are below FBP on one of the scans.
_STEPS, _ITERATIONS_FISTA, _ITERATIONS = (125, 250, 500, 1000), (5, 10, 20, 40), (10, 20, 40)
KINDS: tuple[Kind, ...] = (
    *(("r2", "steps", 1, share, _STEPS) for share in (1.0, 0.5, 0.25, 2.0)),
    ("r2", "steps", 2, 0.25, _STEPS),
    *(("fbp", "", binning, 0.0, (1,)) for binning in (1, 2)),
    *(("fista-tv", "iterations", binning, 0.0, _ITERATIONS_FISTA) for binning in (1, 2)),
    *(("os-sirt-tv", "iterations", binning, 0.0, _ITERATIONS) for binning in (1, 2)),
)
"""Method, its setting that is counted, binning, share of the default number of Gaussians, and the numbers tried."""


def walnut(shared_data: Path) -> tuple[F32, Geometry, F32]:
    """Measured: 60 views of a slab of 40 rows, against the FDK of 1201 views."""
    with h5py.File(shared_data / "walnut_parallel_rebinned_240x96x256.h5") as file:
        angles = np.radians(file["exchange/theta"][...])
        pitch = float(file.attrs["pixel_size_mm"])
        views = parse_views("fixed:60", angles)
        data = np.stack([file["exchange/data"][int(v), 28:68] for v in views]).astype(np.float32)
    with np.load(shared_data / "walnut_fdk_256.npz") as file:
        truth = np.asarray(file[file.files[0]][98:138], np.float32)
    return data, Geometry.parallel(angles[views], data.shape[1:], pixel_pitch=pitch, axis_col=127.5), truth


def particles(shared_data: Path, views: int = 90, photons: float = 5000) -> tuple[F32, Geometry, F32]:
    """Simulated: views of a battery, four rays a pixel: with one, volumes that follow the views closely lose 3 dB."""
    rng = np.random.default_rng(7)
    pitch, shape = 0.72 / 160, (48, 160)
    phantom = Phantom.of(battery(rng, (0.72, 48 * pitch), 50))
    geometry = Geometry.parallel(np.linspace(0, np.pi, views, endpoint=False), shape, pixel_pitch=pitch)
    fine = Detector.centred((2 * shape[0], 2 * shape[1]), pitch / 2)
    light = np.exp(-np.stack([phantom.line_integrals(angle, fine) for angle in geometry.angles]))
    counts = rng.poisson(photons * light.reshape(views, shape[0], 2, shape[1], 2).mean(axis=(2, 4)))
    data = -np.log(np.maximum(counts, 1) / photons).astype(np.float32)
    return data.astype(np.float32), geometry, phantom.attenuation(Grid.matching(geometry))


def few_views(shared_data: Path) -> tuple[F32, Geometry, F32]:
    """Simulated: the same battery in half the views, hardly any noise (100 000 photons)."""
    return particles(shared_data, 45, 1e5)


def balls(shared_data: Path) -> tuple[F32, Geometry, F32]:
    """Simulated: 60 views of spheres in a cylinder, 48 rows of 96 pixels, little noise (10 000 photons)."""
    return spheres()


def measured(data: F32, geometry: Geometry, truth: F32) -> dict[Kind, list[tuple[float, float, float]]]:
    """(CPU s a step, CPU s besides, dB above FBP) for each number of steps, by kind; the first two in sweeps on voxels.

    CPU time is about the same on a busy machine.
    """
    now, grid = time.process_time, Grid.matching(geometry)
    base = psnr(truth, fbp(data, geometry, filter="hann"))
    count = default_count(geometry, grid.voxel_size)
    out: dict[Kind, list[tuple[float, float, float]]] = {}
    for kind in KINDS:
        name, counted, binning, share, numbers = kind
        binned, coarse = bin_views(data, binning), geometry.binned(binning)
        box = Grid.matching(coarse)
        sweep = float(np.median([sweep_seconds(coarse, box, now) for _ in range(5)]))
        for steps in numbers:
            settings = ({counted: steps} if counted else {}) | (
                {"gaussians": round(share * count), "finish": FINISH_SWEEPS} if share else {}
            )
            begin = now()
            method, control = build(by_name(name), settings), recon.RunControl(now=now)
            result = recon.reconstruct(binned, coarse, method, grid=box, control=control)
            if not result.history:  # a direct method: its gain is all that is asked
                out[kind] = [(0.0, 0.0, psnr(truth, _as_fine(result.volume.data, truth.shape)) - base)]
                break
            first, last = result.history[0], result.history[-1]
            pace = (last.seconds - first.seconds) / (last.step - first.step)
            # Beside its steps: a fit's finish follows them; on voxels a first volume and more go before.
            beside = now() - begin - last.seconds if share else first.seconds - pace
            beside -= choice_sweeps(coarse) * sweep  # which depends on the number of rows
            gain = psnr(truth, _as_fine(result.volume.data, truth.shape)) - base
            out.setdefault(kind, []).append((pace if share else pace / sweep, beside / sweep, gain))
        print(name, binning, share, " ".join(f"{p:.3g}/{b:.1f}/{g:+.2f}dB" for p, b, g in out[kind]), flush=True)
    return out


def _as_fine(volume: F32, shape: tuple[int, ...]) -> F32:
    """A volume of binned pixels on the voxels of single ones."""
    if volume.shape == shape:
        return volume
    for axis in range(3):
        volume = volume.repeat(2, axis)
    return volume[: shape[0], : shape[1], : shape[2]]


@pytest.mark.bench
@pytest.mark.timeout(7200)
def test_the_curves_that_budgets_are_planned_by(shared_data: Path) -> None:
    for name in {kind[0] for kind in KINDS}:
        warm_up(by_name(name)())
    scans: tuple[Callable[[Path], tuple[F32, Geometry, F32]], ...] = (walnut, particles, few_views, balls)
    tables = [measured(*scan(shared_data)) for scan in scans]
    found = []
    for kind in KINDS:
        name, counted, binning, share, numbers = kind
        rows = np.array([table[kind] for table in tables])
        whole = [np.median([p for p, _, _ in table[KINDS[0]]]) if share else 1.0 for table in tables]
        pace = float(np.mean(np.median(rows[:, :, 0], axis=1) / whole))
        sweeps = float(np.mean(np.median(rows[:, :, 1], axis=1)))
        gains = rows[:, :, 2].mean(axis=0)
        points = tuple((steps, round(float(gain), 2)) for steps, gain in zip(numbers, gains, strict=True))
        found.append(QualityCurve(name, counted, binning, share, round(pace, 2), round(sweeps, 1), points))
        print(f"    {found[-1]},")
    # The table need not be that of this very machine, but it must still say the truth.
    by_kind = {(c.method, c.binning, c.share): c for c in CURVES}
    for curve in found:
        kept = by_kind[curve.method, curve.binning, curve.share]
        differences = [abs(a - b) for (_, a), (_, b) in zip(curve.points, kept.points, strict=True)]
        assert max(differences) < 0.7


@pytest.mark.bench
def test_the_sample_and_its_views_belong_together() -> None:
    """The voxel projector, which knows nothing of spheres, finds the line integrals of the sample again."""
    data, geometry, truth = spheres(64, 24, 12, np.inf)
    grid = Grid.matching(geometry)
    apart = data_residual(Volume(truth, grid), data, geometry)
    assert apart < 0.02  # spheres of 1.3 pixels and more have edges that voxels only approach
    for axis in range(3):  # one voxel off in any direction is something else
        assert data_residual(Volume(np.roll(truth, 1, axis), grid), data, geometry) > 3 * apart
