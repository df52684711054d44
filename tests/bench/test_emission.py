"""Emission: contrast recovery against noise of OSEM, FBP, R² and FISTA-TV on a simulated PET phantom."""

from __future__ import annotations

import math
import time
from itertools import product

import numpy as np
import pytest

import recon
from recon.base.method import Method
from simulators.frame.shot import Detector
from simulators.scenes.emission import NemaPhantom, Scanner, events

SHAPE, VIEWS, PITCH, TRUES = (16, 64), 120, 1.0, 1.5e7  # mm, counts
PHANTOM = NemaPhantom()
GEOMETRY = recon.Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE, pixel_pitch=PITCH)
GRID = recon.Grid.matching(GEOMETRY)


def _measured(method: Method, emission: recon.Emission) -> tuple[np.ndarray, float]:
    """The volume, and CPU seconds of a second call, for which kernels are compiled."""
    recon.reconstruct(emission, GEOMETRY, method)
    began = time.process_time()
    return recon.reconstruct(emission, GEOMETRY, method).volume.data, time.process_time() - began


def truth() -> np.ndarray:
    """Activity [z, y, x], means over nine points of a voxel; the phantom is taller than the grid."""
    _, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    total = np.zeros(GRID.shape)
    for v, u in product((-1 / 3, 0, 1 / 3), repeat=2):
        activity = (np.hypot(x + u, y + v) < PHANTOM.radius).astype(float)
        for rod in PHANTOM.rods.values():
            activity[np.hypot(x + u - rod.at[0], y + v - rod.at[1]) < rod.radius] = rod.activity
        total += activity / 9
    return total


def figures(volume: np.ndarray, scale: float) -> dict[str, float]:
    """PSNR in dB; contrast recovery of hot rods, spillover of cold ones, noise of the body, in slices off the ends."""
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    inner = np.abs(z) < 6
    r = np.hypot(x, y)
    body = inner & ((r < 6) | ((r > 20) & (r < 22)))
    level = float(volume[body].mean())
    peak, error = truth().max(), np.sqrt(np.mean((volume / scale - truth()) ** 2))
    found = {"dB": 20 * math.log10(peak / error), "level": level / scale, "noise": float(volume[body].std()) / level}
    for name, rod in PHANTOM.rods.items():
        mean = float(volume[inner & (np.hypot(x - rod.at[0], y - rod.at[1]) < 0.7 * rod.radius)].mean()) / level
        found[name] = mean if rod.activity == 0 else (mean - 1) / (rod.activity - 1)
    return found


CASES: dict[str, Method] = {
    "FBP, Ram-Lak": recon.Fbp(filter="ram-lak"),
    "FBP, Hann": recon.Fbp(),
    "OSEM, 20 iterations of 10 subsets": recon.Osem(20, 10),
    "OSEM": recon.Osem(),
    "MLEM": recon.Mlem(),
    "FISTA-TV": recon.FistaTv(),
    "PnP-DCT": recon.PnpDct(),
    "R²": recon.R2(),
}


@pytest.mark.bench
@pytest.mark.timeout(900)
@pytest.mark.parametrize("trues", [TRUES, TRUES / 10, TRUES / 100])
def test_contrast_against_noise(trues: float) -> None:
    made = events(PHANTOM, Detector.centred(SHAPE, PITCH), GEOMETRY.angles, Scanner(trues), seed=0)
    emission, scale = recon.Emission(made.counts, GEOMETRY, made.survival, made.background), made.scale
    found: dict[str, dict[str, float]] = {}
    for name, method in CASES.items():
        volume, cpu = _measured(method, emission)
        megabytes = method.memory(GEOMETRY, GRID, weighted=True) / 1e6
        found[name] = figures(volume, scale) | {"CPU s": cpu, "MB": megabytes}
    keys = list(found["R²"])
    print(f"\n| method | {' | '.join(keys)} |\n|{'---|' * (1 + len(keys))}")
    for name, row in found.items():
        print(f"| {name} | {' | '.join(f'{value:.3g}' for value in row.values())} |")
    assert found["OSEM"]["dB"] > max(found[name]["dB"] for name in CASES if "FBP" in name) + 1
    assert found["PnP-DCT"]["dB"] > found["OSEM"]["dB"] + 3
    if trues == TRUES:
        converged = found["OSEM, 20 iterations of 10 subsets"]
        assert max(converged["air"], converged["teflon"], found["R²"]["air"], found["R²"]["teflon"]) < 0.05
        assert converged["hot 11 mm"] > 0.9
        assert found["R²"]["noise"] < 0.5 * min(row["noise"] for name, row in found.items() if "OSEM" in name)
