"""Zeiss .txrm: files written here as two public readers document them, and a real one."""

from __future__ import annotations

import builtins
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from beamline.core.errors import ConfigError, DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe
from beamline.projections.corrections.poses import PosesOfFile
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.selection import Selection
from beamline.storage.pose_table import read_poses
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import FrameKind
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import BEAM, TwoCylinders
from tests.beamline.storage.compound import write_compound
from tests.messages import refused

olefile = pytest.importorskip("olefile")
SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 1.5)), shape=(4, 40), pixel_size_mm=0.0065)
VIEWS = SCAN.counts() - np.uint16(100)  # the instrument has subtracted its dark


def streams(views: np.ndarray = VIEWS, **changes: Any) -> dict[str, bytes]:
    """The streams of SCAN; a change of None leaves one out."""
    n, rows, cols = views.shape
    whole: dict[str, Any] = {
        "Version": np.float32(5.0),
        "ImageInfo/ImageWidth": np.int32(cols),
        "ImageInfo/ImageHeight": np.int32(rows),
        "ImageInfo/NoOfImages": np.int32(n),
        "ImageInfo/ImagesTaken": np.uint32(n),
        "ImageInfo/DataType": np.int32(5 if views.dtype == np.uint16 else 10),
        "ImageInfo/Angles": np.degrees(SCAN.angles[:n]).astype("<f4"),
        "ImageInfo/ExpTimes": np.full(n, 0.5, "<f4"),
        "ImageInfo/PixelSize": np.float32(6.5),
        "ImageInfo/MosiacColumns": np.int32(0),
        "ImageInfo/MosiacRows": np.int32(0),
        "ReferenceData/DataType": np.int32(10),
        "ReferenceData/ImageInfo/ImageWidth": np.int32(cols),
        "ReferenceData/ImageInfo/ImageHeight": np.int32(rows),
        "ReferenceData/ImageInfo/ExpTimes": np.float32(0.5),
        "ReferenceData/Image": np.full((rows, cols), BEAM, "<f4"),
        **{f"ImageData{i // 100 + 1}/Image{i + 1}": view for i, view in enumerate(views)},
        **{name.replace("__", "/"): value for name, value in changes.items()},
    }
    return {name: np.asarray(value).tobytes() for name, value in whole.items() if value is not None}


def test_the_library_reads_what_the_writer_wrote(tmp_path: Path) -> None:
    """Of the compound file: small streams, large ones, and none."""
    content: Mapping[str, bytes] = {"a/b/c": b"x" * 70, "a/d": b"y" * 9000, "e": b"", "f": b"z" * 4096, "a/g": b"w"}
    with olefile.OleFileIO(write_compound(tmp_path / "c.ole", content), raise_defects=olefile.DEFECT_UNSURE) as file:
        assert {"/".join(name) for name in file.listdir()} == set(content)
        for name, data in content.items():
            assert file.openstream(name).read() == data
        assert file.parsing_issues == []


@pytest.mark.parametrize("dtype", ["<u2", "<f4"])
def test_a_dark_of_zeros_then_the_reference_then_views(tmp_path: Path, dtype: str) -> None:
    views = VIEWS.astype(dtype)
    with open_scan(write_compound(tmp_path / "s.txrm", streams(views))) as source:
        assert (source.format, source.quantity, source.finished) == ("txrm", "counts", True)
        assert source.table.kinds.tolist() == [2, 1, *[0] * 120]
        assert source.pixel_size_mm == pytest.approx(0.0065)
        assert source.cone is None
        np.testing.assert_array_equal(source.read(slice(2, None)), views)
        np.testing.assert_array_equal(source.read([121, 102, 1, 0], slice(1, 3))[:2], views[[119, 100], 1:3])
        np.testing.assert_array_equal(source.read([0, 1])[:, 0, 0], [0, BEAM])
        np.testing.assert_allclose(source.table.angles[2:], SCAN.angles, atol=1e-6)
        assert source.table.exposures[1:].tolist() == [0.5] * 121


def test_line_integrals_are_those_of_the_scan(tmp_path: Path) -> None:
    """A reference of another exposure is scaled to the views'."""
    longer: dict[str, Any] = {"ReferenceData__Image": np.full(SCAN.shape, 2 * BEAM, "<f4")}
    longer["ReferenceData__ImageInfo__ExpTimes"] = np.float32(1)
    found, told = prepare(write_compound(tmp_path / "s.txrm", streams(**longer)), Selection(axis_col=SCAN.axis_col))
    np.testing.assert_allclose(found.seen.data, SCAN.line_integrals(), atol=2e-3)
    assert found.geometry.pixel_pitch == pytest.approx(0.0065) and told == []


def test_a_cone_states_its_pixel_at_the_sample(tmp_path: Path) -> None:
    cone: dict[str, Any] = {"ImageInfo__XrayGeometry": np.int32(1), "ImageInfo__StoRADistance": np.float32(-20)}
    cone["ImageInfo__DtoRADistance"] = np.float32(60)
    with open_scan(write_compound(tmp_path / "s.txrm", streams(**cone))) as source:
        assert source.cone == (20.0, 80.0)
        assert source.pixel_size_mm == pytest.approx(4 * 0.0065)
    with open_scan(write_compound(tmp_path / "p.txrm", streams(**{**cone, "ImageInfo__XrayGeometry": None}))) as source:
        assert source.cone is None
        assert source.pixel_size_mm == pytest.approx(0.0065)


def test_what_a_file_lacks_is_not_guessed(tmp_path: Path) -> None:
    none: dict[str, Any] = dict.fromkeys(
        ("ReferenceData__Image", "ReferenceData__DataType", "ImageInfo__PixelSize", "ImageInfo__ExpTimes")
    )
    path = write_compound(tmp_path / "s.txrm", streams(**none, ImageInfo__ImagesTaken=np.uint32(30)))
    with open_scan(path) as source:
        assert (source.quantity, source.pixel_size_mm) == ("unknown", None)
        assert source.table.kinds.tolist() == [FrameKind.PROJECTION] * 30
        assert source.ending == ScanEnding("stopped", reason="30 of 120 planned projections were taken.")
        assert np.isnan(source.table.exposures).all()
    assert describe(path)["format"] == "txrm"
    lost = write_compound(tmp_path / "a.txrm", streams(ImageInfo__Angles=None))
    with refused(DataError):
        open_scan(lost)
    with open_scan(SourceOptions(lost, angles=SCAN.angles)) as source:
        np.testing.assert_array_equal(source.table.angles[2:], SCAN.angles)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ImageInfo__DataType": np.int32(7)}, "4 x 40 pixels of type 7; expected type 5"),
        ({"ImageInfo__ImageHeight": np.int32(0)}, r"s\.txrm is damaged: it states images of 0 x 40 pixels\."),
        ({"ImageInfo__ImageWidth": np.int32(2**30)}, "damaged: it states images of 4 x 1073741824 pixels"),
        ({"ImageInfo__ImageWidth": None}, "the stream ImageInfo/ImageWidth is missing"),
        ({"ImageInfo__ImageWidth": np.int32(41)}, "damaged or has an unexpected structure"),
        ({"ImageInfo__NoOfImages": np.int32(0)}, "contains no projections"),
        ({"ImageInfo__NoOfImages": np.int32(2**31 - 1), "ImageInfo__ImagesTaken": None}, "2147483647 images of 4 x 40"),
        ({"ImageInfo__AcquisitionMode": np.int32(2)}, "a volume"),
        ({"ImageInfo__MosiacRows": np.int32(2)}, "is a mosaic"),
        ({"Alignment__Y-Shifts": np.full(120, np.nan, "<f4")}, "120 shifts of projections are not numbers"),
        ({"ReferenceData__Image": b"1234"}, "damaged or has an unexpected structure"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as refused:
        open_scan(write_compound(tmp_path / "s.txrm", streams(**changes)))
    assert "\n" not in str(refused.value)


def test_shifts_that_bring_views_back_are_poses_unless_they_are_ignored(tmp_path: Path) -> None:
    back = np.linspace(-3, 1, 120).astype("<f4")
    path = write_compound(tmp_path / "s.txrm", streams(**{"Alignment__X-Shifts": back}))
    selection = Selection(axis_col=SCAN.axis_col)
    displaced, said = prepare(path, replace(selection, axis_col=SCAN.axis_col - 2), cols=(2, 38))
    np.testing.assert_allclose(displaced.geometry.shifts, np.stack([-back, 0 * back], axis=1))
    assert "120 poses" in said[0] and "4 px (columns)" in said[0]
    with open_scan(SourceOptions(path, flats=VIEWS[:1])) as source:
        np.testing.assert_allclose(np.asarray(source.table.shifts), [[np.nan] * 2] * 3 + [[-each, 0] for each in back])
    ignored, said = prepare(path, selection.with_steps(PosesOfFile(read_poses("ignore"))))
    assert not ignored.geometry.shifts.any() and said == []
    with refused(ConfigError):
        prepare(path, selection.with_steps(TiltAndLens(1.0)))
    with refused(DataError):
        ingest(path, tmp_path / "copy.h5")
    with open_scan(write_compound(tmp_path / "z.txrm", streams(**{"Alignment__X-Shifts": 0 * back}))) as source:
        assert source.table.shifts is None


REAL = Path(__file__).parents[6] / "shared" / "data" / "fixtures" / "tomopy_chip_tomo.txrm"


@pytest.mark.skipif(not REAL.is_file(), reason="the real .txrm is not here")
def test_views_of_a_real_file_are_displaced_as_it_says() -> None:
    """The sign: each view against the one before, by phase correlation; what is left is the turn of the sample."""
    with open_scan(REAL) as source:
        stated, views = source.table.shifts, np.log(source.read(slice(None)))
        assert (source.quantity, source.cone, len(views)) == ("unknown", None, 7)
    window = np.outer(np.hanning(256), np.hanning(256))
    spectra = np.fft.fft2((gaussian_filter(views, (0, 2, 2)) - gaussian_filter(views, (0, 12, 12))) * window)
    peaks = np.fft.fftshift(np.fft.ifft2(spectra[1:] * spectra[:-1].conj()).real, axes=(1, 2))[:, 118:139, 98:159]
    found = np.array([np.unravel_index(peak.argmax(), peak.shape) for peak in zoom(peaks, (1, 10, 10), order=3)])[
        :, ::-1
    ]
    assert stated is not None
    across, down = (np.corrcoef(found[:, i], np.diff(stated[:, i]))[0, 1] for i in (0, 1))
    assert across > 0.8
    assert down > 0.5


def test_a_missing_view_and_a_cut_file_are_told(tmp_path: Path) -> None:
    with (
        open_scan(write_compound(tmp_path / "s.txrm", streams(ImageData1__Image5=None))) as source,
        refused(DataError),
    ):
        source.read(slice(None))
    whole = (tmp_path / "s.txrm").read_bytes()
    for size in (8, 400, 3000):
        (tmp_path / "cut.txrm").write_bytes(whole[:size])
        with refused(DataError):
            open_scan(tmp_path / "cut.txrm")


def test_without_the_library_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, real = write_compound(tmp_path / "s.txrm", streams()), builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "olefile":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with refused(DataError):
        open_scan(path)
