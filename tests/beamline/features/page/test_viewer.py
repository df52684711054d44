"""Volumes in the browser: content of slices, histograms and profiles."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.features.page import command as view_command
from beamline.page import volume as volume_file
from beamline.page.tiles import TileRegion
from beamline.page.volume import ShownVolume
from beamline.storage.volumes.base import Pixels, bare_record
from beamline.storage.volumes.files import write_volume
from tests.beamline.features.page.served import Served, viewed
from tests.beamline.features.page.test_app import tile

SHAPE = (6, 8, 10)
RAMP: NDArray[Any] = np.arange(480, dtype=np.float32).reshape(SHAPE)
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
        ("slice/0/0/6", "outside the volume of (6, 8, 10)"),
        ("slice/0/3/0", "outside the volume"),
        ("slice/2/0/0", "does not show volume 2"),
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
    volume = ShownVolume(files[0], held=RAMP.nbytes // 8)
    np.testing.assert_array_equal(volume.cut(0, 5, ALL).values, RAMP[5])
    tile = volume.cut(1, 3, ALL)
    np.testing.assert_array_equal(tile.values, RAMP[::2, 2:4].mean(axis=1).reshape(3, 5, 2).mean(axis=2))
    assert (tile.region, tile.bin, tile.ready) == (TileRegion(0, 6, 0, 10), 2, 1.0)
    volume.close()


def test_the_page_of_a_volume_reads_the_rest_by_itself(
    files: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(volume_file, "FIRST_READ_BYTES", 0)
    with viewed(*files[:2]) as page:
        for _ in range(2 * SHAPE[0]):  # an answer comes after a slice that waits
            ready = [tile(page.ask(f"/api/slice/{which}/1/0")[2])[0]["ready"] for which in (0, 1)]
        assert ready == [1.0, 1.0]


@pytest.mark.parametrize("name", ["v.ome.zarr", "v", "v.h5", "v.tif", "v.nrrd"])
def test_every_format_is_shown(tmp_path: Path, name: str) -> None:
    write_volume(tmp_path / name, bare_record(tmp_path, RAMP, (0.2, 0.1, 0.1)))
    volume = ShownVolume(tmp_path / name)
    for axis in range(3):
        np.testing.assert_array_equal(volume.cut(axis, 3, ALL).values, RAMP.take(3, axis))
    volume.close()


def test_grey_values_of_a_window_are_shown_as_what_they_stand_for(tmp_path: Path) -> None:
    write_volume(tmp_path / "v.zarr", bare_record(tmp_path, RAMP, (0.2, 0.1, 0.1)), Pixels(16, (0.0, 500.0)))
    volume = ShownVolume(tmp_path / "v.zarr")
    np.testing.assert_allclose(volume.cut(0, 3, ALL).values, RAMP[3], atol=0.01)
    volume.close()


FINE: NDArray[Any] = np.random.default_rng(1).random((40, 304, 1500), np.float32)


@pytest.fixture(scope="module")
def scaled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scales") / "v.zarr"
    write_volume(path, bare_record(path.parent, FINE, (0.1, 0.1, 0.1)))
    return path


def _mean(values: np.ndarray, factor: int) -> np.ndarray:
    shape = [n // factor for n in values.shape]
    blocks = values[tuple(slice(n * factor) for n in shape)]
    return blocks.reshape([part for n in shape for part in (n, factor)]).mean(axis=tuple(range(1, 2 * values.ndim, 2)))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_tile_of_a_volume_with_scales_has_the_resolution_that_it_needs(scaled: Path, axis: int) -> None:
    volume = ShownVolume(scaled)
    whole, part = volume.cut(axis, 33, TileRegion(0, 9999, 0, 9999)), volume.cut(axis, 33, TileRegion(3, 30, 20, 260))
    assert (whole.bin, part.bin, whole.ready) == (1 if axis == 2 else 2, 1, 1.0)
    np.testing.assert_allclose(whole.values, _mean(FINE, whole.bin).take(33 // whole.bin, axis), atol=1e-6)
    np.testing.assert_array_equal(part.values, FINE.take(33, axis)[3:30, 20:260])
    found = volume.profile(axis, 33, (5.5, 20.5, 5.5, 99.5))
    np.testing.assert_allclose(found["values"], FINE.take(33, axis)[5, 20:100], atol=1e-6)
    volume.close()


def test_no_slice_of_a_volume_with_scales_costs_more_than_a_bounded_read(
    scaled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    volume = ShownVolume(scaled)
    monkeypatch.setattr(volume_file, "SLICE_READ_BYTES", 0)
    tile = volume.cut(2, 1444, TileRegion(0, 9999, 0, 9999))
    assert (tile.bin, tile.region) == (8, TileRegion(0, 40, 0, 304))
    np.testing.assert_allclose(tile.values, _mean(FINE, 8)[:, :, 180], atol=1e-6)
    monkeypatch.setattr(volume_file, "SLICE_READ_BYTES", 5 * 2**22)  # five chunks of 16 x 256 x 256
    assert volume.cut(2, 1444, TileRegion(0, 9999, 0, 9999)).bin > volume.cut(2, 1444, TileRegion(0, 40, 0, 100)).bin
    volume.close()


def test_an_array_of_a_file_with_several_is_shown_by_its_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", a=RAMP, b=3 * RAMP)
    path = str(tmp_path / "two.npz")
    with pytest.raises(DataError, match=r"contains 2 volumes .*FILE::NAME"):
        ShownVolume(tmp_path / "two.npz")
    found, name = view_command._named(f"{path}::b")
    volume = ShownVolume(found, dataset=name)
    assert volume.facts()["name"] == "two.npz::b"
    np.testing.assert_array_equal(volume.cut(0, 2, ALL).values, 3 * RAMP[2])
    volume.close()
    assert view_command._named(path) == (tmp_path / "two.npz", None)


def test_windows_are_buttons_of_the_page(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", RAMP.astype(np.float32))
    volume = ShownVolume(tmp_path / "v.npy")
    facts = volume.facts()
    volume.close()
    assert next(iter(facts["windows"])) == "matter" and [*facts["windows"]][-1] == "all"
    assert facts["window"] == facts["windows"]["matter"]
    assert all(low < high for low, high in facts["windows"].values())
