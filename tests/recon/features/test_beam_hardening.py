"""Beam-hardening curves: the effect of several energies on line integrals is corrected."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recon.features.beam_hardening import Curve, NoCurveError, curve_of_paths, curve_of_spectrum
from simulators.effects.beam.energies import BeamHardening
from tests.messages import refused
from tests.simulators import shots

ENERGIES = st.lists(st.tuples(st.floats(0.1, 1.0), st.floats(10.0, 100.0)), min_size=1, max_size=4)


def _seen(spectrum: list[tuple[float, float]], depth: np.ndarray) -> np.ndarray:
    weights, energies = zip(*spectrum, strict=True)
    return BeamHardening(weights, energies=energies).apply(depth[None].copy(), shots.shot())[0]


@given(ENERGIES)
def test_the_spectrum_that_hardened_gives_the_depth_back(spectrum: list[tuple[float, float]]) -> None:
    depth = np.linspace(0, 5, 50)
    seen = _seen(spectrum, depth)
    weights, energies = np.array(spectrum).T
    views = seen[None, None].astype(np.float32)
    curve_of_spectrum(energies**-3, weights, float(seen.max())).linearise(views)
    np.testing.assert_allclose(views[0, 0], depth, rtol=2e-3, atol=2e-3)


def test_paths_give_the_depth_back_and_noise_does_not_bend_it() -> None:
    rng = np.random.default_rng(1)
    path = rng.uniform(3, 60, 4000)
    spectrum = [(1.0, 20.0), (1.0, 30.0), (1.0, 45.0)]
    seen = _seen(spectrum, 0.04 * path) + rng.normal(0, 0.02, path.size)
    curve, explained = curve_of_paths(seen, path + rng.normal(0, 0.5, path.size), float(seen.max()))
    views = _seen(spectrum, np.linspace(0, 2.4, 40)).astype(np.float32)[None]
    curve.linearise(views)
    assert explained > 0.98
    assert np.abs(views[0] - np.linspace(0, 2.4, 40)).max() < 0.08  # before: 1.1


def test_weights_follow_the_slope_and_noise_below_zero_the_first_piece() -> None:
    curve = Curve(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 3.0]))
    views, weights = np.array([[-0.5, 0.5, 1.5, 3.0]], np.float32), np.ones((1, 4), np.float32)
    curve.linearise(views, weights)
    np.testing.assert_allclose(views, [[-0.5, 0.5, 2.0, 5.0]])
    np.testing.assert_allclose(weights, [[1, 1, 0.25, 0.25]])


def test_what_shows_no_curve_is_refused() -> None:
    rng = np.random.default_rng(2)
    path = rng.uniform(3, 60, 500)
    with refused(NoCurveError):
        curve_of_paths(rng.uniform(0, 2, 500), path, 2.0)
    with refused(NoCurveError):
        curve_of_paths(np.ones(12), np.ones(12), 1.0)
    with refused(ValueError):
        Curve(np.array([0.0, 1.0]), np.array([0.0, 0.0]))
