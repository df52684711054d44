"""Groups of darks and flats with one fault each: the fault is found with its value; good groups have none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from beamline.core.flag import Finding
from beamline.monitor.digest import digest
from beamline.monitor.evidence import Evidence, FrameStatistics, full_scale
from beamline.monitor.references import ReferenceLimits, reference_findings
from drivers.base.frame import FrameKind

SHAPE = (64, 80)
OFFSET, READ, GAIN = 100.0, 3.0, 2.0  # counts, counts, counts a photon
PHOTONS = 5000.0
FULL = 65535

Images = list[NDArray[np.float64]]


def frames(n: int, photons: float | NDArray[np.float64], seed: int, gain: float = GAIN) -> Images:
    rng = np.random.default_rng(seed)
    light = np.broadcast_to(np.asarray(photons, float), SHAPE)
    hot = np.zeros(SHAPE)
    hot[3, 5] = hot[40, 7] = FULL
    return [
        np.clip(OFFSET + hot + gain * rng.poisson(light) + rng.normal(0, READ, SHAPE), 0, FULL).round()
        for _ in range(n)
    ]


def group(images: Images, kind: FrameKind, first: int = 0, exposure: float = 0.1) -> list[FrameStatistics]:
    return [
        FrameStatistics.of(first + i, kind, exposure, digest(image.astype(np.uint16), FULL), 4)
        for i, image in enumerate(images)
    ]


def darks(photons: float = 0.0, n: int = 5) -> list[FrameStatistics]:
    return group(frames(n, photons, 1), FrameKind.DARK)


def flats(images: Images, first: int = 10) -> list[FrameStatistics]:
    return group(images, FrameKind.FLAT, first)


def found(*groups: list[FrameStatistics], limits: ReferenceLimits | None = None) -> tuple[Finding, ...]:
    return reference_findings(Evidence(tuple(map(tuple, groups))), limits)


def rules(*groups: list[FrameStatistics], limits: ReferenceLimits | None = None) -> list[str]:
    return [finding.rule for finding in found(*groups, limits=limits)]


def profile() -> NDArray[np.float64]:
    """A beam narrower than the detector, with stripes."""
    r, c = np.indices(SHAPE)
    stripes = 1 + 0.1 * np.sin(r / 3)
    return PHOTONS * stripes * np.exp(-(((r - 30) / 20) ** 2) - ((c - 40) / 60) ** 2)


@pytest.mark.parametrize("photons", [PHOTONS, 30.0, 30_000.0, profile()])
@pytest.mark.parametrize("n", [1, 2, 10])
def test_good_references_have_no_fault(photons: float | NDArray[np.float64], n: int) -> None:
    assert rules(darks(n=n), flats(frames(n, photons, 2))) == []


def saturated(images: Images) -> Images:
    return [image * 20 for image in images]


def dimmed(images: Images) -> Images:
    return frames(len(images), 0.2, 3)


def flickering(images: Images) -> Images:
    return [OFFSET + (image - OFFSET) * (1 - 0.05 * i) for i, image in enumerate(images)]


def crossed(images: Images) -> Images:
    """A sample on its way out of the beam in the first flat."""
    first = images[0].copy()
    first[:, :10] = OFFSET + 0.5 * (first[:, :10] - OFFSET)
    return [first, *images[1:]]


def slit(images: Images) -> Images:
    dark = frames(len(images), 0.0, 4)
    return [np.where(np.arange(SHAPE[0])[:, None] < 24, image, d) for image, d in zip(images, dark, strict=True)]


@pytest.mark.parametrize(
    ("spoil", "what", "said"),
    [
        (saturated, "saturated", "of the pixels are saturated (limit 0.10%)"),
        (dimmed, "no_beam", "these flats show no beam"),
        (flickering, "uneven", "differs by 22% from flat to flat (limit 10%)"),
        (crossed, "uneven", "something was in the beam"),
        (slit, "mostly_unlit", "62% of the frame gets no beam"),
    ],
)
def test_each_fault_of_flats_is_named_with_its_figure(spoil: Callable[[Images], Images], what: str, said: str) -> None:
    (fault,) = found(darks(), flats([np.clip(i, 0, FULL) for i in spoil(frames(5, PHOTONS, 2))]))
    assert fault.rule == what and said in fault.message
    assert fault.score > fault.limit or what == "no_beam"
    assert (fault.frames, fault.severity) == (
        ((10,), "warning") if spoil is crossed else (tuple(range(10, 15)), "error")
    )


@pytest.mark.parametrize("share", [0.25, 0.6])
def test_darks_with_light_are_told_from_darks_with_an_offset(share: float) -> None:
    """Light brings its noise: 25 photons on an offset of 100 counts are no lit darks, a leaking shutter is."""
    (fault,) = found(darks(share * PHOTONS), flats(frames(5, PHOTONS, 2)))
    assert fault.rule == "light_in_darks" and "these darks were exposed to the beam" in fault.message
    assert rules(darks(), flats(frames(5, 25.0, 2))) == []


def test_clean_darks_of_a_scan_of_few_photons_are_not_lit() -> None:
    """8 photons of a count each beside 2 counts of readout: a third of the flats' variance is in clean darks too."""
    rng = np.random.default_rng(9)

    def images(photons: float) -> Images:
        return [100 + rng.poisson(photons, SHAPE) + rng.normal(0, 2, SHAPE) for _ in range(5)]

    assert rules(group([i.round() for i in images(0)], FrameKind.DARK), flats(images(8))) == []


def test_darks_and_flats_with_the_same_light_are_the_flats_fault() -> None:
    (fault,) = found(darks(PHOTONS), flats(frames(5, PHOTONS, 2)))
    assert fault.rule == "no_beam" and "open for the flats, and closed for the darks" in fault.message


def test_a_group_that_lost_the_beam_is_judged_by_the_others() -> None:
    dim = flats(frames(5, 0.02 * PHOTONS, 5), first=200)
    good = flats(frames(5, PHOTONS, 2))
    assert rules(darks(), good, dim) == ["beam_lost"]
    assert rules(darks(), dim) == []  # by itself it is a dim flat
    # Nearly twice the exposure, half the beam: the same counts, and half of the light is not gone
    half = [replace(flat, exposure=0.19) for flat in flats(frames(5, PHOTONS, 6), first=200)]
    assert rules(darks(), good, half) == []
    third = [replace(flat, exposure=0.3) for flat in half]
    assert rules(darks(), good, third) == ["beam_lost"]


@given(st.integers(0, 65535))
def test_a_detector_saturates_at_the_end_of_its_bits(count: int) -> None:
    scale = full_scale(count)
    assert scale >= count and np.log2(scale + 1) in (8, 10, 12, 14, 16)
    assert count > scale / 4 or scale == 255
