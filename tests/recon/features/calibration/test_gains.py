"""Pixel sensitivities measured with the volume: rings disappear, bodies on the axis stay; compared with filters."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.features.calibration.gains import NEAR_AXIS, gains_memory, learn_gains
from recon.features.rings import remove_rings_in_place
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.recon.prep.ring_score import ring_score

pytestmark = pytest.mark.usefixtures("one_thread")
F32 = NDArray[np.float32]
SHAPE, VIEWS = (20, 72), 60  # two bands
MIDDLE = 35.5
GEOMETRY = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE, pixel_pitch=1.0, axis_col=MIDDLE)
BALL = Ellipsoid((2.0, 2.0, 2.0), 0.03, centre=(0, 0, 0))


def _views(*more: Cylinder | Ellipsoid) -> F32:
    """A disc with bodies in it, and the noise of 2e4 photons."""
    rng = np.random.default_rng(4)
    bodies: list[Cylinder | Ellipsoid] = [Cylinder(30, 100, 0.013), *more]
    for _ in range(12):
        x, y = rng.uniform(-0.6, 0.6, 2) * 28
        bodies.append(Cylinder(float(rng.uniform(1.5, 5)), 100, float(rng.uniform(-0.01, 0.02)), centre=(x, y, 0)))
    sample, detector = Phantom.of(tuple(bodies)), Detector(SHAPE, 1.0, MIDDLE, GEOMETRY.axis_row)
    lines = np.stack([sample.line_integrals(angle, detector) for angle in GEOMETRY.angles])
    return (-np.log(rng.poisson(2e4 * np.exp(-lines)) / 2e4)).astype(np.float32)


@pytest.fixture(scope="module")
def gains() -> F32:
    """1 % of each pixel, three single ones 10 %."""
    found = np.random.default_rng(5).normal(0, 0.01, SHAPE).astype(np.float32)
    found[[3, 9, 15], [14, 45, 60]] += np.float32(0.1)
    return found


def _fbp(views: F32) -> F32:
    return recon.reconstruct(views, GEOMETRY, recon.Fbp()).volume.data


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_gains_are_found_and_the_ball_on_the_axis_stays(gains: F32) -> None:
    clean = _views(BALL)
    ringed = clean + gains
    found = learn_gains(ringed, GEOMETRY)
    far = np.abs(np.arange(SHAPE[1]) - MIDDLE) > NEAR_AXIS
    assert found.confirmed and found.with_gains < found.without
    assert _rms((found.pixels - gains)[:, far]) < 0.65 * _rms(gains)
    assert not found.pixels[:, ~far].any()
    views = {"gains": ringed - found.pixels}
    for way in ("sort", "vo"):
        views[way] = ringed.copy()
        remove_rings_in_place(views[way], GEOMETRY.angles, way)
    true, before = _fbp(clean), _fbp(ringed)
    volumes = {name: _fbp(each) for name, each in views.items()}
    errors = {name: _rms(volume - true) for name, volume in volumes.items()}
    ball = {name: _depth(volume) / _depth(true) for name, volume in volumes.items()}
    rings = {name: ring_score((volume - true)[3], (MIDDLE, MIDDLE)) for name, volume in volumes.items()}
    print("\n", errors, ball, rings, _rms(before - true), ring_score((before - true)[3], (MIDDLE, MIDDLE)))
    assert errors["gains"] < min(errors["sort"], errors["vo"], 0.7 * _rms(before - true))
    assert all(abs(depth - 1) < 0.1 for depth in ball.values())  # it is on both sides of the axis
    assert rings["gains"] < 0.7 * ring_score((before - true)[3], (MIDDLE, MIDDLE))


@pytest.mark.parametrize("size", [0.02, 0.0])
def test_gains_of_columns_are_found_and_where_there_are_none_nothing_is(size: float) -> None:
    """Gains that all rows share, beside a can's wall: of what FISTA-TV loses by them, half comes back."""
    wall = (Cylinder(33, 100, 0.02), Cylinder(31.5, 100, -0.02))
    clean = _views(*wall)
    gains = np.random.default_rng(6).normal(0, size, SHAPE[1]).astype(np.float32)
    found = learn_gains(clean + gains, GEOMETRY)
    assert found.confirmed == (size > 0)
    if not size:
        assert not found.pixels.any()
        return
    true = recon.reconstruct(clean, GEOMETRY, recon.FistaTv(20, 1e-3)).volume.data
    errors = [
        _rms(recon.reconstruct(views, GEOMETRY, recon.FistaTv(20, 1e-3)).volume.data - true)
        for views in (clean + gains, clean + gains - found.pixels)
    ]
    print("\n", errors)
    assert errors[1] < 0.6 * errors[0]


def _depth(volume: F32) -> float:
    """The ball over what is around it."""
    return float(volume[9:11, 34:38, 34:38].mean() - volume[9:11, 28:44, 28:44].mean())


@pytest.mark.parametrize("more", [(), (BALL,), (Cylinder(2, 100, 0.03),)], ids=["disc", "ball", "rod on the axis"])
def test_views_without_rings_stay_as_they_are(more: tuple[Cylinder | Ellipsoid, ...]) -> None:
    low = GEOMETRY.rows(4, 16)
    found = learn_gains(np.ascontiguousarray(_views(*more)[:, 4:16]), low)
    assert not found.confirmed and not found.pixels.any()


def test_a_stripe_of_all_rows_may_be_the_wall_of_a_can() -> None:
    views, low = np.ascontiguousarray(_views()[:, 4:16]), GEOMETRY.rows(4, 16)
    views[:, :, 50] += 0.03
    assert not learn_gains(views, low).pixels[:, 50].any()


def test_few_views_are_refused_and_the_memory_is_that_of_a_band() -> None:
    with pytest.raises(ValueError, match="39 projections"):
        learn_gains(np.ones((39, *SHAPE), np.float32), GEOMETRY.select(np.arange(39)))
    high = Geometry.parallel(GEOMETRY.angles, (2000, 72), pixel_pitch=1.0, axis_col=MIDDLE)
    low = Geometry.parallel(GEOMETRY.angles, (24, 72), pixel_pitch=1.0, axis_col=MIDDLE)
    assert gains_memory(high) < gains_memory(low) + 16 * 2000 * 72
