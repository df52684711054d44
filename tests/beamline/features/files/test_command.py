"""`beamline info`, `validate` and `ingest`: output, exit codes and files."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.monitor.digest import digest
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, frames_of, seal, write_exchange, write_flagged
from tests.recon.prep.rims import views_of_can

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 10.0)), shape=(4, 40), pixel_size_mm=0.5)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_exchange(folder / "exchange.h5", SCAN)
    info = ScanInfo(sample="two cylinders", pixel_size_mm=0.5, energy_kev=25.0)
    with NXtomoWriter(folder / "scan.h5", info, SCAN.shape, clock=SystemClock()) as writer:
        for frame in frames_of(SCAN):
            writer.append(frame, digest(frame.counts))
    return folder


@pytest.fixture
def folder(written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a good scan in it, as NXtomo and as Data Exchange."""
    monkeypatch.chdir(tmp_path)
    for name in ("exchange.h5", "scan.h5"):
        shutil.copyfile(written / name, tmp_path / name)
    return tmp_path


def test_info_for_people(folder: Path) -> None:
    result = beamline("info", "scan.h5")
    assert result.exit_code == 0, result.output
    said = dict(line.split(maxsplit=1) for line in result.stdout.splitlines())
    assert said["format"] == "nxtomo"
    assert said["kinds"] == "18 projection, 2 flat, 2 dark"
    assert said["shape"] == "4 x 40"
    assert said["last_angle_deg"] == "170"
    assert said["axis_col"] == "not known"
    assert said["reconstructable"] == "yes"
    assert said["sample"] == "two cylinders"


def test_info_for_machines(folder: Path) -> None:
    result = beamline("info", "exchange.h5", "--json")
    (line,) = result.stdout.splitlines()
    said = json.loads(line)
    assert (said["event"], said["quantity"], said["pixel_size_mm"]) == ("done", "counts", 0.5)
    assert said["kinds"] == {"projection": 18, "flat": 2, "dark": 2}


def test_info_takes_what_the_caller_says(folder: Path) -> None:
    with h5py.File("exchange.h5", "r+") as file:
        del file["exchange/data_white"], file["exchange/data_dark"]
    assert "quantity" in beamline("info", "exchange.h5").stdout
    result = beamline("info", "exchange.h5", "--quantity", "line-integrals")
    assert "line_integrals" in result.stdout


@pytest.mark.parametrize("square", [0.0, 0.8])
def test_info_tells_of_fringes(folder: Path, square: float) -> None:
    views, geometry = views_of_can(square, noise=1e-3)
    frames = {"data_dark": np.full((2, 8, 80), 100.0), "data_white": np.full((2, 8, 80), 40_100.0)}
    frames["data"] = 100 + 40_000 * np.exp(-views)
    with h5py.File("can.h5", "w") as file:
        file["implements"] = "exchange"
        file["exchange/theta"] = np.degrees(geometry.angles)
        for name, counts in frames.items():
            file[f"exchange/{name}"] = counts.round().astype(np.uint16)
    assert ("phase fringes" in beamline("info", "can.h5").stdout) == bool(square)


def test_validate_names_each_fault(folder: Path) -> None:
    with h5py.File("scan.h5", "r+") as file:
        file["entry/sample/rotation_angle"][7] = np.nan
        seal(file)
    result = beamline("validate", "scan.h5")
    assert result.exit_code == 5
    assert "error    angles" in result.stdout
    assert "beamline: scan.h5 has 1 error" in result.stderr
    events = [json.loads(line) for line in beamline("validate", "scan.h5", "--json").stdout.splitlines()]
    assert [event["event"] for event in events][-1] == "done"
    assert events[-1]["error"] == 1
    assert events[0]["rule"] == "angles"


def _stack(folder: Path) -> Path:
    data = SCAN.line_integrals().astype(np.float32)
    data[3, 0, :] = -1.0
    tifffile.imwrite(folder / "in.tif", data, photometric="minisblack")
    np.savetxt(folder / "angles.txt", np.degrees(SCAN.angles))
    return folder / "in.tif"


def test_ingest_makes_a_scan_of_a_stack(folder: Path) -> None:
    _stack(folder)
    options = ("--angles", "angles.txt", "--quantity", "line-integrals", "--pixel-size-um", "500", "--no-data", "-1")
    result = beamline("ingest", "in.tif", "out.h5", *options, "--sample", "cylinders", "--energy-kev", "25")
    assert result.exit_code == 0, result.output
    assert "out.h5" in result.stdout
    assert "18 (0 of them without a valid pixel)" in result.stdout
    with open_scan("out.h5") as source:
        assert source.quantity == "line_integrals"
        assert (source.pixel_size_mm, source.energy_kev, source.attributes["sample"]) == (0.5, 25.0, "cylinders")
        np.testing.assert_allclose(source.table.angles, SCAN.angles)
        np.testing.assert_array_equal(source.read([0, 17]), SCAN.line_integrals().astype(np.float32)[[0, 17]])


def test_ingest_says_how_far_it_is(folder: Path) -> None:
    _stack(folder)
    options = ("--angles", "angles.txt", "--quantity", "line-integrals")
    events = [json.loads(line) for line in beamline("ingest", "in.tif", "a.h5", *options, "--json").stdout.splitlines()]
    progress = [event for event in events if event["event"] == "progress"]
    assert (progress[-1]["n"], progress[-1]["of"], progress[-1]["eta_s"]) == (18, 18, 0.0)
    result = beamline("ingest", "in.tif", "b.h5", *options)
    assert "frames: 18/18" in result.stderr
    assert "18/18" not in result.stdout


def test_sigterm_leaves_no_part_of_an_ingest(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    _stack(folder)
    monkeypatch.setattr("beamline.features.files.ingest.digest", interrupted)
    before = {path.name for path in folder.iterdir()}
    result = beamline("ingest", "in.tif", "out.h5", "--angles", "angles.txt")
    assert result.exit_code == 130
    assert {path.name for path in folder.iterdir()} == before


def test_validate_deep_names_damaged_frames(folder: Path) -> None:
    good = beamline("validate", "scan.h5", "--deep")
    assert (good.exit_code, good.stdout.splitlines()) == (0, ["scan.h5: 0 errors, 0 warnings"])
    with h5py.File("scan.h5", "r+") as file:
        file["entry/instrument/detector/data"][9, 1, 1] ^= 1
    result = beamline("validate", "scan.h5", "--deep")
    assert result.exit_code == 5
    assert (
        "error    checksums       1 of 22 frames are damaged" in result.stdout
        and ": 9. Look for an intact copy" in result.stdout
    )
    events = [json.loads(line) for line in beamline("validate", "scan.h5", "--deep", "--json").stdout.splitlines()]
    assert events[0]["stage"] == "validate" and {event["event"] for event in events} == {"progress", "flag", "done"}


def test_info_prints_and_draws_statistics_of_a_raw_scan(tmp_path: Path) -> None:
    scan = write_flagged(tmp_path / "scan.h5", frames_of(TwoCylinders()), {})
    result = beamline("info", scan, "--statistics", "-o", tmp_path / "h.png")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()] == ["kind", "dark", "flat", "projection", "output"]
    assert (tmp_path / "h.png").read_bytes().startswith(b"\x89PNG")
