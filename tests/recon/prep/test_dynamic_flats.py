"""Dynamic flats for beams with a known true flat, and for flats that differ only by noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

import recon
from recon.prep.dynamic_flats import DynamicFlats, find_dynamic_flats
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

F32 = NDArray[np.float32]
ROWS, COLS, PHOTONS = 48, 160, 2e4
Y, X = np.mgrid[:ROWS, :COLS]


def _beam(phase: float, slope: float) -> NDArray[np.float64]:
    """Photons a pixel: stripes of 4 % that move, a slope of 6 % that changes, on an uneven beam."""
    even = 1 - 0.3 * ((Y - ROWS / 2) / ROWS) ** 2
    return PHOTONS * even * np.exp(0.04 * np.sin(Y / 3.0 + phase) + 0.06 * slope * (X - COLS / 2) / COLS)


def _flats(rng: np.random.Generator, moving: float) -> list[F32]:
    return [rng.poisson(_beam(*(moving * rng.normal(size=2)))).astype(np.float32) for _ in range(20)]


def _dynamic(flats: list[F32]) -> DynamicFlats:
    return find_dynamic_flats(lambda: iter(flats), np.random.default_rng(0))


def _line_integrals(angle: float) -> NDArray[np.float64]:
    bodies = (Cylinder(50.0, 100.0, 0.02), Ellipsoid((12.0, 12.0, 12.0), 0.02, centre=(15.0, 5.0, 3.0)))
    return Phantom.of(bodies).line_integrals(angle, Detector((ROWS, COLS), 1.0, (COLS - 1) / 2, 0.0))


def _error(view: F32, flat: NDArray[np.floating], truth: NDArray[np.float64]) -> float:
    """RMS of smoothed line integrals (noise is the same for all flats), up to their level in air."""
    off = -np.log(view / flat) - truth
    off -= np.median(off[truth == 0])
    return float(np.sqrt(np.mean(ndimage.uniform_filter(off, 5) ** 2)))


def test_a_moving_beam_is_corrected_as_by_its_true_flat(rng: np.random.Generator) -> None:
    """Three components: sine, cosine and slope. Errors of the mean flat are 4 to 12 times those of the true one."""
    flats = _flats(rng, 1.0)
    found, mean = _dynamic(flats), np.mean(flats, axis=0)
    assert len(found.components) == 3
    for angle in np.radians([0, 40, 80, 120]):
        truth, beam = _line_integrals(angle), _beam(*rng.normal(size=2))
        view = rng.poisson(beam * np.exp(-truth)).astype(np.float32)
        best = _error(view, beam, truth)
        assert _error(view, found.flat_of(view), truth) < 1.2 * best
        assert _error(view, mean, truth) > 3 * best


def test_total_variation_alone_takes_out_stripes_where_there_is_no_air(rng: np.random.Generator) -> None:
    """The middle columns, which the sample fills: the error of a mean flat is at least halved."""
    flats = _flats(rng, 1.0)
    inside = np.s_[:, 50:110]
    found = _dynamic([np.ascontiguousarray(flat[inside]) for flat in flats])
    errors = []
    for angle in np.radians([0, 40, 80, 120]):
        truth, beam = _line_integrals(angle)[inside], _beam(3 * rng.normal(), 0.0)[inside]
        view = rng.poisson(beam * np.exp(-truth)).astype(np.float32)
        stripes = [
            (off := -np.log(view / flat) - truth).mean(axis=1) - off.mean()
            for flat in (found.flat_of(view), np.mean(flats, axis=0)[inside], beam)
        ]
        errors.append([float(np.sqrt(np.mean(stripe**2))) for stripe in stripes])
    dynamic, mean, best = np.mean(errors, axis=0)
    assert best < dynamic < 0.5 * mean


def test_flats_that_differ_by_noise_have_no_components(rng: np.random.Generator) -> None:
    flats = _flats(rng, 0.0)
    found = _dynamic(flats)
    assert len(found.components) == 0
    np.testing.assert_allclose(found.flat_of(flats[0]), np.mean(flats, axis=0), rtol=1e-6)
    with pytest.raises(ValueError, match="at least 4 flats, got 3"):
        _dynamic(flats[:3])


def test_the_level_of_flats_is_no_component_and_dark_pixels_tell_nothing(rng: np.random.Generator) -> None:
    flats = [flat * np.float32(level) for flat, level in zip(_flats(rng, 0.0), rng.uniform(0.5, 1, 20), strict=True)]
    for flat in flats:
        flat[:5] = rng.normal(0, 3, (5, COLS))  # no beam here
    found = _dynamic(flats)
    assert len(found.components) == 0 and np.isfinite(found.flat_of(flats[0])).all()


def test_the_correction_takes_them(rng: np.random.Generator) -> None:
    """With air columns and a dark; a dead pixel is filled as without."""
    flats, dark = _flats(rng, 1.0), np.full((ROWS, COLS), 100, np.float32)
    angles = np.radians([0, 40, 80, 120])
    truth = np.stack([_line_integrals(angle) for angle in angles])
    views = np.stack([rng.poisson(_beam(*rng.normal(size=2)) * np.exp(-p)) for p in truth]).astype(np.float32) + 100
    views[:, 20, 30] = 100
    mean = np.mean(flats, axis=0) + 100
    mean[20, 30] = 100
    groups = ((0.0, mean.astype(np.float32)),)
    errors = []
    for dynamic in (None, _dynamic(flats)):
        made = recon.correct(views, np.arange(4.0), recon.References(dark, groups, dynamic))
        assert made.masked[20, 30]
        errors.append(float(np.sqrt(np.mean(ndimage.uniform_filter(made.data - truth, (0, 5, 5)) ** 2))))
    assert errors[1] < 0.3 * errors[0]


def test_a_dark_view_and_a_single_row_have_a_flat(rng: np.random.Generator) -> None:
    flats = _flats(rng, 1.0)
    found = _dynamic(flats)
    np.testing.assert_array_equal(found.flat_of(np.zeros((ROWS, COLS), np.float32)), found.mean)
    np.testing.assert_array_equal(found.flat_of(np.full((ROWS, COLS), np.nan, np.float32)), found.mean)
    row = found.rows(slice(20, 21))
    assert np.isfinite(row.flat_of(flats[0][20:21])).all()
