"""Sinograms where views are expected, as many as these, and numbers whose bytes are in the other order, are told."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.rules import Finding
from beamline.storage.rules.scan import pixels_as_labelled, views_first
from tests.beamline.array_source import ArraySource
from tests.recon.prep.balls import Balls

N = 48


def line_integrals(seed: int, turn: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of random balls [view, row, col], as many views as rows, with noise and a beam that drifts; angles."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, turn, N, endpoint=False)
    lines = Balls(angles, (N, N), N / 2 + rng.uniform(-2, 2), seed=seed, count=int(rng.integers(2, 25))).views()
    lines = lines * (2 / lines.max()) + np.linspace(0, rng.uniform(-0.2, 0.2), N)[:, None, None]
    return lines + 0.02 * rng.standard_normal(lines.shape), angles


def told(data: NDArray[np.float64], angles: NDArray[np.float64], quantity: str = "line_integrals") -> list[Finding]:
    source = ArraySource(data, [0] * len(data), angles)
    source.quantity = quantity
    return list(views_first(source))  # type: ignore[arg-type]


@pytest.mark.parametrize("turn", [np.pi, 2 * np.pi])
@pytest.mark.parametrize("quantity", ["line_integrals", "transmission"])
def test_sinograms_are_told_from_views(turn: float, quantity: str) -> None:
    missed = 0
    for seed in range(12):
        lines, angles = line_integrals(seed, turn)
        data = np.exp(-lines) if quantity == "transmission" else lines
        assert told(data, angles, quantity) == []
        missed += not told(data.swapaxes(0, 1), angles, quantity)
    assert missed == 0


def counts(seed: int, light: float, dtype: type) -> ArraySource:
    rng = np.random.default_rng(seed)
    lines, angles = line_integrals(seed, np.pi)
    return ArraySource(rng.poisson(light * np.exp(-lines.clip(0)) + 100).astype(dtype), [0] * N, angles)


@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.uint32])
@pytest.mark.parametrize("light", [800.0, 3000.0, 20000.0])
def test_counts_with_their_bytes_in_the_other_order(light: float, dtype: type) -> None:
    source = counts(1, light, dtype)
    assert list(pixels_as_labelled(source)) == []  # type: ignore[arg-type]
    swapped = ArraySource(source._data.byteswap(), [0] * N, source.angles)
    (finding,) = pixels_as_labelled(swapped)  # type: ignore[arg-type]
    assert finding.severity == "error"
    assert "byteswap" in finding.message
