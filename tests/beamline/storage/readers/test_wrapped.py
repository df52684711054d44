"""16-bit counts that wrapped around: after the largest number they restart at 0."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.features.files.validate import source_findings
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.transforms import wrapped_edges
from beamline.storage.rules.evidence import ScanEvidence
from tests.beamline.array_source import scan_of

COLS = np.arange(256) - 127.5
SAMPLE = 1.3 * np.cos(np.pi / 2 * np.minimum(np.abs(COLS) / 80, 1)) ** 2


def counts(light: float, profile: float = 0.0) -> np.ndarray:
    beam = light * (1 - profile * (COLS / 128) ** 2)
    return np.random.default_rng(0).poisson(np.broadcast_to(beam * np.exp(-SAMPLE), (2, 32, 256))) + 400


@pytest.mark.parametrize(("light", "profile"), [(66_000, 0), (80_000, 0), (150_000, 0), (72_000, 0.25)])
def test_what_is_brighter_than_the_type_begins_again(light: float, profile: float) -> None:
    assert wrapped_edges((counts(light, profile) % 2**16).astype(np.uint16), np.dtype(np.uint16))


def test_light_that_is_cut_off_hot_pixels_and_zingers_have_not_wrapped() -> None:
    images = counts(5e4)
    cut = images.copy()
    cut[:, :, :30], cut[:, :, 30:40] = 65_535, 50  # saturated beside a slit
    slit = counts(6.2e4)
    slit[:, :, :20] = np.random.default_rng(2).normal(100, 4, (2, 32, 20))
    images[:, ::7, ::11] = 65_000
    dim = counts(500)
    dim[:, ::5, ::13] = 65_000
    for some in (cut, slit, images, dim):
        assert wrapped_edges(some.astype(np.uint16), np.dtype(np.uint16)) == 0


@pytest.mark.parametrize("light", [62_000, 64_500])
def test_opaque_matter_with_sharp_edges_in_bright_light_has_not_wrapped(light: float) -> None:
    """A detector without blur goes from open beam to a few per cent in a pixel; flats are as bright on both sides."""
    chord = 2 * np.sqrt(np.maximum(80.0**2 - COLS**2, 0))
    draw = np.random.default_rng(3).poisson
    images, flat = draw(light * np.exp(np.broadcast_to(-0.3 * chord, (2, 32, 256)))), draw(light, (32, 256))
    assert wrapped_edges(images.astype(np.uint16), np.dtype(np.uint16), flat) == 0
    bright = (counts(80_000) % 2**16).astype(np.uint16), np.dtype(np.uint16)
    assert wrapped_edges(*bright, np.full((32, 256), 80_400 % 2**16)) == wrapped_edges(*bright)


@pytest.mark.parametrize(("dtype", "light"), [(np.uint16, 7.2e4), (np.int16, 7.2e4), (np.int16, 9e4)])
def test_validate_says_that_numbers_wrapped_and_nothing_of_the_light(dtype: Any, light: float) -> None:
    """With a sign, 65,536 and more is again above 0, beside darker matter far below 0 without any step."""
    views, flats = counts(light, 0.1).repeat(6, axis=0), np.random.default_rng(5).poisson(light, (3, 32, 256)) + 400
    darks = np.random.default_rng(6).normal(400, 3, (3, 32, 256)).round()
    parts: list[NDArray[Any]] = [part.astype(np.int64).astype(np.uint16).view(dtype) for part in (darks, flats, views)]
    source = scan_of(parts[0], parts[1], parts[2], np.linspace(0, np.pi, 12, endpoint=False), dtype)
    found = source_findings(ScanEvidence(cast(ScanSource, source)))
    assert [finding.rule for finding in found if finding.severity != "info"] == ["wrapped-numbers"]
