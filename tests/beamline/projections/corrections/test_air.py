"""Beam background: subtracted if projections confirm it; nothing of the sample is removed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.projections.corrections.air import without_background
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

pytestmark = pytest.mark.usefixtures("one_thread")
F32 = NDArray[np.float32]
SHAPE = (48, 64)
GEOMETRY = Geometry.parallel(np.linspace(0, np.pi, 60, endpoint=False), SHAPE, pixel_pitch=1.0, axis_col=32.3)
WEAK = 0.0015  # 1/px, and so is what stands on a dense post, as Diamond's resin does
DOME = Ellipsoid((14.0, 14.0, 14.0), WEAK, centre=(1.0, 0.0, -2.0))
POST = Cylinder(12.0, 20.0, 0.05, centre=(0.0, 0.0, 16.0))
NOISE = 0.004


def _views(*bodies: Cylinder | Ellipsoid, geometry: Geometry = GEOMETRY, noise: float = NOISE) -> F32:
    detector, sample = (
        Detector(geometry.detector_shape, 1.0, geometry.axis_col, geometry.axis_row),
        Phantom.of(tuple(bodies)),
    )
    clean = np.stack([sample.line_integrals(angle, detector) for angle in geometry.angles])
    return (clean + np.random.default_rng(0).normal(0, noise, clean.shape)).astype(np.float32)


def _surface(level: float, bend: float, lean: float = 0.0) -> F32:
    v, u = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    return (level + bend * (u**2 + 0.5 * v**2) + lean * u * v).astype(np.float32)


BENT = _surface(-0.06, 0.06, 0.01)


def test_a_bent_beam_is_taken_off_and_weak_matter_stays() -> None:
    """Without it, methods without negative densities keep a part of the dome alone."""
    clean, fading = _views(DOME, POST), np.linspace(0, -0.01, 60, dtype=np.float32)[:, None, None]
    bent = clean + BENT + fading
    views = bent.copy()
    said, _ = without_background(Views(views, GEOMETRY), "auto")
    assert "order 2" in said and "subtracted" in said
    np.testing.assert_allclose(views - clean, 0, atol=0.008)  # of 0.07
    assert np.sqrt(np.mean((views - clean) ** 2)) < 0.002

    def mass(measured: F32) -> float:
        volume = recon.reconstruct(measured, GEOMETRY, recon.Sirt(iterations=40)).volume.data
        return float(volume[11:18].sum())  # of the cap, above the post

    true = mass(clean)
    assert mass(bent) < 0.5 * true
    assert mass(views) == pytest.approx(true, rel=0.08)


@pytest.mark.parametrize(
    "bodies",
    [
        pytest.param((DOME, POST), id="clean"),
        pytest.param((DOME, POST, Cylinder(29.0, 60.0, WEAK / 2)), id="weak matter all around", marks=pytest.mark.slow),
        pytest.param((POST, Cylinder(29.0, 60.0, WEAK / 10)), id="matter too weak to be seen"),
        pytest.param((DOME, POST, Cylinder(60.0, 60.0, WEAK)), id="wider than the field"),
        pytest.param((Cylinder(31.5, 60.0, 0.02),), id="no air"),
        pytest.param((), id="nothing but air", marks=pytest.mark.slow),
    ],
)
def test_nothing_is_taken_off_beams_that_are_their_flats(bodies: tuple[Cylinder | Ellipsoid, ...]) -> None:
    views = _views(*bodies)
    kept = views.copy()
    said, _ = without_background(Views(views, GEOMETRY), "auto")
    assert (views == kept).all(), said
    assert "subtracted: " not in said


def test_a_surface_is_not_sought_where_views_do_not_show_where_the_sample_is() -> None:
    """From a third of the half circle a first volume is all streaks, and from few views, too."""
    views, few = _views(DOME, POST) + BENT, np.arange(0, 60, 6)
    for part in (slice(0, 20), few):
        some = views[part].copy()
        assert without_background(Views(some, GEOMETRY.select(part)), "auto") == ("", None)
        assert (some == views[part]).all()


def test_positive_air_is_told_and_taken_off_on_request_only() -> None:
    views = _views(DOME, POST) + np.float32(0.03)
    kept = views.copy()
    said, _ = without_background(Views(views, GEOMETRY), "auto")
    assert (views == kept).all() and "may be weakly absorbing material all around the sample" in said
    assert "--air surface:0" in said
    assert "subtracted: " in without_background(Views(views, GEOMETRY), 0)[0]
    np.testing.assert_allclose(views, kept - 0.03, atol=0.002)


@pytest.mark.slow
def test_views_held_out_lose_their_background_by_their_own_air() -> None:
    clean = _views(DOME, POST)
    drift = np.linspace(0, -0.02, 60, dtype=np.float32)[:, None, None]
    views, used, unseen = clean + BENT + drift, np.arange(0, 60, 2), np.arange(1, 60, 10)
    others = views[unseen].copy()
    without_background(Views(views[used].copy(), GEOMETRY.select(used)), "auto", Views(others, GEOMETRY.select(unseen)))
    assert np.sqrt(np.mean((others - clean[unseen]) ** 2)) < 0.003


@pytest.mark.slow
def test_a_positive_background_of_a_beam_brighter_than_its_flats_is_the_beams() -> None:
    """The line through the edges took off more than stands there now: matter does not make light."""
    clean = _views(DOME)
    bent = _surface(0.03, -0.03)
    views = clean + bent
    said, _ = without_background(Views(views, GEOMETRY), "auto", levelled=-0.08)
    assert "a line through the air at the edges was subtracted (-0.080 in line integral); then" in said
    assert "beam subtracted: " in said
    np.testing.assert_allclose((views - clean).mean(axis=0), 0, atol=0.01)
    views = clean + bent
    for levelled in (0.0, 0.05):
        said, _ = without_background(Views(views, GEOMETRY), "auto", levelled=levelled)
        assert "was not subtracted" in said
        assert ("a line through the air" in said) == (levelled > 0)
        np.testing.assert_array_equal(views, clean + bent)
