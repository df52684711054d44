"""The rotation axis in closed-form sinograms with a known axis, and in real scans."""

from __future__ import annotations

import contextlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.prep.align import AxisError, AxisEstimate, axis_from_pair, find_axis
from recon.prep.axis_wedge import axis_from_sinogram
from recon.prep.correct import correct
from recon.prep.references import References
from tests.messages import refused

COLS = 128
HALF_TURN = np.arange(180) * np.pi / 180


def ellipses(
    rng: np.random.Generator, angles: NDArray[np.float64], axis: float, rows: int = 4, reach: float | None = None
) -> NDArray[np.float64]:
    """Line integrals (up to 3) of random ellipses in a can, in closed form, averaged over each pixel; [view, row, col].

    `reach`: radius of the can in pixels; None: as large as the field of view allows.
    """
    fine = 4
    radius = 0.9 * min(axis, COLS - 1 - axis) if reach is None else reach
    u = (np.arange(COLS * fine) + 0.5) / fine - 0.5 - axis
    out = np.zeros((len(angles), rows, COLS))
    for row in range(rows):
        views = np.zeros((len(angles), u.size))
        for k in range(15):
            a, b = (0.9, 0.9) if k == 0 else rng.uniform(0.03, 0.2, 2)
            r, direction = (0.05, 0.5) if k == 0 else (rng.uniform(0, 0.65), rng.uniform(0, 2 * np.pi))
            density = 0.3 if k == 0 else rng.uniform(0.2, 1)
            turned = angles - rng.uniform(0, np.pi)
            width2 = radius**2 * ((a * np.cos(turned)) ** 2 + (b * np.sin(turned)) ** 2)[:, None]
            s = u - (r * radius * np.cos(angles - direction))[:, None]
            views += 2 * density * a * b * radius**2 / width2 * np.sqrt(np.maximum(width2 - s**2, 0))
        out[:, row] = views.reshape(len(angles), COLS, fine).mean(2)
    return out * (3 / out.max())


def noisy(rng: np.random.Generator, views: NDArray[np.float64], photons: float) -> NDArray[np.float64]:
    return -np.log(np.maximum(rng.poisson(photons * np.exp(-views)), 0.5) / photons)


def angle_sets() -> dict[str, NDArray[np.float64]]:
    rng = np.random.default_rng(5)
    return {
        "half turn": HALF_TURN,
        "half turn with its end": np.linspace(0, np.pi, 91),
        "sparse": np.arange(20) * np.pi / 20,
        "full turn": np.arange(120) * np.pi / 60 + 0.3,
        "random": rng.uniform(-np.pi, np.pi, 80),
        "golden": np.arange(50) * np.pi * 0.6180339887,
        "10 degrees short": np.deg2rad(np.arange(0, 170, 2.0)),
    }


@pytest.mark.parametrize("name", list(angle_sets()))
@pytest.mark.parametrize(("photons", "within"), [(1e9, 0.02), (1000, 0.3)])
def test_all_views(name: str, photons: float, within: float) -> None:
    angles = angle_sets()[name]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        axis = rng.uniform(45, 82)
        estimate = axis_from_sinogram(noisy(rng, ellipses(rng, angles, axis), photons), angles)
        assert abs(estimate.value - axis) < within
        assert estimate.confident
        assert estimate.method == "double wedge" or photons < 1e9
        assert estimate.candidates.shape == estimate.curve.shape
        assert abs(estimate.candidates[estimate.curve.argmin()] - estimate.value) <= 0.25


def test_angles_that_come_twice() -> None:
    """Two sweeps over the same angles hold no more harmonics than one, but less noise."""
    angles = np.tile(np.arange(40) * np.pi / 40, 2)
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        axis = rng.uniform(50, 77)
        estimate = axis_from_sinogram(noisy(rng, ellipses(rng, angles, axis, rows=2), 300), angles)
        errors.append(abs(estimate.value - axis))
    assert np.median(errors) < 0.1


@pytest.mark.parametrize(("span", "photons", "within"), [(120, 1e9, 0.02), (120, 1000, 0.3), (90, 1000, 0.6)])
def test_a_sector_of_a_whole_sample(span: float, photons: float, within: float) -> None:
    angles = np.deg2rad(np.linspace(30, 30 + span, 60))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        axis = rng.uniform(50, 77)
        estimate = axis_from_sinogram(noisy(rng, ellipses(rng, angles, axis), photons), angles)
        assert estimate.method == "centre of mass"
        assert estimate.confident
        assert abs(estimate.value - axis) < within


@pytest.mark.parametrize("name", ["half turn", "full turn"])
def test_a_sample_that_reaches_out_of_the_field(name: str) -> None:
    """The scan breaks the double wedge then; what the edges do to low frequencies must not carry the axis along."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        views = ellipses(rng, angle_sets()[name], 56.4, reach=74)
        assert abs(axis_from_sinogram(views, angle_sets()[name]).value - 56.4) < 0.2


def test_what_is_wrong_is_not_believed() -> None:
    """Not half a turn, of a sample larger than the field: where the estimate is off by a pixel, it is not sure."""
    angles = angle_sets()["10 degrees short"]
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        estimate = axis_from_sinogram(ellipses(rng, angles, 56.4, reach=74), angles)
        errors.append(abs(estimate.value - 56.4))
        assert errors[-1] < 1 or not estimate.confident
    assert max(errors) > 1


@pytest.mark.parametrize("axis", [60.0, 63.5])
def test_a_sector_of_a_truncated_sample_is_not_believed(rng: np.random.Generator, axis: float) -> None:
    angles = np.deg2rad(np.linspace(30, 150, 60))
    for reach in (75, 85):
        assert not axis_from_sinogram(ellipses(rng, angles, axis, reach=reach), angles).confident


@pytest.mark.parametrize("photons", [1e9, 1000, 200])
def test_pair(photons: float) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        axis = rng.uniform(40, 87)
        views = noisy(rng, ellipses(rng, np.array([0.4, 0.4 + np.pi]), axis, rows=8), photons)
        estimate = axis_from_pair(views[0], views[1])
        assert abs(estimate.value - axis) < (0.05 if photons > 1000 else 0.3)
        assert estimate.confident
        assert estimate.method == "pair"


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
def test_air_that_is_exactly_zero_does_not_match_itself(scale: float) -> None:
    # Far from the axis only air overlaps: no mismatch there, and no rounding of it, is a match.
    u = np.arange(32)
    pair = [np.sqrt(np.maximum(64 - (u - centre) ** 2, 0))[None] * scale for centre in (18.2, 12.2)]
    estimate = axis_from_pair(*pair)
    assert abs(estimate.value - 15.2) < 0.25
    assert estimate.curve.min() >= -1e-9


def test_pair_bears_a_sample_larger_than_the_field_and_a_changed_beam(rng: np.random.Generator) -> None:
    views = ellipses(rng, np.array([0.0, np.pi]), 70.3, reach=100)
    estimate = axis_from_pair(views[0], 0.8 * views[1] + 0.3)
    assert abs(estimate.value - 70.3) < 0.1
    assert estimate.confident


def test_find_axis_takes_the_pair_where_the_sample_is_larger_than_the_field() -> None:
    angles = np.linspace(0, np.pi, 91)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        estimate = find_axis(noisy(rng, ellipses(rng, angles, 57.6, reach=85), 1e4), angles)
        assert estimate.confident
        assert abs(estimate.value - 57.6) < (0.15 if estimate.method == "pair" else 0.8)


def test_noise_alone_is_not_believed() -> None:
    for seed in range(5):
        views = np.random.default_rng(seed).normal(0, 0.03, (91, 6, COLS))
        with contextlib.suppress(AxisError):
            assert not find_axis(views, np.linspace(0, np.pi, 91)).confident


@pytest.fixture(scope="module")
def scan() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    angles = np.linspace(0, np.pi, 46)
    return ellipses(np.random.default_rng(3), angles, 58.37, reach=40), angles


@given(seed=st.integers(0, 2**32 - 1), shift=st.integers(-15, 15), start=st.floats(-10, 10), mirrored=st.booleans())
def test_order_start_sense_and_place_do_not_matter(
    scan: tuple[NDArray[np.float64], NDArray[np.float64]], seed: int, shift: int, start: float, mirrored: bool
) -> None:
    """A turned sample, shuffled views, a reversed rotation change nothing; a moved detector moves the axis with it."""
    views, angles = scan
    order = np.random.default_rng(seed).permutation(len(angles))
    moved = np.roll(views[order], shift, axis=-1)  # there is air on both sides
    expected = 58.37 + shift
    if mirrored:
        moved, expected = moved[..., ::-1], COLS - 1 - expected
    value = find_axis(moved, (angles[order] * (-1 if mirrored else 1)) + start).value
    assert abs(value - expected) < 0.05


def test_bad_input_is_refused(scan: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
    views, angles = scan
    with refused(ValueError):
        axis_from_sinogram(views, angles[1:])
    with refused(ValueError):
        find_axis(views[:3], angles[:3])
    with refused(ValueError):
        find_axis(views[:, 0], angles)
    with refused(ValueError):
        axis_from_pair(views[0], views[1, :, 1:])
    broken = views.copy()
    broken[3, 1, 4] = np.nan
    for attempt in (lambda: find_axis(broken, angles), lambda: axis_from_pair(broken[3], broken[4])):
        with refused(ValueError):
            attempt()


def exchange(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    with h5py.File(path) as file:
        group = file["exchange"]
        counts, angles = group["data"][()], np.deg2rad(group["theta"][()])
        dark, flat = group["data_dark"][()].mean(axis=0), group["data_white"][()].mean(axis=0)
    references = References(dark.astype(np.float32), ((-1.0, flat.astype(np.float32)),))
    return correct(counts, np.arange(len(counts), dtype=np.float64), references).data, angles


@pytest.mark.parametrize("every", [1, 2, 3])
def test_diamond_scan(shared_data: Path, every: int) -> None:
    views, angles = exchange(shared_data / "diamond_24737_parallel_91x135x160.h5")
    estimates: list[AxisEstimate] = [find_axis(views[::every], angles[::every])]
    if every == 1:
        estimates.append(axis_from_pair(views[0], views[-1]))
    for estimate in estimates:
        assert abs(estimate.value - 85.75) < 0.5
        assert estimate.confident


@pytest.mark.parametrize("every", [1, 4])
def test_tooth_scan(shared_data: Path, every: int) -> None:
    """No view lies half a turn from another, and there are two rows only."""
    views, angles = exchange(shared_data / "aps2bm_tooth_181x2x640.h5")
    estimate = find_axis(views[::every], angles[::every])
    assert abs(estimate.value - 295.6) < 0.5
    assert estimate.confident


@pytest.mark.parametrize("every", [1, 4, 8])
def test_walnut_scan(shared_data: Path, every: int) -> None:
    with h5py.File(shared_data / "walnut_parallel_rebinned_240x96x256.h5") as file:
        views = file["exchange/data"][::every].astype(np.float32)
        angles = np.deg2rad(file["exchange/theta"][::every])
    estimate = find_axis(views, angles)
    assert abs(estimate.value - 127.5) < 0.2
    assert estimate.confident
