"""Correct intensities are not reported; wrong ones are in tests/beamline/test_findings.py."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.projections.selection import Selection
from tests.beamline.array_source import scan_of
from tests.beamline.prepared_views import prepare

ANGLES, SHAPE, LIGHT = np.linspace(0, np.pi, 45, endpoint=False), (24, 64), 3000.0


def lines(radius: float) -> np.ndarray:
    """Line integrals of a ball beside the axis, or of a wide disc."""
    across, down = np.arange(SHAPE[1]) - 31.5, np.arange(SHAPE[0]) - 11.5
    at = 3 * np.cos(ANGLES)[:, None, None]
    height = down[:, None] ** 2 if radius < 32 else 0 * down[:, None]
    return np.asarray(0.01 * np.sqrt(np.clip(radius**2 - (across - at) ** 2 - height, 0, None)))


def counts(radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Darks, flats and views, with noise."""
    rng, beam = np.random.default_rng(1), np.full((5, *SHAPE), LIGHT)
    through = rng.poisson(0 * beam), rng.poisson(beam), rng.poisson(LIGHT * np.exp(-lines(radius)))
    darks, flats, views = (each + 100.0 for each in through)
    return darks, flats, views


def told(darks: np.ndarray, flats: np.ndarray, views: np.ndarray, exposures: np.ndarray | None = None) -> str:
    """All sentences of a scan, or of its refusal."""
    darks, flats, views = (np.clip(np.round(each), 0, 65535) for each in (darks, flats, views))
    source = scan_of(darks, flats, views, ANGLES)
    if exposures is not None:
        source.state(exposures=exposures)
    try:
        return " ".join(prepare(source, Selection(axis_col=31.5))[1])
    except DataError as error:
        return f"refused: {error}"


@pytest.mark.parametrize("radius", [20.0, 60.0])
def test_references_of_the_light_of_the_views_are_not_told_of(radius: float) -> None:
    unknown = told(*counts(radius)).partition("no detector column shows air")
    before = unknown[0].removesuffix("Compare a density that you know: flats and darks cannot be checked, because ")
    assert "flats" not in before.replace("weaker than in the flats", "")
    assert bool(unknown[1]) == (radius == 60.0)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_transmission_in_whole_numbers_that_is_clipped_at_all_light_does_not_end(noise: float) -> None:
    full, through = np.full((1, *SHAPE), 65535.0), np.exp(-lines(20.0))
    through += noise * np.sqrt(through) * np.random.default_rng(3).standard_normal(through.shape)
    assert "all pixels are saturated" not in told(0 * full, full, 65535 * through.clip(0, 1))


def test_whole_numbers_that_stand_for_transmission() -> None:
    """A full scale of 16 bits for all light, as documented, is written and not saturated."""
    full = np.full((1, *SHAPE), 65535.0)
    said = told(0 * full, full, 65535 * np.exp(-lines(20.0)))
    assert said == ""
