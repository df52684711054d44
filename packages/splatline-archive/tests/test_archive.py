"""archive: the same file but for its size, or nothing."""

from __future__ import annotations

import json
import shutil
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.monitor.digest import digest
from beamline.storage.parts import join
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from splatline_archive import archive as module
from splatline_archive.archive import archive
from splatline_archive.command import CODECS
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 10.0)), shape=(64, 40))
PLAN = {"angles_deg": [0.0] * SCAN.angles.size, **{kind: {"count": 2, "at": "start"} for kind in ("darks", "flats")}}


def written(path: Path, frames: list[Frame] | None = None) -> Path:
    info = ScanInfo("two cylinders", pixel_size_mm=0.5, plan=json.dumps(PLAN), devices={"stage": {"model": "PM16C"}})
    with NXtomoWriter(path, info, SCAN.shape, clock=SystemClock()) as writer:
        for i, frame in enumerate(frames_of(SCAN) if frames is None else frames):
            writer.append(Frame(**{**vars(frame), "index": i}), digest(frame.counts))
    return path


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    return written(tmp_path / "scan.h5")


def content(path: Path) -> dict[str, Any]:
    """Everything that a program finds in a file, under every name that it has there."""
    found: dict[str, Any] = {}

    def look(name: str, item: h5py.HLObject) -> None:
        values = (np.asarray(item[()]).tolist(), str(item.dtype)) if isinstance(item, h5py.Dataset) else None
        found[name] = str(values), {key: np.asarray(value).tolist() for key, value in item.attrs.items()}

    with h5py.File(path) as file:
        look("/", file["/"])
        names: list[str] = []
        file.visit_links(names.append)
        for name in names:
            look(name, file[name])
    return found


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("codec", CODECS)
def test_all_but_the_size_is_as_in_the_raw_file(scan: Path, tmp_path: Path, codec: str) -> None:
    seen: list[tuple[int, int]] = []
    done = archive(scan, tmp_path / "small.h5", codec, progress=lambda n, total: seen.append((n, total)))
    assert content(done.path) == content(scan)
    assert (done.frames, done.sources, done.raw_bytes) == (22, (scan,), scan.stat().st_size)
    assert done.bytes == done.path.stat().st_size < scan.stat().st_size
    assert seen[-1] == (1, 1)  # MB
    assert [finding for finding in validate(done.path, lambda n, total: None) if finding.severity == "error"] == []
    with h5py.File(done.path) as file:
        frames = file[layout.DATA]
        assert (frames.chunks, len(frames._filters)) == ((1, *SCAN.shape), 1)
        assert file["/entry/data/data"] == frames  # the same dataset, not a second one
        assert frames.id.get_storage_size() < 0.7 * frames.nbytes
    assert left(tmp_path) == {"scan.h5", "small.h5"}


def test_scans_of_other_programs(tmp_path: Path) -> None:
    raw = write_exchange(tmp_path / "exchange.h5", SCAN)
    with h5py.File(raw, "r+") as file:
        file["soft"] = h5py.SoftLink("/exchange/theta")
        file["exchange/again"] = file["exchange"]  # a group within itself
        file["nothing"] = h5py.Empty("f8")
        file.attrs["fixed"] = np.bytes_(b"text of fixed length")
        file.attrs["of none"] = h5py.Empty("f4")
        file.create_dataset("no images", (0, 64, 64), "u2")
        file.create_dataset("lists", data=np.array([np.arange(3), np.arange(2)], object), dtype=h5py.vlen_dtype("i4"))
        file["not a number"] = np.array([(1.0, b"a"), (np.nan, b"b")], [("value", "f8"), ("name", "S1")])
    done = archive(raw, tmp_path / "small.h5")
    with open_scan(raw) as one, open_scan(done.path) as other:
        np.testing.assert_array_equal(one.read(slice(None)), other.read(slice(None)))
        np.testing.assert_array_equal(one.angles, other.angles)
    with h5py.File(done.path) as file:
        assert isinstance(file.get("soft", getlink=True), h5py.SoftLink)
        assert file["exchange/again"] == file["exchange"]
        assert file["nothing"].shape is None
        assert file.attrs.get_id("fixed").dtype == "S20"
        assert isinstance(file.attrs["of none"], h5py.Empty)


def _external(file: h5py.File) -> None:
    name = Path(file.filename).with_name("beam.raw")
    np.arange(4.0).tofile(name)
    file.create_dataset("beam", (4,), "f8", external=[(name.name, 0, 32)])


def _reference(file: h5py.File) -> None:
    file["exchange"].attrs["first"] = file["exchange/theta"].ref


def _scale(file: h5py.File) -> None:
    file["exchange/theta"].make_scale("angle")
    file["exchange/data"].dims[0].attach_scale(file["exchange/theta"])


@pytest.mark.parametrize(
    ("make", "said"),
    [(_external, "beam has its values in beam.raw"), (_reference, "/exchange holds"), (_scale, "references")],
)
def test_what_a_copy_would_not_hold_is_refused(tmp_path: Path, make: Callable[[h5py.File], None], said: str) -> None:
    raw = write_exchange(tmp_path / "exchange.h5", SCAN)
    with h5py.File(raw, "r+") as file:
        make(file)
    with pytest.raises(DataError, match=said):
        archive(raw, tmp_path / "small.h5")
    assert not (tmp_path / "small.h5").exists()


def test_a_joined_scan_becomes_one_file(tmp_path: Path) -> None:
    frames = frames_of(SCAN)
    parts = [written(tmp_path / "one.h5", frames[:9]), written(tmp_path / "two.h5", frames[9:])]
    joined = tmp_path / "joined.h5"
    join(parts, joined)
    done = archive(joined, tmp_path / "small.h5")
    assert done.sources == (joined, *parts)
    assert done.raw_bytes == sum(path.stat().st_size for path in (joined, *parts))
    expected = content(joined)
    for part in parts:
        part.unlink()
    joined.unlink()
    assert content(done.path) == expected
    with h5py.File(done.path) as file:
        assert not file[layout.DATA].is_virtual


def test_a_damaged_frame_is_as_damaged_in_the_copy(scan: Path, tmp_path: Path) -> None:
    with h5py.File(scan, "r+") as file:
        file[layout.DATA][3, 5, 6] ^= 64
    done = archive(scan, tmp_path / "small.h5")
    errors = [finding for finding in validate(done.path, lambda n, total: None) if finding.severity == "error"]
    assert [finding.rule for finding in errors] == ["checksums"]


def _pixel(file: h5py.File) -> None:
    file[layout.DATA][4] = file[layout.DATA][4] + 1


def _angle(file: h5py.File) -> None:
    file[layout.ANGLE][4] = file[layout.ANGLE][4] + 1


def _unit(file: h5py.File) -> None:
    file[layout.ANGLE].attrs["units"] = "rad"


def _root(file: h5py.File) -> None:
    file["/"].attrs["default"] = "other"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_pixel, "image 4 of /entry/data/data"),
        (_angle, "entry/data/rotation_angle"),
        (_unit, "entry/data/rotation_angle"),
        (_root, "/"),
    ],
)
def test_what_a_disk_does_not_give_back_is_found(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[h5py.File], None], said: str
) -> None:
    def spoilt(partial: Path) -> None:
        with h5py.File(partial, "r+") as file:
            spoil(file)

    monkeypatch.setattr(module, "drop_from_cache", spoilt)
    with pytest.raises(DataError, match=f"{said} differs"):
        archive(scan, tmp_path / "small.h5")
    assert left(tmp_path) == {"scan.h5"}


def test_what_is_there_is_not_overwritten(scan: Path, tmp_path: Path) -> None:
    before = scan.read_bytes()
    for out in (scan, shutil.copy(scan, tmp_path / "other.h5")):
        with pytest.raises(DataError, match="exists"):
            archive(scan, out)
    assert scan.read_bytes() == before


def test_a_scan_that_is_being_written_is_refused(tmp_path: Path) -> None:
    with NXtomoWriter(tmp_path / "scan.h5", ScanInfo("sample"), SCAN.shape, clock=SystemClock()) as writer:
        for frame in frames_of(SCAN)[:3]:
            writer.append(frame, digest(frame.counts))
        with pytest.raises(DataError, match="is being written"):
            archive(tmp_path / "scan.h5", tmp_path / "small.h5")
    assert left(tmp_path) == {"scan.h5"}


def test_frames_behind_a_link_to_another_file_are_refused(tmp_path: Path) -> None:
    raw = write_exchange(tmp_path / "raw.h5", SCAN)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["exchange"] = h5py.ExternalLink(raw.name, "/exchange")
        file["implements"] = "exchange"
    with pytest.raises(DataError, match=r"draws /exchange from raw\.h5"):
        archive(tmp_path / "scan.h5", tmp_path / "small.h5")


def test_other_files_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "lab.tif", SCAN.counts(), photometric="minisblack")
    with pytest.raises(DataError, match=r"lab\.tif.*ingest"):
        archive(tmp_path / "lab.tif", tmp_path / "small.h5")
    with pytest.raises(DataError, match=r"none\.h5"):
        archive(tmp_path / "none.h5", tmp_path / "small.h5")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_end_before_its_time_leaves_nothing(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    stored, calls = zlib.crc32, iter(range(100))

    def fails_at_the_ninth(image: np.ndarray) -> int:
        if next(calls) == 8:
            raise error
        return stored(image)

    monkeypatch.setattr(module.zlib, "crc32", fails_at_the_ninth)
    with pytest.raises((KeyboardInterrupt, DataError)):
        archive(scan, tmp_path / "small.h5")
    assert left(tmp_path) == {"scan.h5"}


def test_the_memory_is_that_of_a_few_frames(tmp_path: Path) -> None:
    """Of 30 at most three, of 524 kB: two are held, beside about 140 kB of objects that do not grow with a frame."""
    raw, frame = tmp_path / "scan.h5", 512 * 512 * 2
    with h5py.File(raw, "w") as file:
        file["exchange/data"] = np.random.default_rng(1).integers(0, 400, (30, 512, 512)).astype(np.uint16)
        file["exchange/theta"] = np.linspace(0, 180, 30)
        file["exchange/theta"].attrs["units"] = "deg"
    archive(raw, tmp_path / "first.h5")  # which imports what it needs
    tracemalloc.start()
    archive(raw, tmp_path / "small.h5")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * frame


def test_the_command_says_what_was_verified(scan: Path, tmp_path: Path) -> None:
    words = ("archive", scan, "-o", tmp_path / "small.h5", "--codec", "bitshuffle-lz4")
    ended = beamline(*words)
    assert ended.exit_code == 0, ended.output
    lines = dict(line.split(maxsplit=1) for line in ended.stdout.splitlines())
    ratio = scan.stat().st_size / (tmp_path / "small.h5").stat().st_size
    assert lines["size"].endswith(f"ratio {ratio:.2f}") and lines["verified"] == f"22 frames, each as in {scan}"
    (tmp_path / "small.h5").unlink()
    *_, progress, done = [json.loads(line) for line in beamline(*words, "--json").stdout.splitlines()]
    assert (progress["event"], progress["stage"]) == ("progress", "archive")
    assert (done["event"], done["frames"], done["sources"]) == ("done", 22, [str(scan)])
