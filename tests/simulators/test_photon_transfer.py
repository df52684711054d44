"""Photon transfer: flats of the whole sensor chain give back its gain, offset and read noise (Janesick 2007); counts
are straight in the exposure, and the variances of all noises add up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from simulators.frame.sensor import CONVERSION, OFFSET, READ_NOISE
from simulators.scenes.scene import Scene
from tests.simulators import chance, shots

CHAIN = (
    {"kind": "prnu", "spread": 0.01},
    "photon_noise",
    "dark_current",
    {"kind": "hot_pixels", "fraction": 3e-4},
    "saturation",
    "read_noise",
    {"kind": "offset", "spread": 1.0},
)
SHAPE = (300, 400)
EXPOSURES = 0.016 * np.geomspace(0.004, 1, 10)
"""s: 26 ... 6400 photons of a sensor pixel."""


def _frame(scene: Scene, exposure: float, number: int, beam: bool = True, **changes: Any) -> NDArray[np.float64]:
    shot = shots.sized(*SHAPE, **({"exposure": exposure, "frame": number} | changes))
    return shots.frame(scene, shot, beam=beam, sample=False).astype(float)


def _pair(one: NDArray[np.float64], other: NDArray[np.float64], good: Any = ...) -> tuple[float, float]:
    """Mean of two like frames, and the variance of one from their difference: what stays from frame to frame drops
    out."""
    return float((one + other)[good].mean() / 2), float((one - other)[good].var() / 2)


@pytest.mark.parametrize(("readout", "binning"), [("standard", 1), ("ultra_quiet", 1), ("standard", 2)])
def test_pairs_of_flats_give_back_gain_offset_and_read_noise(readout: str, binning: int) -> None:
    scene = shots.scene(*CHAIN, phantom={"kind": "solids", "solids": []})
    roi = (900, 1600, SHAPE[0] * binning, SHAPE[1] * binning)
    exposures = np.concatenate([[0.001], EXPOSURES / binning**2])  # the first without light
    frames = [
        _frame(scene, exposure, k, exposure != exposures[0], readout=readout, binning=binning, roi=roi)
        for k, exposure in enumerate(np.repeat(exposures, 2))
    ]
    light = np.where(exposures == exposures[0], 0, exposures)
    # Hot pixels are what is far above the rest of a long dark frame; they are left out, as one does.
    dark = _frame(scene, 1.0, 99, beam=False, readout=readout, binning=binning, roi=roi)
    good = dark < np.median(dark) + 10 * READ_NOISE[readout] * binning / CONVERSION[readout]
    assert 0.99 < good.mean() < 1
    mean, variance = np.array([_pair(frames[2 * k], frames[2 * k + 1], good) for k in range(light.size)]).T
    weight = 1 / variance  # relative errors of the variances are alike
    # mean = offset + slope exposure;  variance = (read noise / gain)² + 1/12 + (mean - offset) / gain
    slope, offset = np.polyfit(light, mean, 1, w=1 / np.sqrt(variance))
    per_count, floor = np.polyfit(mean - offset, variance, 1, w=weight)
    gain = 1 / per_count
    assert gain == pytest.approx(CONVERSION[readout], rel=0.02)
    assert offset == pytest.approx(OFFSET[readout], rel=0.02)
    assert math.sqrt(floor - 1 / 12) * gain == pytest.approx(READ_NOISE[readout] * binning, rel=0.02)
    assert slope * gain == pytest.approx(4e5 * binning**2, rel=0.02)


def test_the_variances_of_all_noises_add_up() -> None:
    """photons (m) + PRNU (m p)² + dark current (d t) + read noise σ² exp(2 s²), in electrons², over the gain squared,
    + offset spread² + 1/12 of rounding, in counts²."""
    scene = shots.scene(
        {"kind": "prnu", "spread": 0.05},
        "photon_noise",
        {"kind": "dark_current", "rate": 30.0},
        {"kind": "read_noise", "rms": 4.0, "spread": 0.3},
        {"kind": "offset", "spread": 12.0},
        flux=100.0,
        phantom={"kind": "solids", "solids": []},
    )
    flat, other = (_frame(scene, 1.0, number) for number in (0, 1))
    electrons = 100 + (100 * 0.05) ** 2 + 30 + 4.0**2 * math.exp(2 * 0.3**2)
    variance = electrons / 0.107**2 + 12.0**2 + 1 / 12
    chance.mean_is(flat, 200 + 130 / 0.107, variance)
    chance.variance_is(flat, variance, 0.05)
    # Without the pattern, from two flats: what does not stay.
    _, temporal = _pair(flat, other)
    fixed = (100 * 0.05 / 0.107) ** 2 + 12.0**2
    assert temporal == pytest.approx(variance - fixed, rel=chance.SIGMAS * math.sqrt(2.1 / flat.size))
