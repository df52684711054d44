"""Grey windows separate the classes of a volume: air, matrix, dense material, metal."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.greys import class_levels, grey_windows, material_window


def volume(noise: float, **classes: float) -> np.ndarray:
    """Values of classes, `level=share` with the level in hundredths, and noise; edges between them are straight."""
    rng, n = np.random.default_rng(3), 100_000
    levels = [int(name[1:]) / 100 for name in classes]
    values = [np.full(round(share * n), level) for level, share in zip(levels, classes.values(), strict=True)]
    edges = [rng.uniform(0, level, n // 500) for level in levels[1:]]
    whole = np.concatenate(values + edges)
    return (whole + noise * rng.normal(size=whole.size)).astype(np.float32)


def grey(values: np.ndarray, level: float) -> float:
    low, high = material_window(values)
    return (level - low) / (high - low)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2])
def test_particles_and_can_are_apart_by_a_quarter_of_the_greys(noise: float) -> None:
    values = volume(noise, _0=0.6, _37=0.25, _280=0.1, _650=0.05)
    assert -0.1 < grey(values, 0.0) < 0.15
    assert 0.25 < grey(values, 2.8) < grey(values, 6.5) - 0.25
    assert grey(values, 6.5) < 1.05


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_pin_of_metal_does_not_darken_the_matrix(noise: float) -> None:
    values = volume(noise, _0=0.8, _20=0.1, _120=0.095, _930=0.005)
    assert grey(values, 1.2) > 0.7 and grey(values, 0.2) > 0.1  # the metal is white
    low, high = grey_windows(values)["all"]
    assert low < 0.05 and high > 9
    less = np.delete(values, np.flatnonzero(values > 9)[::2])  # half as large a pin
    assert material_window(less)[1] == pytest.approx(material_window(values)[1], rel=0.1)


def test_dense_matter_that_is_most_of_the_sample_is_no_metal() -> None:
    values = volume(0.01, _0=0.5, _10=0.05, _100=0.45)
    assert grey(values, 1.0) < 1.05
    assert grey_windows(values)["weak"][1] < 0.3


def test_empty_fields_constants_and_nan_have_windows(rng: np.random.Generator) -> None:
    for values in (np.zeros(9), np.full(7, np.nan), np.empty(0), np.array([np.nan, 1.0, 1.0]), rng.normal(size=999)):
        for low, high in grey_windows(values).values():
            assert low < high


def test_classes_are_parted_where_they_are_two_and_noise_is_one(rng: np.random.Generator) -> None:
    assert len(class_levels(rng.normal(size=50_000))) == 1
    parts = class_levels(np.concatenate([rng.normal(0, 1, 40_000), rng.normal(10, 1, 10_000)]))
    assert [round(float(np.median(each))) for each in parts] == [0, 10]


def test_sizes_that_share_factors_with_the_sample_show_the_sample_of_the_scan() -> None:
    volume = np.zeros((125, 80, 400), np.float32)  # a sample of every twentieth value would have twenty columns
    volume[:, 20:60, 101:110] = 1.0
    assert class_levels(volume)[-1][-1] == 1.0
