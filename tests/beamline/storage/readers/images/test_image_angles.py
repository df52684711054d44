"""Angles in file names are checked over the whole series: used if consistent or requested, never altered."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.readers.images.image_angles import angles_in
from beamline.storage.readers.images.image_names import in_order

UP, BOTH, FINE = np.arange(0, 180, 2.0), np.arange(-90, 90, 2.0), np.arange(0, 180, 1.25)
GOLDEN = np.round((np.arange(90) * 111.246) % 180, 3)
Name = Callable[[float, int], str]


def _named(degrees: NDArray[np.float64], name: Name) -> list[str]:
    return [f"{name(float(a), i)}.tif" for i, a in enumerate(degrees)]


READ: dict[str, tuple[NDArray[np.float64], Name]] = {
    "a hyphen separates": (UP, lambda a, i: f"bone-{a:06.2f}deg-{i:04d}"),
    "a hyphen after the word separates": (UP, lambda a, i: f"bone_angle-{a:06.2f}_{i:04d}"),
    "hyphens everywhere": (UP, lambda a, i: f"2024-01-15-{a:05.1f}deg-{i:04d}"),
    "a full turn": (np.arange(0, 360, 4.0), lambda a, i: f"scan-{a:05.1f}deg_{i:04d}"),
    "plus and minus": (BOTH, lambda a, i: f"bone_angle{a:+06.1f}_{i:04d}"),
    "a hyphen of some is a sign": (BOTH, lambda a, i: f"bone_angle{a:.1f}_{i:04d}"),
    "a hyphen of some, before deg": (BOTH, lambda a, i: f"bone_20.5keV_{a:.1f}deg_{i:04d}"),
    "a minus": (BOTH, lambda a, i: f"bone_angle{a:.1f}_{i:04d}".replace("-", "\u2212")),
    "downwards from 0": (-UP.astype(int), lambda a, i: f"bone_angle{a:.0f}_{i:04d}".replace("-0_", "0_")),
    "n and p": (BOTH, lambda a, i: f"bone_{'n' if a < 0 else 'p'}{abs(a):04.1f}deg_{i:04d}"),
    "n and p alone": (BOTH, lambda a, i: f"bone{'n' if a < 0 else 'p'}{abs(a):02.0f}"),
    "m, and p for the point": (BOTH + 0.5, lambda a, i: f"bone_{'m' * (a < 0)}{abs(a):.1f}".replace(".", "p")),
    "neg": (BOTH, lambda a, i: f"bone_{'neg' * (a < 0)}{abs(a):03.0f}_{i:04d}"),
    "an index and a tilt": (BOTH, lambda a, i: f"TS_{i + 1:03d}_{a:.1f}"),
    "tilt as a word": (BOTH, lambda a, i: f"_{i + 1:03d}_{a:.0f}tilt_"),
    "a decimal comma": (FINE, lambda a, i: f"bone_angle_{a:06.2f}_{i:04d}".replace(".", ",")),
    "p for the point": (FINE, lambda a, i: f"bone_{a:06.2f}deg_{i:04d}".replace(".", "p")),
    "golden angles with commas": (GOLDEN - 90, lambda a, i: f"bone_ang{a:.3f}_{i:04d}".replace(".", ",")),
    "powers of ten": (BOTH + 1e-14, lambda a, i: f"bone_{a}deg_{i:04d}"),
    "the end of a word": (UP, lambda a, i: f"scan{a:.0f}deg_{i:04d}"),
}
ASKED: dict[str, tuple[NDArray[np.float64], Name, str]] = {
    "a hyphen, and no 0": (UP + 1, lambda a, i: f"bone-{a:03.0f}deg", "hyphen"),
    "a hyphen, and no zeros before": (UP, lambda a, i: f"bone_angle-{a:.1f}-{i}", "hyphen"),
    "minus 0": (-UP, lambda a, i: f"bone_{a:.1f}deg_{i:04d}", "hyphen"),
    "n": (UP, lambda a, i: f"bone_n{a:.0f}deg_{i:04d}", "the n before"),
    "an underscore for minus": (BOTH, lambda a, i: f"bone_angle{'_' * (a < 0)}{abs(a):.0f}_{i:04d}", "replaced"),
    "another separator for plus": (BOTH, lambda a, i: f"a{'-' if a < 0 else '_'}{abs(a):.1f}deg_{i}", "replaced"),
    "no sign at all": (BOTH, lambda a, i: f"bone_{abs(a):.1f}deg_{i:04d}", "90 names give only 46"),
    "an underscore for the point": (FINE, lambda a, i: f"a_angle_{a:06.2f}_{i:04d}".replace(".", "_"), "decimals"),
    "the decimals beside the unit": (GOLDEN, lambda a, i: f"a_{a:07.3f}deg_{i:04d}".replace(".", "_"), "decimals"),
    "the counter after a point": (UP, lambda a, i: f"bone_angle{a:03.0f}.{i:04d}", "count the images"),
    "the counter after the word": (FINE, lambda a, i: f"angle_{i:04d}_{a:.2f}", "counts the images"),
    "the counter alone": (FINE, lambda a, i: f"tomo_angle_{i + 1:04d}", "counts the images"),
    "a sign in uneven steps": ((UP / 18) ** 2 - 50, lambda a, i: f"S_{i:03d}_{a:.1f}", "even"),
}


@pytest.mark.parametrize("kind", READ)
def test_a_series_is_read_as_it_was_written(kind: str) -> None:
    degrees, name = READ[kind]
    names = _named(degrees, name)
    images = in_order("scan", names[::2] + names[1::2])
    rows = [names.index(each) for each in images.names]
    np.testing.assert_allclose(np.degrees(images.angles), degrees[rows], atol=1e-9)
    assert sorted(rows) == list(range(degrees.size)) == (rows if images.numbers is not None else sorted(rows))


@pytest.mark.parametrize("kind", ASKED)
def test_what_may_be_read_in_two_ways_is_asked_for(kind: str) -> None:
    degrees, name, why = ASKED[kind]
    images = in_order("scan", _named(degrees, name))
    assert np.isnan(images.angles).all()
    assert "angles in names such as" in images.doubt
    assert why in images.doubt


def test_other_numbers_in_names_are_no_angles() -> None:
    tiles = [f"sample_{i // 4:03d}_{i % 4:03d}_{i:04d}.tif" for i in range(12)]
    assert angles_in(tiles).radians is None
    assert angles_in([f"sample_{i:04d}.tif" for i in range(12)]).radians is None
    assert angles_in([f"angle_5_{i:04d}.tif" for i in range(12)]).radians is None
    assert angles_in([]).radians is None
