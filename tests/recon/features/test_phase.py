"""Paganin's filter: it reverses the effect of free-space propagation for a sample of one material."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.units import HC
from recon.features.phase import Paganin, length_by_held_out_views, length_of
from simulators.effects.scattering.phase_fringes import PhaseFringes
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Ellipsoid
from tests.recon.prep.rims import views_of_can
from tests.simulators import shots

PITCH, ENERGY, FLOOR = 1e-3, 20.0, 1e-6


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("sod", [math.inf, 800.0])
@pytest.mark.parametrize(("fresnel_number", "delta_beta"), [(1, 20), (1, 100), (0.2, 100), (0.05, 20)])
def test_the_depth_of_a_ball_comes_back_from_its_wave(sod: float, fresnel_number: float, delta_beta: float) -> None:
    """The scene propagates a wave, which is more than the filter's first order; what is left is a tenth and less."""
    z = PITCH**2 * ENERGY / HC / fresnel_number
    detector = Detector.centred((160, 160), PITCH, sod)
    ball = Phantom.of((Ellipsoid((0.05, 0.05, 0.05), 0.5),))
    depth = np.asarray(ball.line_integrals(0.0, detector), np.float64)
    distance = z if math.isinf(sod) else z * sod / (sod - z)  # of the cone with the same fringes
    fringes = PhaseFringes(delta_beta, distance, ENERGY, oversampling=4)
    seen = fringes.apply(depth.copy(), shots.shot(detector=detector)).astype(np.float32)
    views = seen[None].copy()
    Paganin(length_of(delta_beta, z, ENERGY, PITCH)).retrieve(views, FLOOR)
    assert _rms(views[0] - depth) < min(0.1 * _rms(seen - depth), 0.01 * depth.max())
    assert views.sum() == pytest.approx(depth.sum(), rel=1e-3)


def test_a_plane_frame_stays_and_noise_falls_as_the_filter_says() -> None:
    rng = np.random.default_rng(1)
    level, length = np.float32(0.7), 3.0
    views = np.full((1, 96, 64), level)
    Paganin(length).retrieve(views, FLOOR)
    np.testing.assert_allclose(views, level, rtol=1e-5)
    noise = 1e-3 * rng.standard_normal((1, 256, 256)).astype(np.float32)
    views = level + noise
    Paganin(length).retrieve(views, FLOOR)
    f = np.fft.fftfreq(256)
    gain = 1 / (1 + (2 * np.pi * length) ** 2 * (f**2 + f[:, None] ** 2))
    assert views.std() == pytest.approx(1e-3 * _rms(gain), rel=0.1)


def test_unsharp_adds_what_a_blur_takes() -> None:
    step = np.zeros((1, 8, 64), np.float32)
    step[..., 32:] = 0.1
    blurred, sharp = step.copy(), step.copy()
    Paganin(2.0).retrieve(blurred, FLOOR)
    Paganin(2.0, (2.0, 3.0)).retrieve(sharp, FLOOR)
    slopes = [float(np.abs(np.diff(views[0, 4])).max()) for views in (blurred, sharp)]
    assert slopes[1] > 1.5 * slopes[0]
    assert sharp.mean() == pytest.approx(step.mean(), rel=0.01)


@pytest.mark.parametrize("wrong", [{"length": -1.0}, {"length": math.nan}, {"length": 1.0, "unsharp": (0.0, 1.0)}])
def test_what_is_no_filter_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"length must be a finite number|unsharp must be a sigma"):
        Paganin(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("square", [0.4, 1.6])
def test_views_held_out_tell_the_length_of_fringes(square: float) -> None:
    views, geometry = views_of_can(square)
    kept = views.copy()
    told = list[tuple[int, int]]()
    everything = np.ones(views.shape[1:], np.bool_)
    shown = length_by_held_out_views(views, geometry, FLOOR, everything, lambda *count: told.append(count))
    assert [done for done, _ in told] == list(range(1, len(told) + 1)) and all(n <= usual for n, usual in told)
    assert shown is not None and 1 < shown.factor < 1.3 and shown.residual_drop > 0.1
    assert 0.5 * square < shown.length**2 < 1.3 * square  # its finest cosines have smaller eigenvalues than length²
    np.testing.assert_array_equal(views, kept)


def test_without_fringes_or_with_few_views_no_length_is_told() -> None:
    views, geometry = views_of_can()
    known = np.ones(views.shape[1:], np.bool_)
    known[2, 40] = False
    views[:, 2, 40] = 3.0  # a pixel that was not measured
    assert length_by_held_out_views(views, geometry, FLOOR, known) is None
    fringed, geometry = views_of_can(1.0, shape=(15, 8, 80))
    assert length_by_held_out_views(fringed, geometry, FLOOR, np.ones((8, 80), np.bool_)) is None
