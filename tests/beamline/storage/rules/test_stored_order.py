"""Sinograms instead of projections, a horizontal axis, and numbers in the other byte order are reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from beamline.features.files.validate import validate
from beamline.storage.readers.base import Quantity
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.stored_order import change_of_rows, views_first
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


def told(
    data: NDArray[np.float64], angles: NDArray[np.float64], quantity: Quantity = "line_integrals"
) -> list[Finding]:
    source = ArraySource(data, [0] * len(data), angles)
    source.quantity = quantity
    return list(views_first(ScanEvidence(source)))


@pytest.mark.parametrize("turn", [np.pi, 2 * np.pi])
@pytest.mark.parametrize("quantity", ["line_integrals", "unknown"])  # unknown: transmission
def test_sinograms_are_told_from_views(turn: float, quantity: Quantity) -> None:
    missed = 0
    for seed in range(12):
        lines, angles = line_integrals(seed, turn)
        data = np.exp(-lines) if quantity == "unknown" else lines
        assert told(data, angles, quantity) == []
        missed += not told(data.swapaxes(0, 1), angles, quantity)
    assert missed == 0


def counts(seed: int, light: float, dtype: type) -> ArraySource:
    rng = np.random.default_rng(seed)
    lines, angles = line_integrals(seed, np.pi)
    return ArraySource(rng.poisson(light * np.exp(-lines.clip(0)) + 100).astype(dtype), [0] * N, angles)


def _lopsided(views: int, rows: int, cols: int) -> np.ndarray:
    """Line integrals [view, row, col] of a slanting rod that goes round, 0 at the ends of each row."""
    theta = np.linspace(0, np.pi, views, endpoint=False)[:, None, None]
    height = np.linspace(-1, 1, rows)[None, :, None]
    u = np.linspace(-1, 1, cols)[None, None] - 0.5 * height * np.cos(theta) - 0.15 * np.sin(theta)
    return (np.exp(-((u / 0.2) ** 2)) * (1.2 + height)).astype(np.float64)


@given(rows=st.integers(12, 60), cols=st.integers(24, 90), noise=st.floats(0, 0.1), drift=st.floats(0, 0.2))
def test_a_horizontal_axis_is_told_and_a_vertical_one_never(rows: int, cols: int, noise: float, drift: float) -> None:
    rng = np.random.default_rng(rows)
    lines, even = _lopsided(12, rows, cols), np.ones((12, rows, cols))
    theta, u = np.linspace(0, np.pi, 12, endpoint=False)[:, None], np.linspace(-1, 1, cols)
    squared = 64 * np.cos(theta) ** 2 + 16 * np.sin(theta) ** 2  # half-axes of 8 and 4 half fields, upper half denser
    wide = (64 * np.sqrt(squared - u**2) / squared)[:, None] * np.where(np.arange(rows) < rows / 2, 0.2, 0.1)[:, None]
    round_one = even * lines[:1].mean(axis=0)
    for sample in (lines, 0 * lines, round_one, wide):  # also none, and one that goes on beyond the field
        beam = drift * rng.standard_normal((12, 1, 1)) + drift * np.linspace(-1, 1, rows)[:, None] * even
        assert change_of_rows(sample + beam + noise * rng.standard_normal(lines.shape)) < 10
    turned = np.rot90(lines, axes=(1, 2))
    if noise < 0.02:
        assert change_of_rows(turned + noise * rng.standard_normal(turned.shape)) > 10


@pytest.mark.parametrize("quantity", ["counts", "line_integrals"])
def test_a_scan_with_a_horizontal_axis_is_named_and_read(tmp_path: Path, quantity: str) -> None:
    lines, path = _lopsided(24, 20, 40), tmp_path / "s.h5"
    frames = (100 + 2e4 * np.exp(-lines)).astype(np.uint16) if quantity == "counts" else lines.astype(np.float32)
    turned = np.rot90(frames, k=-1, axes=(1, 2))
    with h5py.File(path, "w") as file:
        file["exchange/data"], file["exchange/theta"] = turned, np.linspace(0, 180, 24, endpoint=False)
        if quantity == "counts":
            file["exchange/data_dark"] = np.full((2, 40, 20), 100, np.uint16)
            file["exchange/data_white"] = np.full((2, 40, 20), 20100, np.uint16)
    stated = SourceOptions(path, quantity=quantity)  # type: ignore[arg-type]
    assert [f.rule for f in validate(stated) if "give --horizontal-axis" in f.message] == ["axis"]
    upright = replace(stated, horizontal_axis=True)
    assert not [f for f in validate(upright) if f.rule == "axis"]
    with open_scan(upright) as source:
        views = np.flatnonzero(source.table.kinds == 0)
        assert source.shape == (20, 40)
        np.testing.assert_array_equal(source.read(views, slice(3, 9)), frames[:, 3:9])
        if quantity == "counts":
            np.testing.assert_array_equal([frame.counts for frame in source.frames()][-1], frames[-1])
    with open_scan(replace(upright, cols=(5, 30))) as source:
        np.testing.assert_array_equal(source.read(views[:2], slice(2, 4)), frames[:2, 2:4, 5:30])
