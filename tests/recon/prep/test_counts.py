"""Photon counts: their likelihood as line integrals and weights; the estimate of the gain."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

import recon
from recon.prep.counts import Counts, expanded, line_integrals, of_view, photon_transfer
from tests.refused_calls import refused_calls

F64 = NDArray[np.float64]
SHAPE = (8, 48)
ANGLES = np.linspace(0, np.pi, 40, endpoint=False)
VIEWS = recon.Geometry.parallel(ANGLES, SHAPE, pixel_pitch=1.0)
INSIDE, TRUE = 12.0, 0.06  # radius of the part that is looked at, attenuation of the cylinder of radius 18


def _distance() -> F64:
    y, x = np.mgrid[: SHAPE[1], : SHAPE[1]] - (SHAPE[1] - 1) / 2
    return np.hypot(x, y)


@pytest.fixture(scope="module")
def clean() -> F64:
    """Line integrals of the cylinder, by the chord's formula: up to 2.16."""
    u = np.arange(SHAPE[1]) - (SHAPE[1] - 1) / 2
    chord = 2 * np.sqrt(np.maximum(18.0**2 - u**2, 0)) * TRUE
    return np.broadcast_to(chord, (VIEWS.n_views, *SHAPE)).copy()


def _counted(clean: F64, photons: float, seed: int = 0) -> NDArray[np.int64]:
    return np.random.default_rng(seed).poisson(photons * np.exp(-clean))


def _mean_inside(found: recon.Reconstruction) -> float:
    return float(found.volume.data[:, _distance() < INSIDE].mean())


def _likelihood(p: F64, n: F64, beam: F64, extra: F64) -> F64:
    """The negative logarithm of the shifted Poisson probability of n photons, by the book."""
    expected = beam * np.exp(-p) + extra
    return expected - special.xlogy(n + extra, expected)


@pytest.mark.parametrize("extra", [0.0, 4.0])
def test_gradient_and_expected_curvature_are_those_of_the_likelihood(extra: float) -> None:
    rng = np.random.default_rng(0)
    n, beam, around = rng.poisson(3.0, 50).astype(float), rng.uniform(5, 50, 50), rng.uniform(0, 4, 50)
    v = np.full(50, extra)
    p, w = expanded(n, beam, v, around)
    h = 1e-5
    slope = (_likelihood(around + h, n, beam, v) - _likelihood(around - h, n, beam, v)) / (2 * h)
    np.testing.assert_allclose(w * (around - p), slope, rtol=1e-6, atol=1e-6)
    expected = beam * np.exp(-around)  # with n at its expected value the curvature is Fisher's information
    h = 1e-3
    bend = sum(
        k * _likelihood(around + s * h, expected, beam, v) for k, s in ((1, 1), (-2, 0), (1, -1))
    ) / h**2  # fmt: skip
    np.testing.assert_allclose(w, bend, rtol=1e-4)


def test_repeated_expansion_finds_the_maximum_of_the_likelihood() -> None:
    """One attenuation behind all pixels: its likelihood has the closed form ln(sum of beams / sum of counts)."""
    rng = np.random.default_rng(1)
    beam, extra = rng.uniform(2, 8, 400), np.zeros(400)
    n = rng.poisson(beam * np.exp(-0.8)).astype(float)
    assert (n == 0).any()
    p = 0.0
    for _ in range(12):
        data, weights = expanded(n, beam, extra, np.full(400, p))
        p = float((weights @ data) / weights.sum())
    assert p == pytest.approx(np.log(beam.sum() / n.sum()), rel=1e-9)


def test_zero_counts_are_finite_and_weigh() -> None:
    data, weights = line_integrals(Counts(np.zeros((2, 5, 20)), np.full((5, 20), 10.0)))
    assert np.isfinite(data).all() and (data > np.log(10)).all() and (weights > 0).all()


def test_weights_are_inverse_variances() -> None:
    """A flat field behind 1.2: the line integrals scatter by 1/√w."""
    n = np.random.default_rng(2).poisson(30 * np.exp(-1.2), (60, 100)).astype(float)
    data, weights = of_view(n, np.full(n.shape, 30.0), np.zeros(n.shape))
    assert data.var() * weights.mean() == pytest.approx(1, abs=0.1)
    assert np.average(data, weights=weights) == pytest.approx(1.2, abs=0.02)
    assert np.log(30 / np.maximum(n, 0.5)).mean() > 1.25  # the logarithm's mean is off by 1 / 2n


def test_readout_noise_takes_weight_and_adds_no_bias() -> None:
    rng = np.random.default_rng(3)
    n = rng.poisson(20 * np.exp(-1.0), (80, 100)) + rng.normal(0, 3, (80, 100))
    data, weights = line_integrals(Counts(100 + 5 * n[None], np.full(n.shape, 200.0), 100.0, 5.0, (5 * 3.0) ** 2))
    assert np.average(data, weights=weights) == pytest.approx(1.0, abs=0.03)
    assert data.var() * weights.mean() == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("gain", [1.0, 7.0])
def test_offset_and_gain_do_not_change_what_is_counted(clean: F64, gain: float) -> None:
    n = _counted(clean, 20)
    plain = line_integrals(Counts(n, np.full(SHAPE, 20.0)))
    scaled = line_integrals(Counts(100 + gain * n, np.full(SHAPE, 100 + gain * 20.0), 100.0, gain))
    for a, b in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_uneven_and_changing_flats_are_part_of_the_model(clean: F64) -> None:
    """A beam that is uneven and fades from view to view leaves the mean attenuation as it is."""
    flat = 40 * (1 + 0.3 * np.sin(np.arange(SHAPE[1]) / 3)) * np.linspace(1, 0.5, VIEWS.n_views)[:, None, None]
    flat = np.broadcast_to(flat, clean.shape)
    n = np.random.default_rng(4).poisson(flat * np.exp(-clean))
    data, weights = line_integrals(Counts(n, flat))
    assert np.average(data - clean, weights=weights) == pytest.approx(0, abs=0.015)


def test_bad_pixels_weigh_nothing_and_do_not_spread(clean: F64) -> None:
    n = _counted(clean, 50).astype(float)
    n[3, 4, 5] = np.nan
    flat = np.full(SHAPE, 50.0)
    flat[2, 7] = 0
    data, weights = line_integrals(Counts(n, flat))
    assert weights[3, 4, 5] == 0 and np.isnan(data[3, 4, 5])
    assert (weights[:, 2, 7] == 0).all()
    assert (weights == 0).sum() == 1 + VIEWS.n_views and np.isfinite(data[weights > 0]).all()


@pytest.mark.parametrize(
    "method",
    [
        recon.OsSirtTv(iterations=20, tv_weight=0.03),
        pytest.param(recon.R2(steps=150, gaussians=800), marks=pytest.mark.slow),
    ],
)
def test_the_mean_attenuation_is_unbiased_at_ten_photons(clean: F64, method: Any) -> None:
    """Within 2.5 %, which is what two scans' noise leaves; the weighed logarithm is low by a tenth."""
    flat, means = np.full(SHAPE, 10.0), []
    for seed in (0, 1):
        n = _counted(clean, 10, seed)
        assert (n == 0).mean() > 0.05
        some = np.maximum(n, 0.5) / 10
        weighed = recon.DataUse(weights=some.astype(np.float32))
        counted = recon.reconstruct(Counts(n, flat), VIEWS, method)
        logarithm = recon.reconstruct(-np.log(some), VIEWS, method, use=weighed)
        means.append([_mean_inside(counted), _mean_inside(logarithm)])
    assert np.mean(means, axis=0)[0] == pytest.approx(TRUE, rel=0.025)
    assert np.mean(means, axis=0)[1] < 0.92 * TRUE


def test_given_weights_multiply(clean: F64) -> None:
    n = _counted(clean, 100)
    counts = Counts(n, np.full(SHAPE, 100.0))
    data, weights = line_integrals(counts)
    mine = np.ones(clean.shape, np.float32)
    mine[:, :, 20] = 0
    method = recon.OsSirtTv(iterations=2)
    a = recon.reconstruct(counts, VIEWS, method, use=recon.DataUse(weights=mine)).volume.data
    b = recon.reconstruct(data, VIEWS, method, use=recon.DataUse(weights=mine * weights)).volume.data
    np.testing.assert_array_equal(a, b)


def test_photon_transfer_finds_gain_and_dark_noise() -> None:
    rng = np.random.default_rng(5)
    fixed, drift = rng.uniform(0.8, 1.2, (40, 50)), np.linspace(1, 1.1, 12)[:, None, None]
    flats = 100 + 6.5 * rng.poisson(200 * fixed * drift) + rng.normal(0, 4, (12, 40, 50))
    darks = 100 + rng.normal(0, 4, (12, 40, 50))
    gain, variance = photon_transfer(flats, darks)
    assert gain == pytest.approx(6.5, rel=0.04)
    assert variance == pytest.approx(16, rel=0.1)


def test_shapes_that_disagree_with_the_geometry_are_refused() -> None:
    counts = Counts(np.ones((2, 4, 4)), np.full((4, 4), 10.0))
    with pytest.raises(ValueError, match="counts must have shape"):
        recon.reconstruct(counts, VIEWS)


test_calls_that_are_refused = refused_calls(__file__, globals())
