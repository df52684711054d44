"""Volumes in the browser: what slices, histograms and profiles hold."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion
from beamline.page.volume import ShownVolume
from tests.beamline.page.served import Served, viewed
from tests.beamline.page.test_app import tile

SHAPE = (6, 8, 10)
RAMP = np.arange(480, dtype=np.float32).reshape(SHAPE)
ALL = TileRegion(0, 99, 0, 99)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    folder = tmp_path_factory.mktemp("volumes")
    paths = folder / "ramp.npy", folder / "twice.npy", folder / "small.npy"
    for path, values in zip(paths, (RAMP, 2 * RAMP, RAMP[:3]), strict=True):
        np.save(path, values)
    return paths


@pytest.fixture(scope="module")
def pair(files: tuple[Path, Path, Path]) -> Iterator[Served]:
    with viewed(*files[:2]) as page:
        yield page


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_is_that_of_the_volume(pair: Served, axis: int) -> None:
    head, values = tile(pair.ask(f"/api/slice/1/{axis}/2")[2])
    np.testing.assert_allclose(values, 2 * RAMP.take(2, axis), atol=0.51 * float(str(head["scale"])))
    head, values = tile(pair.ask(f"/api/slice/0/{axis}/2?region=1,3,2,5")[2])
    np.testing.assert_allclose(values, RAMP.take(2, axis)[1:3, 2:5], atol=0.51 * float(str(head["scale"])))
    assert head["region"] == [1, 3, 2, 5]


def test_a_difference_is_the_second_less_the_first(pair: Served) -> None:
    np.testing.assert_allclose(tile(pair.ask("/api/difference/0/3")[2])[1], RAMP[3], atol=1e-2)


def test_a_profile_has_the_values_between_voxels(pair: Served) -> None:
    found = json.loads(pair.ask("/api/profile/0/0/0?line=0.5,0.5,0.5,9.5")[2])
    np.testing.assert_allclose(found["values"], np.arange(10))
    np.testing.assert_allclose(found["distance"], np.arange(10))


def test_a_histogram_counts_each_voxel_once(pair: Served) -> None:
    found = json.loads(pair.ask("/api/histogram/0")[2])
    assert sum(found["voxels"]) == RAMP.size
    np.testing.assert_allclose(np.average(found["values"], weights=found["voxels"]), RAMP.mean(), rtol=1e-2)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("slice/0/0/6", "not in a volume of (6, 8, 10)"),
        ("slice/0/3/0", "not in a volume"),
        ("slice/2/0/0", "not shown here"),
        ("profile/0/0/0?line=1,2,nan,3", "first row, first column"),
        ("profile/0/0/0", "first row, first column"),
    ],
)
def test_what_is_not_there_is_a_sentence(pair: Served, path: str, message: str) -> None:
    status, _, body = pair.ask(f"/api/{path}")
    assert (status, message in json.loads(body)["message"]) == (404, True)


def test_volumes_of_two_shapes_have_no_difference(files: tuple[Path, Path, Path]) -> None:
    with viewed(files[0], files[2]) as page:
        assert page.ask("/api/difference/0/0")[0] == 404
        assert page.ask("/api/slice/1/0/2")[0] == 200


def test_nothing_is_answered_without_the_token(pair: Served) -> None:
    for path in ("/", "/static/view.js", "/api/volumes", "/api/slice/0/0/0"):
        assert pair.ask(path, token="")[0] == 403


def test_a_large_volume_is_binned_across_y_and_x_alone(files: tuple[Path, Path, Path]) -> None:
    read: list[tuple[int, int]] = []
    volume = ShownVolume(files[0], lambda n, of: read.append((n, of)), held=RAMP.nbytes // 8)
    assert (volume.coarse_bin, read[-1]) == (2, (3, 3))
    np.testing.assert_array_equal(volume.cut(0, 5, ALL)[0], RAMP[5])
    values, shown, bin_ = volume.cut(1, 3, ALL)
    np.testing.assert_array_equal(values, RAMP[::2, 2:4].mean(axis=1).reshape(3, 5, 2).mean(axis=2))
    assert (shown, bin_) == (TileRegion(0, 6, 0, 10), 2)
    volume.close()


def test_a_constant_volume_and_one_without_numbers_are_shown(tmp_path: Path) -> None:
    for value in (3.0, np.nan):
        np.save(tmp_path / "v.npy", np.full(SHAPE, value, np.float32))
        volume = ShownVolume(tmp_path / "v.npy")
        low, high = volume.facts()["window"]
        assert low < high
        assert sum(volume.histogram()["voxels"]) in (0, RAMP.size)
        volume.close()


def test_what_is_no_volume_is_refused(tmp_path: Path) -> None:
    (tmp_path / "v.h5").write_text("no volume")
    with pytest.raises(DataError):
        ShownVolume(tmp_path / "v.h5")
