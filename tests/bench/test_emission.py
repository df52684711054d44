"""Emission: contrast recovery against noise of OSEM, FBP, R² and FISTA-TV on a simulated PET phantom."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import recon
from recon.voxels.emission import weighted_lines
from simulators.frame.detector import Detector
from simulators.scenes.emission import NemaPhantom, Scanner, events

SHAPE, VIEWS, PITCH = (16, 64), 120, 1.0  # mm
PHANTOM, TRUES = NemaPhantom(), 1.5e7
GEOMETRY = recon.Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE, pixel_pitch=PITCH)
GRID = recon.Grid.matching(GEOMETRY)


def _emission() -> tuple[recon.Emission, float]:
    made = events(PHANTOM, Detector.centred(SHAPE, PITCH), GEOMETRY.angles, Scanner(TRUES), seed=0)
    return recon.Emission(made.counts, GEOMETRY, made.survival, made.background), made.scale


@dataclass(frozen=True)
class Osem:
    """`recon.mlem` with ten subsets."""

    iterations: int

    def volume(self) -> recon.Volume:
        return recon.mlem(_emission()[0], GRID, self.iterations, subsets=10)

    def memory(self) -> int:
        """Bytes as its docstring says; `Method.memory` is what other methods say."""
        return 4 * (13 * math.prod(GRID.shape) + 4 * math.prod(SHAPE) * VIEWS // 10)


@dataclass(frozen=True)
class Weighted:
    """A method of line integrals, with weights that carry the likelihood of the counts."""

    method: Any

    def volume(self) -> recon.Volume:
        lines, weights = weighted_lines(_emission()[0])
        return recon.reconstruct(lines, GEOMETRY, self.method, use=recon.DataUse(weights=weights)).volume

    def memory(self) -> int:
        return int(self.method.memory(GEOMETRY, GRID, weighted=True))


def _measured(case: Osem | Weighted) -> tuple[np.ndarray, float]:
    """The volume, and CPU seconds of a second call, for which kernels are compiled."""
    case.volume()
    began = time.process_time()
    return case.volume().data, time.process_time() - began


def figures(volume: np.ndarray, scale: float) -> dict[str, float]:
    """Contrast recovery of hot rods, spillover of cold ones, noise of the body; all in slices off the ends."""
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    inner = np.abs(z) < 6
    r = np.hypot(x, y)
    body = inner & ((r < 6) | ((r > 20) & (r < 22)))
    level = float(volume[body].mean())
    found = {"level": level / scale, "noise": float(volume[body].std()) / level}
    for name, rod in PHANTOM.rods.items():
        mean = float(volume[inner & (np.hypot(x - rod.at[0], y - rod.at[1]) < 0.7 * rod.radius)].mean()) / level
        found[name] = mean if rod.activity == 0 else (mean - 1) / (rod.activity - 1)
    return found


CASES: dict[str, Osem | Weighted] = {
    "FBP, Ram-Lak": Weighted(recon.Fbp(filter="ram-lak")),
    "FBP, Hann": Weighted(recon.Fbp(filter="hann")),
    **{f"OSEM, {n} iterations": Osem(n) for n in (2, 8, 20)},
    "FISTA-TV": Weighted(recon.FistaTv()),
    "R²": Weighted(recon.R2()),
}


@pytest.mark.bench
@pytest.mark.timeout(900)
def test_contrast_against_noise() -> None:
    _, scale = _emission()
    found: dict[str, dict[str, float]] = {}
    for name, case in CASES.items():
        volume, cpu = _measured(case)
        found[name] = figures(volume, scale) | {"CPU s": cpu, "MB": case.memory() / 1e6}
    keys = list(found["R²"])
    print(f"\n| method | {' | '.join(keys)} |\n|{'---|' * (1 + len(keys))}")
    for name, row in found.items():
        print(f"| {name} | {' | '.join(f'{value:.3g}' for value in row.values())} |")
    converged = found["OSEM, 20 iterations"]
    assert max(converged["air"], converged["teflon"]) < 0.05
    assert converged["hot 11 mm"] > 0.9
    assert found["R²"]["noise"] < 0.5 * min(row["noise"] for name, row in found.items() if "OSEM" in name)
    assert max(found["R²"]["air"], found["R²"]["teflon"]) < 0.05
