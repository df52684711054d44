"""Zingers in a single projection are filled; sample, detector and noise are not changed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.base.arrays import F32
from recon.prep.references import References
from recon.prep.spots import SpotFilter, Transmission, without_spots

VIEWS, ROWS, COLS, LIGHT = 12, 24, 60, 4e4


def light(views: int = VIEWS, photons: float = LIGHT, rows: int = ROWS) -> F32:
    """Transmission of two opaque pins with sharp edges that turn by many pixels a view, and of a smooth body."""
    rng, cols = np.random.default_rng(1), np.arange(COLS)
    out = np.empty((views, rows, COLS), np.float32)
    for at, angle in enumerate(np.linspace(0, np.pi, views, endpoint=False)):
        lines = 0.05 * np.sqrt(np.clip(25.0**2 - (cols - 29.5) ** 2, 0, None))
        for radius, phase in ((18.0, 0.0), (15.0, 2.0)):
            lines = lines + 1.0 * (np.abs(cols - 29.5 - radius * np.cos(angle + phase)) < 3)
        out[at] = rng.poisson(photons * np.exp(-np.broadcast_to(lines, (rows, COLS)))) / photons
    return out


def filtered(views: F32, ends: tuple[int, ...] = (), threshold: float = 8.0) -> Transmission:
    """The views after the filter, in batches that end at `ends`."""
    spots, parts = SpotFilter(threshold, lambda image: np.sqrt(np.maximum(image, 0))), []
    for first, end in zip((0, *ends), (*ends, len(views)), strict=True):
        ids = np.arange(first, end)
        part, spots = spots.feed(
            Transmission(views[first:end].copy(), ids, np.zeros(ids.size, int), np.ones(ids.size, np.float32)),
            end == len(views),
        )
        parts.append(part)
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.and_then(part)
    return whole


@pytest.mark.parametrize("rows", [ROWS, 1])
@pytest.mark.parametrize(
    ("down", "across", "amount"), [(1, 1, 0.4), (2, 2, 0.4), (3, 3, 1.5), (1, 9, 1.5), (12, 2, 1.5)]
)
def test_a_spot_goes_and_nothing_else(down: int, across: int, amount: float, rows: int) -> None:
    """Also as a line, where it is brighter than all light of the view before; but not of one row."""
    clean = light(rows=rows)
    views, hit = clean.copy(), np.zeros(clean.shape, bool)
    for view, row, col in ((3, 6, 4), (7, 10, 50), (8, 0, 30)):
        hit[view, row % rows : row % rows + down, col : col + across] = True
    views[hit] += amount
    found = filtered(views)
    edge = rows == 1 and across > 3
    assert (found.repaired.sum() < 0.5 * hit.sum()) if edge else (found.repaired.sum() >= 0.9 * hit.sum())
    np.testing.assert_array_equal(found.data[~hit], clean[~hit])
    assert edge or np.abs(found.data[hit] - clean[hit]).mean() < amount / 4


@pytest.mark.parametrize("views", [4, 12, 90])
@pytest.mark.parametrize("photons", [30.0, 100.0, LIGHT])
def test_sharp_edges_of_few_views_noise_and_pixels_that_stay_are_left(views: int, photons: float) -> None:
    clean = light(views, photons)
    clean[:, 5, 7] += 1.0  # a hot pixel
    assert not filtered(clean).repaired.any()


@pytest.mark.parametrize("ends", [(1, 2, 3), (5,), (11,)])
def test_batches_are_the_views_at_once_to_the_bit(ends: tuple[int, ...]) -> None:
    clean = light(90)
    hit = np.random.default_rng(4).random(clean.shape) < 0.02
    views = clean + hit.astype(np.float32)
    whole, parts = filtered(views), filtered(views, ends)
    np.testing.assert_array_equal(parts.data, whole.data)
    np.testing.assert_array_equal(parts.repaired, whole.repaired)
    assert whole.repaired.sum() > 0.85 * hit.sum()  # the others lie where edges pass, or beside one another


@pytest.mark.parametrize("views", [30, 90, 180])
def test_gaps_between_opaque_beads_are_no_spots(views: int) -> None:
    """They follow the sample, or open for one view. A spot brighter than the beam is one there, too."""
    rng, shape = np.random.default_rng(3), (24, 64)
    (rows, cols), n = np.indices(shape), 90
    turn, away = rng.uniform(0, 2 * np.pi, n), 26 * np.sqrt(rng.uniform(0, 1, n))
    height, radius, dark = rng.uniform(0, shape[0], n), rng.uniform(2, 5, n), np.zeros((views, *shape), np.bool_)
    for view, angle in enumerate(np.linspace(0, np.pi, views, endpoint=False)):
        for z, r, across in zip(height, radius, 31.5 + away * np.cos(turn + angle), strict=True):
            dark[view] |= (rows - z) ** 2 + (cols - across) ** 2 < r**2
    clean = (rng.poisson(2e4 * ~dark) / 2e4).astype(np.float32)
    assert filtered(clean).repaired.sum() < 2e-5 * clean.size < 2e-3 * clean.size < (~dark).sum()
    hit = rng.random(clean.shape) < 1e-3
    spotted = clean + np.where(hit, np.float32(1.5), np.float32(0))
    found = filtered(spotted)
    assert (found.data != spotted)[hit].mean() > 0.95


def test_light_of_two_kinds_in_turn_has_no_spots() -> None:
    views = light(90)
    views[..., 1:3] *= np.float32(1.2)  # a stripe of the beam
    views[::2] *= np.float32(0.6)
    assert not filtered(views).repaired.any()


@pytest.mark.parametrize(("size", "left"), [(3, 0), (5, 25)])
def test_spots_that_are_too_large_are_counted(size: int, left: int) -> None:
    views, spots = light(), SpotFilter(8.0, lambda image: np.sqrt(np.maximum(image, 0)))
    views[5, 8 : 8 + size, 20 : 20 + size] += 1.5
    ids = np.arange(VIEWS)
    _, after = spots.feed(Transmission(views, ids, np.zeros(VIEWS, int), np.ones(VIEWS, np.float32)))
    assert after.n_unfilled == left and spots.n_unfilled == 0


def test_a_bright_pixel_that_may_be_a_rim_of_few_views_is_no_large_spot() -> None:
    views, spots = np.ones((VIEWS, ROWS, COLS), np.float32), SpotFilter(8.0, np.sqrt)
    views[4, :, 20:40], views[6, :, 20:40] = 0.5, 0.8  # the views beside it differ by much
    views[5, 12, 30] = 1.5
    views[8, 12, 30] = 1.5
    ids = np.arange(VIEWS)
    found, after = spots.feed(Transmission(views, ids, np.zeros(VIEWS, int), np.ones(VIEWS, np.float32)))
    assert np.flatnonzero(found.repaired).tolist() == [8]
    assert after.n_unfilled == 0


def test_neighbours_of_interlaced_views_are_those_by_angle() -> None:
    views = light(90)
    views[np.random.default_rng(4).random(views.shape) < 0.01] += 0.5
    passes = np.concatenate([np.arange(first, 90, 9) for first in range(9)])
    root: Callable[[F32], F32] = lambda image: np.sqrt(np.maximum(image, 0))  # noqa: E731
    taken = Transmission(views[passes], passes, np.zeros(90, int), np.ones(90, np.float32))
    found, _ = SpotFilter(8.0, root).feed(taken, order=np.argsort(passes))
    np.testing.assert_array_equal(found.data[np.argsort(passes)], filtered(views).data)


@pytest.mark.parametrize(("level", "light"), [(4e4, 4e4), (100.0, 4e4)])
@pytest.mark.parametrize("frames", [2, 5])
def test_spots_of_flats_and_darks_are_not_in_their_mean(frames: int, level: float, light: float) -> None:
    rng = np.random.default_rng(6)
    pattern = rng.normal(level, level / 20, (20, 30))
    pattern[4, 5] *= 2  # a hot pixel
    clean = rng.poisson(pattern, (frames, 20, 30)).astype(np.uint16)
    assert sum(n for _, n in without_spots(clean, light)) == 0
    spotted = clean.copy()
    spotted[0, 3:5, 7:9] += 20000
    spotted[-1, 15, 0] += 20000
    images, found = zip(*without_spots(spotted, light), strict=True)
    assert found == (4, *[0] * (frames - 2), 1)
    assert np.abs(np.mean(images, axis=0) - clean.mean(axis=0)).max() < 6 * np.sqrt(1.2 * level / frames)
    flat = np.full((20, 30), light, np.float32)
    made = References(spotted.astype(np.float32), ((0.0, flat),)).dark
    np.testing.assert_allclose(made, np.mean(images, axis=0), rtol=1e-6)


def test_a_single_frame_stays_as_it_is() -> None:
    frame = np.full((9, 9), 100.0)
    frame[4, 4] = 60000
    ((image, n),) = without_spots([frame], 4e4)
    assert n == 0 and image is frame
