"""Which slices are read, and the box in them; balls in a can are found with number, size and position."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from can_of_balls import BALLS, CIRCLE, SHAPE, WALL, can, inside

from beamline.core.errors import DataError
from splatline_structure.materials import materials_of
from splatline_structure.numbers import Rules, structure_of
from splatline_structure.volumes import box_in, inscribed_box, read_volume, sample_circle, slabs_of


def test_the_circle_is_that_of_the_can() -> None:
    assert sample_circle(can()) == pytest.approx(CIRCLE, abs=0.75)


@pytest.mark.parametrize("radius", [5.3, 22.0, 40.0])
@pytest.mark.parametrize("margin", [0.0, 0.08, 0.45])
def test_the_side_is_2_r_cos_45_less_the_margins(radius: float, margin: float) -> None:
    _, y, x = inscribed_box((3, 200, 200), (100.0, 90.0, radius), margin)
    side = 2 * radius * np.cos(np.pi / 4) * (1 - 2 * margin)
    assert abs((y.stop - y.start) - side) <= 1 and abs((x.stop - x.start) - side) <= 1


def test_the_box_holds_nothing_of_a_cans_wall_and_all_of_a_wide_samples_field() -> None:
    volume = can(noise=0)
    z, y, x = box_in(volume, "square")
    assert z == slice(0, SHAPE[0]) and np.hypot(y.start - CIRCLE[0], x.start - CIRCLE[1]) < CIRCLE[2] - 3
    assert volume[:, y.start, x.start].max() < WALL / 2
    wide = np.random.default_rng(0).normal(1, 0.1, (10, 80, 80)).astype(np.float32)
    _, y, x = box_in(wide, "square")
    assert y == x and y.stop - y.start == pytest.approx(80 * np.cos(np.pi / 4) * 0.9, abs=1)
    assert box_in(wide, "none") == (slice(0, 10), slice(0, 80), slice(0, 80))


@pytest.mark.parametrize(("slices", "read_slices"), [(None, slice(11, 28)), ((2, 40), slice(12, 29))])
def test_slabs_of_a_volume_larger_than_the_memory_are_all_slices_and_are_counted(
    tmp_path: Path, slices: tuple[int, int] | None, read_slices: slice
) -> None:
    path, counted = tmp_path / "can.npy", list[tuple[int, int]]()
    np.save(path, can())
    read = read_volume(path, None, (10, 10, 10), slices, 13_300_000, "square")
    first, end = slices or (0, 40)
    assert (read.slices, read.asked, read.n_slices) == (read_slices, slice(first, end), 40)
    assert "free memory or give more --memory." in read.limit_sentence
    box = box_in(read.record.volume.data, "square")
    slabs = list(slabs_of(path, None, read, box, lambda n, of: counted.append((n, of))))
    own = [slabs[0], *(slab[1:] for slab in slabs[1:])]
    np.testing.assert_array_equal(np.concatenate(own), can()[first:end, *box[1:]])
    for one, following in pairwise(slabs):
        np.testing.assert_array_equal(one[-1], following[0])
    assert counted == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2])
def test_balls_in_a_can_are_found_with_number_volume_and_place(noise: float) -> None:
    box = box_in(can(noise), "square")
    volume = can(noise)[box]
    structure = structure_of(volume, materials_of(volume, 2).thresholds, (1, 1, 1), Rules(2, 1, side=0))
    particles = structure.particles
    place = particles.centroid + [part.start for part in box]
    known = [ball for ball in BALLS if ball[0][2] < 55]
    assert particles.label.size == len(known)
    for centre, radius in known:
        nearest = int(np.linalg.norm(place - centre, axis=1).argmin())
        np.testing.assert_allclose(place[nearest], centre, atol=0.3)
        # The level of half the contrast moves inwards by the mean curvature: σ² / r, σ² of the phantom's blur.
        assert -0.15 <= radius - particles.diameter[nearest] / 2 <= 0.6**2 / radius + 0.15
        assert structure.numbered[tuple(np.round(particles.centroid[nearest]).astype(int))] == particles.label[nearest]
    assert {len(each) for each in particles.neighbours} == {0, 1}  # two of them touch
    assert inside(known[0][0], known[0][1])[box][structure.numbered > 0].any()


def test_a_volume_that_is_not_finite_outside_a_circle_is_measured_inside_it(tmp_path: Path) -> None:
    volume = np.random.default_rng(0).random((10, 72, 72)).astype(np.float32)
    y, x = np.mgrid[:72, :72] - 35.5
    volume[:, np.hypot(y, x) > 35] = np.nan
    np.save(tmp_path / "v.npy", volume)
    for crop in ("square", "none"):
        with pytest.raises(DataError, match=r"2\d\.\d+% of the voxels of .* are not finite\. .*--crop finite"):
            read_volume(tmp_path / "v.npy", None, (1, 1, 1), None, 10**9, crop)
    read = read_volume(tmp_path / "v.npy", None, (1, 1, 1), None, 10**9, "finite")
    box = box_in(read.record.volume.data, "finite")
    assert np.isfinite(volume[box]).all() and box[1] == box[2] and box[1].stop - box[1].start in range(47, 52)
    volume[3, 36, 36] = np.inf
    with pytest.raises(ValueError, match="only outside a circle"):
        box_in(volume, "finite")
    np.testing.assert_equal(box_in(np.nan_to_num(volume), "finite"), box_in(np.nan_to_num(volume), "square"))
