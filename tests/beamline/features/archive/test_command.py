"""`beamline archive`: what it prints, and that the archive serves as the raw file does."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.storage.writers import layout
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 12.0)), shape=(48, 48), pixel_size_mm=0.5)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a scan of ours in it."""
    monkeypatch.chdir(tmp_path)
    write_flagged(tmp_path / "scan.h5", frames_of(SCAN), {}, pixel_size_mm=0.5)
    return tmp_path


def test_an_archive_serves_as_the_raw_file_does(folder: Path) -> None:
    result = beamline("archive", "scan.h5", "-o", "small.h5")
    assert result.exit_code == 0, result.output
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines())
    ratio = (folder / "scan.h5").stat().st_size / (folder / "small.h5").stat().st_size
    assert lines["size"].endswith(f"ratio {ratio:.2f}")
    assert lines["speed"].endswith("MB/s, written and compared")
    assert lines["verified"] == "19 frames, each as in scan.h5"
    assert result.stdout.splitlines()[-1] == "the raw file may be deleted: scan.h5"
    assert (folder / "scan.h5").exists()
    for command in (("info",), ("validate", "--deep")):
        raw, small = (beamline(*command, name) for name in ("scan.h5", "small.h5"))
        assert small.exit_code == raw.exit_code == 0
        same = raw.stdout.replace("scan.h5", "small.h5").splitlines()
        assert [line for line in small.stdout.splitlines() if line not in same and "bytes" not in line] == []
    volumes = []
    for name in ("scan", "small"):
        assert beamline("recon", f"{name}.h5", "-m", "fbp", "--axis", "24", "-o", f"{name}.npy").exit_code == 0
        volumes.append(np.load(folder / f"{name}.npy"))
    np.testing.assert_array_equal(*volumes)


def test_its_facts_for_machines(folder: Path) -> None:
    result = beamline("archive", "scan.h5", "-o", "small.h5", "--codec", "bitshuffle-lz4", "--json")
    *_, progress, done = [json.loads(line) for line in result.stdout.splitlines()]
    assert (progress["event"], progress["stage"]) == ("progress", "archive")
    assert (done["event"], done["frames"], done["codec"], done["damaged"]) == ("done", 19, "bitshuffle-lz4", [])
    assert done["sources"] == ["scan.h5"]
    assert done["ratio"] == pytest.approx((folder / "scan.h5").stat().st_size / done["bytes"])


def test_damaged_frames_end_it_or_are_said(folder: Path) -> None:
    with h5py.File("scan.h5", "r+") as file:
        file[layout.DATA][6, 1, 2] ^= 1
    result = beamline("archive", "scan.h5", "-o", "small.h5")
    assert (result.exit_code, left(folder)) == (5, {"scan.h5"})
    assert "1 frame of scan.h5 differs from what was written" in result.stderr
    result = beamline("archive", "scan.h5", "-o", "small.h5", "--keep-damaged")
    assert result.exit_code == 0
    assert "damaged  1 frame of scan.h5, kept unchanged: 6" in result.stdout
    assert "19 frames, each as in scan.h5, also its 1 damaged frame\n" in result.stdout


def test_all_files_that_it_draws_from_are_named(folder: Path) -> None:
    counts = SCAN.counts()
    (folder / "part-2").mkdir()
    drawn = h5py.VirtualLayout(counts.shape, counts.dtype)
    for name, rows in (("scan.h5", slice(0, 7)), ("part-2/scan.h5", slice(7, None))):
        with h5py.File(name, "w") as file:
            drawn[rows] = h5py.VirtualSource(file.create_dataset("images", data=counts[rows]))
    with h5py.File("joined.h5", "w") as file:
        file.create_virtual_dataset("exchange/data", drawn)
        file["exchange/theta"] = np.degrees(SCAN.angles)
    result = beamline("archive", "joined.h5", "-o", "small.h5")
    assert result.exit_code == 0, result.output
    *_, last = result.stdout.splitlines()
    also = f"where nothing but its frames is wanted of them, also scan.h5, {Path('part-2/scan.h5')}"
    assert last == f"the raw file may be deleted: joined.h5; {also}"
