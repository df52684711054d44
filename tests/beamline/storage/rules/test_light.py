"""Views and references of another light, and views that have a scale each, are told of with what explains them."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.projections.selection import Selection
from beamline.storage.rules.light import BRIGHTER, WARN, views_scaled
from tests.beamline.array_source import ArraySource, scan_of
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
    source = scan_of(*(np.clip(np.round(each), 0, 65535) for each in (darks, flats, views)), ANGLES)
    if exposures is not None:
        source.exposures = exposures
    try:
        return " ".join(prepare(source, Selection(axis_col=31.5))[1])
    except DataError as error:
        return f"refused: {error}"


@pytest.mark.parametrize("radius", [20.0, 60.0])
def test_references_of_the_light_of_the_views_are_not_told_of(radius: float) -> None:
    unknown = told(*counts(radius)).partition("No column shows air")
    assert "flats" not in unknown[0].replace("weaker than its flats", "")
    assert bool(unknown[1]) == (radius == 60.0)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_flats_that_were_multiplied(factor: float) -> None:
    darks, flats, views = counts(20.0)
    said = told(darks, 100 + (flats - 100) * factor, views)
    assert said.startswith("refused: ")
    assert f"{max(factor, 1 / factor):.3g} times as {'dark' if factor > 1 else 'bright'} as the flats" in said
    assert "No exposure is stated" in said


def test_sums_of_frames() -> None:
    darks, flats, views = counts(20.0)
    assert "sums of 4 frames" in told(4 * darks, flats + 3 * flats[::-1].mean(), views)


@pytest.mark.parametrize(("bits", "radius"), [(4, 20.0), (2, 60.0)])
def test_counts_shifted_by_bits(bits: int, radius: float) -> None:
    darks, flats, views = counts(radius)
    said = told(darks, flats, views * 2**bits)
    assert said.startswith("refused: ")
    assert "times as bright as the flats" in said


def test_multiplied_flats_of_a_sample_that_fills_the_field_have_another_noise() -> None:
    darks, flats, views = counts(60.0)
    assert "times the noise of the views" in told(darks, 100 + (flats - 100) * 10, views)
    assert "times the noise of the views" in told(2 * darks, 2 * flats, views)


def test_darks_above_the_views() -> None:
    darks, flats, views = counts(60.0)
    said = told(darks + 1800, flats, views)
    assert said.startswith("refused: ")
    assert "counts less than the darks" in said


def test_darks_of_zeros_beside_the_flats_of_a_camera_and_of_a_counter_of_photons() -> None:
    darks, flats, views = counts(20.0)
    assert "All darks are 0" in told(0 * darks, flats + 900, views + 900)
    assert "All darks are 0" not in told(0 * darks, flats - 100, views - 100)


def test_flats_that_end_at_one_count_everywhere() -> None:
    darks, flats, views = counts(20.0)
    darks = darks + np.random.default_rng(0).normal(0, 3, darks.shape)
    assert "every pixel of them holds 2500, though" in told(darks, np.minimum(flats, 2500), np.minimum(views, 2500))


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_transmission_in_whole_numbers_that_is_clipped_at_all_light_does_not_end(noise: float) -> None:
    full, through = np.full((1, *SHAPE), 65535.0), np.exp(-lines(20.0))
    through += noise * np.sqrt(through) * np.random.default_rng(3).standard_normal(through.shape)
    assert "counts end" not in told(0 * full, full, 65535 * through.clip(0, 1))


def test_a_step_and_turns_of_the_light_where_the_sample_fills_the_field() -> None:
    darks, flats, views = counts(60.0)
    views[20:] = (views[20:] - 100) * 0.7 + 100
    said = told(darks, flats, views)
    assert "Frames 10 and 54, half a turn apart, see one and the same matter, but differ by 0.36" in said
    darks, flats, views = counts(60.0)
    views[::2] = (views[::2] - 100) * 0.7 + 100
    assert "The views have 2 lights in turn" in told(darks, flats, views)


@pytest.mark.parametrize(("view", "factor"), [(2, 0.7), (30, 1.4)])
@pytest.mark.parametrize("rows", [slice(0, 24), slice(10, 12)], ids=["all rows", "two rows"])
def test_one_view_of_another_light_where_the_sample_fills_the_field(view: int, factor: float, rows: slice) -> None:
    darks, flats, views = (each[:, rows] for each in counts(60.0))
    assert "as a whole" not in told(darks, flats, views)
    views[view] = (views[view] - 100) * factor + 100
    assert f"Frame {10 + view} differs as a whole from those beside it, by 0.3" in told(darks, flats, views)


def test_a_wide_sample_of_even_edges_that_looks_like_a_weak_beam_is_told_how_to_say_so() -> None:
    darks, flats, views = counts(20.0)
    views = (views - 100) * 0.5 + 100
    assert "a sample wider than the field, give --air none." in told(darks, flats, views)


def test_images_with_dark_and_bright_exchanged() -> None:
    darks, flats, _ = counts(20.0)
    light = 100 + LIGHT * (1.6 - np.exp(-lines(20.0)))
    assert "brighter than the air beside it" in told(darks, flats, light)


@pytest.mark.parametrize("of_flats", [0.1, 0.3])
def test_flats_without_a_stated_exposure_beside_views_of_several(of_flats: float) -> None:
    """The longest of the views' by which no view is brighter than the flats."""
    darks, flats, views = counts(60.0)
    seconds = np.where(np.arange(len(views)) % 2, 0.1, 0.3)
    views = (views - 100) * seconds[:, None, None] / of_flats + 100
    exposures = np.concatenate([np.full(len(darks) + len(flats), np.nan), seconds])
    said = told(darks, flats, views, exposures)
    assert f"the flats, whose exposure is not stated, for {of_flats:g} s" in said
    assert "as the flats" not in said


@pytest.mark.parametrize("level", [1 - 0.9 * (1 - np.exp(-WARN)), np.exp(0.9 * BRIGHTER)])
def test_a_beam_that_drifts_is_not_told_of(level: float) -> None:
    darks, flats, views = counts(20.0)
    rng = np.random.default_rng(2)
    assert "as the flats" not in told(darks, flats, rng.poisson((views - 100) * level) + 100)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_views_that_were_scaled_each_by_itself(dtype: type) -> None:
    _, _, views = counts(20.0)
    low, high = views.min((1, 2), keepdims=True), views.max((1, 2), keepdims=True)
    whole = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    scaled = ((views - low) / (high - low) * whole).round(5 if whole == 1 else 0).astype(dtype)
    (finding,) = views_scaled(ArraySource(scaled, [0] * len(scaled), ANGLES))  # type: ignore[arg-type]
    assert finding.severity == "error"
    assert "scaled by itself" in finding.message
    one_scale = (views / views.max() * whole).astype(dtype)
    assert not list(views_scaled(ArraySource(one_scale, [0] * len(one_scale), ANGLES)))  # type: ignore[arg-type]


def test_a_dead_and_a_hot_pixel_are_no_scale() -> None:
    _, _, views = counts(20.0)
    views[:, 2, 3], views[:, 5, 6] = 0, 65535
    assert not list(views_scaled(ArraySource(views.astype(np.uint16), [0] * len(views), ANGLES)))  # type: ignore[arg-type]


def test_whole_numbers_that_stand_for_transmission() -> None:
    """A full scale of 16 bits for all light, as documented, is written and not saturated."""
    full = np.full((1, *SHAPE), 65535.0)
    said = told(0 * full, full, 65535 * np.exp(-lines(20.0)))
    assert said == ""


@pytest.mark.parametrize("end", [65535.0, 4095.0])
def test_flats_saturated_everywhere_beside_darks_of_one_number(end: float) -> None:
    darks, flats, views = counts(20.0)
    said = told(np.full_like(darks, 100), np.full_like(flats, end), views)
    assert said.startswith("refused: ")
    assert "100.00% of their pixels are saturated" in said


@pytest.mark.parametrize(
    ("lights", "of_flats", "step"),
    [
        ((1, 0.45), (1, 0.45), "--frames 0::2 or --frames 1::2 takes one"),
        ((1, 0.45), (1,), "--frames 0::2 takes one"),
        ((1, 4), (1,), "--frames 0::2 takes one"),
        ((1, 0.6, 0.3), (1, 0.6, 0.3), "--frames 0::3 or --frames 1::3 or --frames 2::3 takes one"),
    ],
)
@pytest.mark.parametrize("radius", [20.0, 60.0])
def test_lights_in_turn(radius: float, lights: tuple[float, ...], of_flats: tuple[float, ...], step: str) -> None:
    """As thresholds or exposures; steps count views, whatever stands before the first."""
    darks, flats, views = counts(radius)
    n = len(lights)
    before = (6, 6) if lights == of_flats else (5, 6 if len(of_flats) == 1 else 8)
    darks, flats = (np.resize(each, (m, *SHAPE)) for each, m in zip((darks, flats), before, strict=True))
    views = 100 + (views - 100) * np.resize(lights, len(views))[:, None, None]
    flats = 100 + (flats - 100) * np.resize(of_flats, len(flats))[:, None, None]
    said = told(darks, flats, views)
    assert f"The views have {n} lights in turn, from frame to frame" in said
    assert step in said


def test_a_beam_that_flickers_or_drifts_has_no_lights_in_turn() -> None:
    darks, flats, views = counts(20.0)
    for factors in (
        np.linspace(1, 0.8, 45),
        np.where(np.arange(45) < 20, 1, 0.7),
        1 - 0.3 * np.random.default_rng(2).random(45),
    ):
        assert "in turn" not in told(darks, flats, 100 + (views - 100) * factors[:, None, None])
