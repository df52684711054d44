"""Reading NXtomo: replay gives the same frames; files of other programs are read by structure, without guessing."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.monitor.digest import digest
from beamline.storage.readers.open import NotReadyError, SourceOptions, open_scan
from beamline.storage.readers.reference_files import overlaid
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.storage.conftest import EPOCH, INFO
from tests.clock import SteppedClock
from tests.messages import refused

Write = Callable[[list[Frame]], Path]


@st.composite
def scans(draw: st.DrawFn) -> list[Frame]:
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return [
        Frame(
            counts=rng.integers(0, 65536, shape).astype(np.uint16),
            kind=(kind := draw(st.sampled_from(FrameKind))),
            index=i,
            trigger=draw(st.integers(0, 2**40)),
            framestamp=draw(st.integers(-1, 2**40)),
            angle=draw(st.floats(-20, 20) | st.just(np.nan)),
            time=draw(st.floats(0, 4e9)),
            exposure=draw(st.floats(1e-6, 1e4)),
            aside=draw(st.floats(0.1, 9)) if kind is FrameKind.OFFSET_VIEW else 0.0,
        )
        for i in range(draw(st.integers(0, 6)))
    ]


@settings(max_examples=15, deadline=None)
@given(frames=scans(), flush_every=st.integers(1, 4))
def test_replay_yields_the_same_frames(frames: list[Frame], flush_every: int) -> None:
    shape = frames[0].counts.shape if frames else (2, 3)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.h5"
        info = replace(INFO, offset_views=True)
        with NXtomoWriter(path, info, shape, clock=SteppedClock(EPOCH), flush_every=flush_every) as writer:
            for frame in frames:
                writer.append(frame, digest(frame.counts))
        with open_scan(path) as source:
            found = list(source.frames())
    assert len(found) == len(frames)
    for a, b in zip(found, frames, strict=True):
        np.testing.assert_array_equal(a.counts, b.counts)
        assert a.counts.dtype == np.uint16
        assert (a.kind, a.index, a.trigger, a.framestamp) == (b.kind, b.index, b.trigger, b.framestamp)
        assert (a.time, a.exposure, a.aside) == (b.time, b.exposure, b.aside)
        np.testing.assert_allclose(a.angle, b.angle, rtol=1e-15)  # degrees in the file


def test_each_frame_has_its_own_exposure(tmp_path: Path, write: Write, frames: list[Frame]) -> None:
    own = [replace(frame, exposure=0.01 * (frame.index + 1)) for frame in frames]
    with open_scan(write(own)) as source:
        np.testing.assert_allclose(source.table.exposures, 0.01 * np.arange(1, 15))
    with open_scan(SourceOptions(tmp_path / "scan.h5", flats=np.ones((2, 12, 16), np.uint16))) as source:
        np.testing.assert_allclose(source.table.exposures, [np.nan] * 2 + [frame.exposure for frame in own])
    with open_scan(foreign(tmp_path / "ms.nxs")) as source:
        np.testing.assert_allclose(source.table.exposures, np.full(6, 0.02))
    for values, expected in (([20.0], [0.02] * 6), ([0, 0, 0, 20, 20, 20], [np.nan] * 3 + [0.02] * 3)):
        with h5py.File(foreign(tmp_path / "f.nxs"), "r+") as file:
            del file["entry1/tomo_entry/instrument/detector/count_time"]
            file["entry1/tomo_entry/instrument/detector/count_time"] = values
            file["entry1/tomo_entry/instrument/detector/count_time"].attrs["units"] = "ms"
        with open_scan(tmp_path / "f.nxs") as source:
            np.testing.assert_allclose(source.table.exposures, expected)


def foreign(path: Path, *, units: str | None = "degree", dtype: str = "u2", entry: str = "entry1/tomo_entry") -> Path:
    """An NXtomo as others write it: other entry name, no record of ours."""
    with h5py.File(path, "w") as file:
        group = file.create_group(entry)
        group["definition"] = "NXtomo"
        group["instrument/detector/data"] = np.arange(6 * 4 * 5).reshape(6, 4, 5).astype(dtype)
        group["instrument/detector/image_key"] = [2, 1, 0, 0, 0, 3]
        group["instrument/detector/count_time"] = np.full(6, 20.0)
        group["instrument/detector/count_time"].attrs["units"] = "ms"
        group["instrument/detector/x_pixel_size"] = 2.5e-6
        group["instrument/detector/x_pixel_size"].attrs["units"] = "m"
        group["instrument/beam/incident_energy"] = 30500.0
        group["instrument/beam/incident_energy"].attrs["units"] = "eV"
        group["sample/rotation_angle"] = [0.0, 0, 0, 90, 180, 180]
        if units is not None:
            group["sample/rotation_angle"].attrs["units"] = units
    return path


def test_a_foreign_nxtomo_in_savus_place(tmp_path: Path) -> None:
    with open_scan(foreign(tmp_path / "f.nxs")) as source:
        np.testing.assert_allclose(source.table.angles[2:5], [0, np.pi / 2, np.pi])
        assert source.pixel_size_mm == pytest.approx(0.0025)
        assert source.energy_kev == pytest.approx(30.5)
        assert source.axis_col is None
        replayed = list(source.frames())
        assert [frame.trigger for frame in replayed] == [0, 0, 0, 1, 2, 0]
        assert replayed[3].exposure == pytest.approx(0.02)
        assert (replayed[3].framestamp, np.isnan(replayed[3].time)) == (-1, True)


def test_the_ring_current_of_each_frame(tmp_path: Path) -> None:
    """0 and what is no number are unknown; laid-over references have none."""
    path = foreign(tmp_path / "f.nxs")
    with open_scan(path) as source:
        assert source.table.currents is None
    with h5py.File(path, "r+") as file:
        file["entry1/tomo_entry/control/data"] = [0.0, 199.5, 200.0, 190.0, 180.0, np.nan]
    with open_scan(path) as source:
        np.testing.assert_array_equal(source.table.currents, [np.nan, 199.5, 200.0, 190.0, 180.0, np.nan])
    with open_scan(path) as source:
        over = overlaid(source, darks=np.zeros((2, 4, 5), np.uint16))
        np.testing.assert_array_equal(over.table.currents, [np.nan] * 3 + [199.5, 200.0, 190.0, 180.0, np.nan])


@pytest.mark.parametrize(("units", "said"), [(None, "no attribute units"), ("mm", "units 'mm'")])
def test_angles_without_a_unit_are_refused_unless_the_caller_brings_angles(
    tmp_path: Path, units: str | None, said: str
) -> None:
    with open_scan(foreign(tmp_path / "f.nxs", units="rad")) as source:
        assert source.table.angles[3] == 90
    path = foreign(tmp_path / "f.nxs", units=units)
    with pytest.raises(DataError, match=said):
        open_scan(path)
    with open_scan(SourceOptions(path, angles=[0.0, 1.0, 2.0])) as source:
        np.testing.assert_array_equal(source.table.angles, [np.nan, np.nan, 0, 1, 2, np.nan])


def test_float_frames_are_of_unknown_quantity_and_stay_floats(tmp_path: Path) -> None:
    with open_scan(foreign(tmp_path / "f.nxs", dtype="f4")) as source:
        assert source.quantity == "unknown" and next(source.frames()).counts.dtype == np.float32


def test_several_entries_need_a_default(tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.nxs", entry="entry0000")
    with h5py.File(path, "r+") as file:
        file.copy("entry0000", "entry0001")
        file["entry0001/sample/rotation_angle"][...] = 7
    with refused(DataError):
        open_scan(path)
    with h5py.File(path, "r+") as file:
        file.attrs["default"] = "entry0001"
    with open_scan(path) as source:
        np.testing.assert_allclose(source.table.angles, np.radians(7))


def test_frames_in_a_linked_file_that_is_gone(tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.nxs")
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "pixels.h5", "w") as pixels:
        detector = file["entry1/tomo_entry/instrument/detector"]
        pixels["data"] = detector["data"][()]
        del detector["data"]
        detector["data"] = h5py.ExternalLink("pixels.h5", "data")
    with open_scan(path) as source:
        assert source.read([5])[0, -1, -1] == 119
    (tmp_path / "pixels.h5").unlink()
    with refused(DataError):
        open_scan(path)


def _renamed(pixels: Path) -> None:
    with h5py.File(pixels, "r+") as file:
        file.move("data", "other")


def _shorter(pixels: Path) -> None:
    with h5py.File(pixels, "r+") as file:
        frames = file["data"][:5]
        del file["data"]
        file["data"] = frames


def _drawn_from(name: str, dataset: str) -> Callable[[Path], None]:
    def draw(pixels: Path) -> None:
        pixels.unlink()
        layout = h5py.VirtualLayout((6, 4, 5), "u2")
        layout[:] = h5py.VirtualSource(pixels.with_name(name), dataset, (6, 4, 5))
        with h5py.File(pixels, "w") as file:
            file.create_virtual_dataset("data", layout)

    return draw


GONE, ITSELF = _drawn_from("gone.h5", "data"), _drawn_from("f.nxs", "entry1/tomo_entry/instrument/detector/data")


@pytest.mark.parametrize("lose", [Path.unlink, _renamed, _shorter, GONE, ITSELF])
def test_virtual_frames_that_cannot_be_read_are_no_zeros(tmp_path: Path, lose: Callable[[Path], None]) -> None:
    path = foreign(tmp_path / "f.nxs")
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "pixels.h5", "w") as pixels:
        detector = file["entry1/tomo_entry/instrument/detector"]
        pixels["data"] = detector["data"][()]
        del detector["data"]
        virtual = h5py.VirtualLayout((6, 4, 5), "u2")
        virtual[:] = h5py.VirtualSource(pixels["data"])
        detector.create_virtual_dataset("data", virtual)
    with open_scan(path) as source:
        assert source.read([5])[0, -1, -1] == 119
    lose(tmp_path / "pixels.h5")
    with refused(DataError):
        open_scan(path)


@pytest.mark.parametrize(
    "tiles",
    [
        [np.s_[:, :2], np.s_[:, 2:]],
        [np.s_[:, :, :3], np.s_[:, :, 3:]],
        [np.s_[::2], np.s_[1::2]],
        [np.s_[:, :2, :2], np.s_[:, 2:, :2], np.s_[:, :, 2:]],
    ],
    ids=["rows", "columns", "every second frame", "tiles"],
)
def test_virtual_frames_join_the_tiles_of_a_detector(tmp_path: Path, tiles: list[tuple[slice, ...]]) -> None:
    path = foreign(tmp_path / "f.nxs")
    with h5py.File(path, "r+") as file:
        detector = file["entry1/tomo_entry/instrument/detector"]
        pixels = detector["data"][()]
        del detector["data"]
        layout = h5py.VirtualLayout(pixels.shape, pixels.dtype)
        for n, tile in enumerate(tiles):
            with h5py.File(tmp_path / f"tile{n}.h5", "w") as part:
                part["data"] = pixels[tile]
            layout[tile] = h5py.VirtualSource(f"tile{n}.h5", "data", pixels[tile].shape)
        detector.create_virtual_dataset("data", layout)
    with open_scan(path) as source:
        np.testing.assert_array_equal(source.read(slice(None)), pixels)
    with h5py.File(tmp_path / "tile1.h5", "r+") as part:  # the writer died, or its disk was full
        shorter = part["data"][:-1]
        del part["data"]
        part["data"] = shorter
    with refused(DataError):
        open_scan(path)


def test_a_file_that_is_not_there_yet_can_be_waited_for(tmp_path: Path) -> None:
    with refused(NotReadyError):
        open_scan(tmp_path / "soon.h5", follow=True)
    (tmp_path / "soon.h5").write_bytes(b"")
    with refused(NotReadyError):
        open_scan(tmp_path / "soon.h5", follow=True)


def test_diamond_nexus_with_external_links(shared_data: Path) -> None:
    with open_scan(shared_data / "fixtures" / "diad_k11-18014.nxs") as source:
        assert (source.format, source.shape, source.quantity) == ("diamond_nexus", (22, 26), "counts")
        assert np.bincount(source.table.kinds).tolist() == [3001, 100, 100]
        assert np.isnan(source.table.angles).all()  # they are in a file that did not come with it
        assert "gts_theta_value_set" in str(source.attributes["angles"])
        with h5py.File(shared_data / "fixtures" / "k11-18014" / "k11-18014-imaging.h5") as pixels:
            np.testing.assert_array_equal(source.read([0, 3200]), pixels["entry/detector/detector"][[0, 3200]])
    angles = np.linspace(0, np.pi, 3001)
    with open_scan(SourceOptions(shared_data / "fixtures" / "diad_k11-18014.nxs", angles=angles)) as source:
        np.testing.assert_array_equal(source.table.angles[source.table.kinds == 0], angles)


def test_esrf_nxtomo(shared_data: Path) -> None:
    with open_scan(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx") as source:
        assert source.format == "nxtomo"
        assert [source.table.of_kind(kind).size for kind in (0, 1, 2, -1)] == [11, 2, 2, 5]
        assert (source.pixel_size_mm, source.energy_kev) == (pytest.approx(6.69e-4), 26.0)
        assert source.axis_col is None  # 0.0 in the file, which counts from the middle
        np.testing.assert_allclose(np.degrees(source.table.angles[4:15]), np.linspace(0, 360, 11), atol=1e-6)


@pytest.mark.parametrize(("dtype", "said"), [("S3", "text"), ("c8", "complex numbers")])
@pytest.mark.parametrize(
    "where", ["instrument/detector/data", "instrument/detector/image_key", "sample/rotation_angle"]
)
def test_what_is_no_real_number_is_refused(path: Path, where: str, dtype: str, said: str) -> None:
    with h5py.File(path, "r+") as file:
        shape, attributes = file["entry"][where].shape, dict(file["entry"][where].attrs)
        del file["entry"][where]
        file["entry"][where] = np.zeros(shape, dtype)
        file["entry"][where].attrs.update(attributes)
    with pytest.raises(
        DataError, match=rf"^/entry/{where} in .* contains {said}; expected integers or real numbers\.$"
    ):
        open_scan(path)
