"""Weak matter: the cap of Diamond's resin dome, which a volume without negative densities lost; and what is left of a
battery's electrolyte where low values of noisy views are set to zero.

pytest -m bench -s tests/bench/test_weak_matter.py    (needs ../shared/data; minutes)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

import recon
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.open import open_scan
from recon.assess import metrics
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.composed import Battery, labels_of

pytestmark = pytest.mark.bench
CAP, AIR, RADIUS = slice(27, 37), slice(4, 19), 40  # slices of the cap, slices above it; voxels about the middle
METHODS = {"FISTA-TV": recon.FistaTv(), "r2": recon.R2(), "SIRT": recon.Sirt()}


def _volume(shared_data: Path, method: recon.Method, air: str) -> NDArray[np.float32]:
    with open_scan(shared_data / "diamond_24737_parallel_91x135x160.h5") as scan:
        prepared = prepare_projections(select(scan, Selection(steps=(Air(air),))), lambda _: None)
    return recon.reconstruct(prepared.seen.data, prepared.geometry, method).volume.data


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


def _battery(photons: float, seed: int) -> tuple[NDArray[np.float32], recon.Geometry, NDArray[np.float32]]:
    """Noisy line integrals [view, row, col] of a battery, and its truth in voxels."""
    solids = Battery((0.72, 0.64), 150, seed=7).solids()
    phantom, detector = Phantom.of(solids, labels_of(solids)), Detector.centred((4, 160), 4.6e-3)
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    lines = np.stack([phantom.line_integrals(angle, detector) for angle in angles])
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-lines))
    noisy = -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)
    geometry = recon.Geometry.parallel(angles, detector.shape, pixel_pitch=detector.pitch)
    return noisy, geometry, phantom.attenuation(recon.Grid.matching(geometry))


@pytest.mark.parametrize("photons", [50, 500])
def test_a_threshold_takes_the_electrolyte_and_no_noise_of_it(photons: int) -> None:
    """Views are those of early scans with values below a share of the largest (99.9th percentile) set to zero."""
    methods: dict[str, recon.Method] = {"FBP": recon.Fbp(), "FISTA-TV": recon.FistaTv(tv_weight=0.002)}
    for name, method in methods.items():
        kept = []
        for share in (0.0, 0.1, 0.2, 0.4):
            figures = []
            for seed in range(2):
                views, geometry, truth = _battery(photons, seed)
                cut = np.where(views < share * np.percentile(views, 99.9), np.float32(0), views)
                volume = recon.reconstruct(cut, geometry, method).volume.data
                weak, dense = _regions(truth)
                figures.append(
                    (volume[weak].mean() / truth[weak].mean(), volume[weak].std() / truth[weak].mean(),
                     volume[dense].mean() / truth[dense].mean(), metrics.psnr(truth, volume))
                )  # fmt: skip
            low, mean = np.min(figures, axis=0), np.mean(figures, axis=0)
            print(f"\n{photons:4d} {name:9s} {share:4.0%}  electrolyte {mean[0]:5.2f} +- {mean[1]:.2f}, particles "
                  f"{mean[2]:.2f}, {mean[3]:.2f} dB (least {low[3]:.2f})", end="")  # fmt: skip
            kept.append(mean[0])
        assert kept[0] == pytest.approx(1, abs=0.15) and kept[-1] < 0.8


def _regions(truth: NDArray[np.float32]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Electrolyte and particles, two voxels off their edges."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in truth.shape[1:])
    inside = np.hypot(y[:, None], x) < 60
    dense = truth > 0.5 * truth.max()
    return (
        ndimage.binary_erosion((truth < 0.2 * truth.max()) & inside, iterations=2, border_value=1),
        ndimage.binary_erosion(dense & inside, iterations=2, border_value=1),
    )
