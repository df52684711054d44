"""Data Exchange: three separate stacks read as one scan, without guessing."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from drivers.base.frame import Frame, FrameKind
from tests.beamline.storage.readers.foreign_scans import FRAMES, exchange
from tests.messages import refused

Parts = dict[str, np.ndarray]


@pytest.fixture
def parts(rng: np.random.Generator) -> Parts:
    return {
        "data": rng.integers(0, 900, (5, 4, 6)).astype(np.uint16),
        "data_white": rng.integers(900, 1000, (3, 4, 6)).astype(np.uint16),
        "data_dark": rng.integers(0, 10, (2, 4, 6)).astype(np.uint16),
        "theta": np.linspace(0, 180, 5),
    }


def store(path: Path, parts: Parts, units: str | None = "deg") -> Path:
    with h5py.File(path, "w") as file:
        for name, values in parts.items():
            file[f"exchange/{name}"] = values
        if units is not None and "theta" in parts:
            file["exchange/theta"].attrs["units"] = units
    return path


def test_darks_then_flats_then_projections(tmp_path: Path, parts: Parts) -> None:
    with open_scan(store(tmp_path / "s.h5", parts)) as source:
        assert (source.format, source.quantity, source.finished) == ("data_exchange", "counts", True)
        assert source.table.kinds.tolist() == [2, 2, 1, 1, 1, 0, 0, 0, 0, 0]
        whole = np.concatenate([parts["data_dark"], parts["data_white"], parts["data"]])
        np.testing.assert_array_equal(source.read(slice(None)), whole)
        np.testing.assert_array_equal(source.read([9, 0, 4, 5, 2], slice(1, 3)), whole[[9, 0, 4, 5, 2], 1:3])
        np.testing.assert_allclose(source.table.angles[5:], np.linspace(0, np.pi, 5))
        assert np.isnan(source.table.angles[:5]).all()
        replayed = list(source.frames())
    assert [frame.trigger for frame in replayed] == [0, 1, 0, 1, 2, 0, 1, 2, 3, 4]
    assert [frame.kind for frame in replayed[:3]] == [FrameKind.DARK, FrameKind.DARK, FrameKind.FLAT]
    np.testing.assert_array_equal(replayed[7].counts, parts["data"][2])


def test_frames_named_by_their_path_are_the_same_scan(tmp_path: Path, parts: Parts) -> None:
    """With its darks, flats and degrees; where some of them are named, only these."""
    path = store(tmp_path / "s.h5", parts, None)
    named = {"data_path": "/exchange/data", "angles_path": "/exchange/theta"}
    with open_scan(SourceOptions(path, **named)) as source:  # type: ignore[arg-type]
        assert source.table.kinds.tolist() == [2, 2, 1, 1, 1, 0, 0, 0, 0, 0]
        np.testing.assert_allclose(source.table.angles[5:], np.linspace(0, np.pi, 5))
    flats = SourceOptions(path, data_path="exchange/data", flats_path="exchange/data_white", angles=np.arange(5.0))
    with open_scan(flats) as source:
        assert source.table.kinds.tolist() == [1, 1, 1, 0, 0, 0, 0, 0]


def test_float_references_keep_their_fractions(tmp_path: Path, parts: Parts) -> None:
    parts["data_white"] = parts["data_white"].astype(np.float32) + 0.25
    with open_scan(store(tmp_path / "s.h5", parts)) as source:
        assert source.dtype == np.float32
        np.testing.assert_array_equal(source.read([2])[0], parts["data_white"][0])
        assert next(source.frames()).counts.dtype == np.float32


@pytest.mark.parametrize(
    ("units", "factor"), [("deg", np.pi / 180), ("degrees", np.pi / 180), (None, np.pi / 180), ("rad", 1.0)]
)
def test_theta_is_in_degrees_unless_it_says_radians(
    tmp_path: Path, parts: Parts, units: str | None, factor: float
) -> None:
    with open_scan(store(tmp_path / "s.h5", parts, units)) as source:
        np.testing.assert_allclose(source.table.angles[5:], parts["theta"] * factor)
    with refused(DataError):
        open_scan(store(tmp_path / "s.h5", parts, "mm"))


@pytest.mark.parametrize("missing", [("data_white",), ("data_dark",), ("data_white", "data_dark")])
def test_without_references_the_quantity_is_unknown_until_it_is_said(
    tmp_path: Path, parts: Parts, missing: tuple[str, ...]
) -> None:
    path = store(tmp_path / "s.h5", {name: values for name, values in parts.items() if name not in missing})
    with open_scan(path) as source:
        assert source.quantity == "unknown"
    with open_scan(SourceOptions(path, quantity="line_integrals")) as source:
        assert source.quantity == "line_integrals"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"theta": None}, "no /exchange/theta"),
        ({"theta": np.zeros(4)}, "4 angles for 5 projections"),
        ({"data": np.zeros((6, 4, 6)), "theta": np.zeros((2, 3))}, r"6 angles for 6 projections, shape \(2, 3\)"),
        ({"data": np.zeros((0, 4, 6)), "theta": np.zeros(0)}, r"no projections: .* shape \(0, 4, 6\)"),
        ({"data_white": np.zeros((3, 4, 5))}, r"/exchange/data_white \(3, 4, 5\)"),
        ({"data": np.zeros((4, 6))}, r"expected frames \[frame, row, col\]"),
    ],
)
def test_what_does_not_fit_is_refused(
    tmp_path: Path, parts: Parts, change: dict[str, np.ndarray | None], said: str
) -> None:
    changed = {name: values for name, values in (parts | change).items() if values is not None}
    with pytest.raises(DataError, match=said):
        open_scan(store(tmp_path / "s.h5", changed))


@pytest.mark.parametrize("shape", [(5, 1), (1, 5)])
def test_a_column_of_angles_is_a_list_of_them(tmp_path: Path, parts: Parts, shape: tuple[int, int]) -> None:
    with open_scan(store(tmp_path / "s.h5", parts | {"theta": parts["theta"].reshape(shape)})) as source:
        np.testing.assert_allclose(source.table.angles[5:], np.linspace(0, np.pi, 5))


def test_our_own_exchange_view_reads_like_the_scan(path: Path, frames: list[Frame], tmp_path: Path) -> None:
    """A reader that knows only Data Exchange sees the same frames as one that knows NXtomo."""
    with open_scan(path) as native, h5py.File(path, "r") as file, h5py.File(tmp_path / "only_dx.h5", "w") as other:
        for name in file["exchange"]:
            other[f"exchange/{name}"] = file["exchange"][name][()]
        other["exchange/theta"].attrs["units"] = "deg"
        expected, angles = native.read(slice(None)), native.table.angles
    with open_scan(tmp_path / "only_dx.h5") as source:
        np.testing.assert_array_equal(source.read(slice(None)), expected)
        np.testing.assert_allclose(source.table.angles, angles)


def test_real_files(shared_data: Path) -> None:
    with open_scan(shared_data / "diamond_24737_parallel_91x135x160.h5") as source:
        assert (source.shape, source.quantity, source.dtype) == ((135, 160), "counts", np.float32)
        np.testing.assert_allclose(np.degrees(source.table.angles[[2, -1]]), [-88.2, 91.8], atol=1e-3)
    with open_scan(shared_data / "aps2bm_tooth_181x2x640.h5") as source:
        assert np.bincount(source.table.kinds).tolist() == [181, 10, 10]
        assert source.attributes["sample"] == "Tooth"
    with open_scan(shared_data / "walnut_parallel_rebinned_240x96x256.h5") as source:
        assert source.quantity == "unknown"
        assert source.pixel_size_mm == pytest.approx(0.152172, abs=1e-6)


@pytest.mark.parametrize(
    ("theta", "white"),
    [
        (np.arange(8) * 20.0, [0, 0, 160, 160]),
        (np.arange(8)[::-1] * 20.0, [170, 170, 0, 0]),  # backwards
        (np.arange(8) * 111.246 % 180, [0, 0, 180, 180]),  # views in another order
    ],
)
@pytest.mark.parametrize("unit", ["deg", "radians"])
def test_flats_of_both_ends_with_their_angles_stand_around_the_views(
    tmp_path: Path, theta: np.ndarray, white: list[int], unit: str
) -> None:
    """Nobody needs to say when the darks were taken, or again in which unit."""
    said = np.radians if unit == "radians" else np.asarray
    frames = {"data": np.full((8, 2, 3), 50), "data_white": np.arange(100, 124).reshape(4, 2, 3)}
    parts = frames | {"data_dark": np.zeros((2, 2, 3)), "theta": said(theta), "theta_white": said(white)}
    with open_scan(store(tmp_path / "s.h5", {k: v.astype(float) for k, v in parts.items()}, unit)) as source:
        assert source.table.kinds.tolist() == [2, 2, 1, 1, *[0] * 8, 1, 1] and not source.in_order
        np.testing.assert_array_equal(source.read([2, 3, 12, 13]), frames["data_white"])
        np.testing.assert_allclose(np.degrees(source.table.angles[4:12]), theta)


@pytest.mark.parametrize(
    ("chunks", "axes"),
    [((64, 256, 320), "theta:y:x"), ((64, 8, 32), "theta:y:x"), ((1, 64, 320), "y:theta:x")],
)
def test_a_piece_of_the_file_that_holds_many_frames_is_unpacked_once(
    tmp_path: Path, chunks: tuple[int, int, int], axes: str
) -> None:
    """Frames read one by one take about as long as all at once, not 64 times as long, also beyond HDF5's own 8 MiB."""
    frames = np.random.default_rng(0).integers(0, 4, (64, 256, 320), np.uint16)
    stored = frames.swapaxes(0, 1) if axes.startswith("y") else frames
    with h5py.File(tmp_path / "s.h5", "w") as file:
        data = file.create_dataset("exchange/data", data=stored, chunks=chunks, compression="gzip", compression_opts=1)
        data.attrs["axes"] = axes
        file["exchange/theta"] = np.arange(64.0)
    with open_scan(tmp_path / "s.h5") as source, open_scan(tmp_path / "s.h5") as other:
        started = process_time()
        np.testing.assert_array_equal(source.read(slice(None)), frames)
        at_once = process_time() - started
        one_by_one = [other.read([row])[0] for row in range(64)]
        assert process_time() - started < 12 * at_once
        np.testing.assert_array_equal(one_by_one, frames)


@pytest.mark.parametrize("axes", [None, "theta:y:x", "y:theta:x", "y:x:theta", "x:y:theta", "theta:x:y", "x:theta:y"])
def test_frames_in_any_order_of_axes_are_the_same_scan(tmp_path: Path, axes: str | None) -> None:
    with open_scan(exchange(tmp_path / "s.h5", axes=axes)) as source:
        np.testing.assert_array_equal(source.read(slice(None)), FRAMES)
        np.testing.assert_array_equal(source.read([6, 0, 3, 4], slice(1, 3)), FRAMES[[6, 0, 3, 4], 1:3])


def test_axes_that_are_unknown_are_named(tmp_path: Path) -> None:
    path = exchange(tmp_path / "s.h5")
    with h5py.File(path, "r+") as file:
        file["exchange/data"].attrs["axes"] = "a:b:c"
    (hit,) = [hit for hit in validate(path) if hit.rule == "not-used"]
    assert hit.severity == "warning" and "exchange/data@axes, a:b:c" in hit.message


@pytest.mark.parametrize("where", ["attributes", "process", "radians", "two", "elsewhere", "search", "count", "wide"])
def test_start_and_step_of_the_rotation_stand_for_theta(tmp_path: Path, parts: Parts, where: str) -> None:
    del parts["theta"]
    path = store(tmp_path / "s.h5", parts)
    with h5py.File(path, "a") as file:
        if where == "attributes":
            file["exchange"].attrs.update(rotation_start=10.0, rotation_step=36.0, exposure_start=3.0)
        else:
            others = {"elsewhere": "exposure", "search": "process/rotation_axis_search"}
            group = file.create_group(others.get(where, "process/acquisition/rotation"))
            group.attrs["restart_theta"] = 3.0
            group["start"], group["step"] = np.radians([10.0, 36.0]) if where == "radians" else (10.0, 36.0)
            for name in ("start", "step"):
                group[name].attrs["units"] = "rad" if where == "radians" else "deg"
        if where == "two":
            file["exchange/data"].attrs["rotation_start"] = 0.0
        elif where == "count":
            group.move("step", "num_steps")
        elif where == "wide":
            group["step"][()] = 1500.0
    if where not in ("attributes", "process", "radians"):
        with refused(DataError):
            open_scan(path)
    else:
        with open_scan(path) as source:
            np.testing.assert_allclose(np.degrees(source.table.angles[-5:]), 10 + 36 * np.arange(5))
            assert "start and step of the rotation" in str(source.attributes["angles_from"])
