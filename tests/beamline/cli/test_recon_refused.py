"""`beamline recon` refuses: one sentence, an exit code, and nothing left behind."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.beamline.cli.small_scan import SCAN, beamline, left
from tests.beamline.scans import BEAM, DARK, write_exchange

pytestmark = pytest.mark.usefixtures("one_thread")

N = SCAN.angles.size
_VIEWS = (N, 2, 40)
_BLACK = np.where(np.arange(N)[:, None, None] % 5 < 3, DARK, SCAN.counts()).astype(np.uint16)
CASES: dict[str, tuple[dict[str, Any], list[str], int, str]] = {
    "no flats": ({"data_white": None}, ["--quantity", "counts"], 5, "flats"),
    "no darks": ({"data_dark": None}, ["--quantity", "counts"], 5, "darks"),
    "unknown quantity": ({"data_white": None, "data_dark": None}, [], 5, "--quantity"),
    "wrong shape": ({"data_white": np.full((2, 2, 30), 9000, np.uint16)}, [], 5, "shape"),
    "two dimensions": ({"data": np.zeros((2, 40), np.uint16)}, [], 5, "shape"),
    "angles missing": ({"theta": None}, [], 5, "theta"),
    "too few angles": ({"theta": np.zeros(4)}, [], 5, "4 angles"),
    "NaN angles": ({"theta": np.full(N, np.nan)}, [], 5, "--angles"),
    "all NaN": ({"data": np.full(_VIEWS, np.nan, np.float32)}, [], 5, "NaN"),
    "one view": ({"data": np.full((1, 2, 40), 9000, np.uint16), "theta": np.zeros(1)}, [], 5, "at least 2"),
    "no beam": ({"data_white": np.full((2, 2, 40), DARK, np.uint16)}, [], 5, "no beam"),
    "black views": ({"data": _BLACK}, ["--axis", "20"], 5, "without light"),
    "empty field": ({"data": np.full(_VIEWS, DARK + BEAM, np.uint16)}, [], 5, "scan.h5"),
    "one view chosen": ({}, ["--views", "fixed:1"], 2, "at least 2"),
    "a gain of logarithms": ({}, ["--noise", "log", "--gain", "2"], 2, "--noise log"),
    "flats without noise": ({}, ["--noise", "counts"], 2, "--gain COUNTS"),
    "views misspelt": ({}, ["--views", "every:third"], 2, "every:third"),
    "too many views": ({}, ["--views", "fixed:31"], 2, "30"),
    "rows outside": ({}, ["--rows", "1:3"], 2, "0:2"),
    "bins too large": ({}, ["--bin", "3"], 2, "--bin 3"),
    "axis outside": ({}, ["--axis", "99"], 2, "outside"),
    "axis misspelt": ({}, ["--axis", "middle"], 2, "auto"),
    "air misspelt": ({}, ["--air", "some"], 2, "LEFT,RIGHT"),
    "air too wide": ({}, ["--air", "30,30"], 5, "40 columns"),
    "budget misspelt": ({}, ["--budget", "soon"], 2, "such as 30s"),
    "quality misspelt": ({}, ["--quality", "superb"], 2, "preview"),
    "truth missing": ({}, ["--truth", "truth.npz"], 2, "truth.npz"),
    "truth of another shape": ({}, ["--truth", "scan.npy"], 2, "shape"),
    "of the other method": ({}, ["--gaussians", "5"], 2, "r2"),
    "a setting without a value": ({}, ["-m", "r2", "--set", "fit.decay"], 2, "expected NAME=VALUE"),
    "a setting that there is not": ({}, ["-m", "r2", "--set", "fit.magic=1"], 2, "'fit.magic' is unknown; legal:"),
    "a setting out of range": ({}, ["-m", "r2", "--set", "fit.decay=-1"], 2, "decay must be a number above 0"),
    "iterations of fbp": (
        {},
        ["--iterations", "5"],
        2,
        "--iterations is of fista-tv, os-sirt-tv, pnp-dct",
    ),
    "several axes": ({}, ["--axis", "try:18:21:1"], 2, "drawn by beamline sweep FILE axis=18:21:1"),
    "smoothing of sirt": ({}, ["-m", "sirt", "--tv-weight", "0.1"], 2, "fista-tv, os-sirt-tv"),
    "loss misspelt": ({}, ["-m", "r2", "--loss", "l3"], 2, "l3"),
    "no such device": ({}, ["-m", "r2", "--device", "abacus"], 2, "--device abacus"),
    "no checkpoint": ({}, ["-m", "r2", "--resume", "none.h5"], 5, "none.h5 does not exist"),
    "not a checkpoint": ({}, ["-m", "r2", "--resume", "scan.npy"], 5, "not a readable checkpoint"),
    "the scan as checkpoint": ({}, ["-m", "r2", "--checkpoint", "scan.h5"], 2, "FILE and --checkpoint are the same"),
    "the scan as output": ({}, ["-o", "scan.h5"], 2, "FILE and --output are the same"),
    "output as checkpoint": ({}, ["-m", "r2", "-o", "a.h5", "--checkpoint", "./a.h5"], 2, "--output and --checkpoint"),
    "a lost checkpoint": ({}, ["-m", "r2", "-o", "a.h5", "--resume", "a.h5"], 5, "--resume a.h5 does not exist"),
    "endless smoothing": ({}, ["-m", "fista-tv", "--tv-weight", "inf"], 2, "finite"),
    "a pixel of an atom": ({}, ["--pixel-size-um", "1e-300"], 2, "expected 1e-06 to 1e+06 um"),
    "a seed below zero": ({}, ["--seed", "-1"], 2, "--seed"),
    "no file": ({}, ["-o", "."], 2, "is not the name of a volume"),
    "a page": ({}, ["-o", "out.html"], 2, "'.html' is not known, expected .h5"),
    "a file for a folder": ({}, ["-o", "scan.npy"], 5, "never overwritten"),
    "method misspelt": ({}, ["--method", "r3"], 2, "r3"),
    "folder missing": ({}, ["-o", "no/out.h5"], 5, "does not exist"),
}

SEEN_IN_FRAMES = {"black views", "flats without noise", "air too wide"}
"""Cases that a dry run does not see, which reads no frame."""


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_sentence_a_code_and_no_output(folder: Path, case: str) -> None:
    changes, options, code, said = CASES[case]
    (folder / "scan.h5").unlink()
    write_exchange(folder / "scan.h5", SCAN, changes)
    np.save(folder / "scan.npy", np.arange(8.0).reshape(2, 2, 2))
    before = left(folder)
    # A budget and a preset are of the fit, whose settings they choose.
    chosen = [] if {"--budget", "--quality"} & set(options) else ["-m", "fbp"]
    result = beamline("recon", "scan.h5", *chosen, *options)
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert len([line for line in result.stderr.splitlines() if line.startswith(("beamline:", "Error:"))]) == 1
    if case not in SEEN_IN_FRAMES:
        planned = beamline("recon", "scan.h5", *chosen, *options, "--dry-run")
        assert (planned.exit_code, said in planned.stderr) == (code, True), planned.output
    assert left(folder) == before


def test_a_disk_that_is_too_small_is_told_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(NamedTuple):
        free: int

    monkeypatch.setattr("beamline.reconstruct.options.shutil.disk_usage", lambda _: Full(2 * 40 * 40 * 4 - 1))
    result = beamline("recon", "scan.h5", "-m", "fbp")
    assert result.exit_code == 5
    assert "The volume takes 12.8 kB, the disk of scan_fbp.h5 has 12.8 kB free" in result.stderr
    assert "slices" not in result.stderr  # no work was begun
    assert left(folder) == {"scan.h5"}


@pytest.mark.skipif(sys.platform == "win32", reason="has no folder that nobody can write to")
def test_a_folder_that_cannot_be_written_to_is_told_before_the_scan_is_read(folder: Path) -> None:
    result = beamline("recon", "scan.h5", "-m", "fbp", "-o", "/proc/out.h5")
    assert result.exit_code == 5
    assert "/proc cannot be written to" in result.stderr and "Nothing was read" in result.stderr


@pytest.mark.parametrize("name", ["missing.h5", "text.h5", "empty.h5", "half.h5", "folder"])
def test_files_that_cannot_be_read(folder: Path, name: str) -> None:
    (folder / "text.h5").write_text("no scan")
    (folder / "empty.h5").write_bytes(b"")
    (folder / "half.h5").write_bytes((folder / "scan.h5").read_bytes()[:3000])
    (folder / "folder").mkdir()
    before = left(folder)
    result = beamline("recon", name)
    assert result.exit_code == 5, result.output
    assert name in result.stderr
    assert result.stderr.startswith("beamline: ")
    assert left(folder) == before


def test_as_a_process(folder: Path) -> None:
    """The same through the operating system: exit code, streams, and no traceback."""
    root = Path(__file__).parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-m", "beamline.cli.main", "recon", "scan.h5", "--views", "fixed:1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("beamline: --views fixed:1")
    assert "Traceback" not in done.stderr
    assert left(folder) == {"scan.h5"}


@pytest.mark.parametrize("options", [[], ["--dry-run"]])
def test_a_source_within_the_field_is_refused_by_a_dry_run_too(folder: Path, options: list[str]) -> None:
    write_exchange(folder / "scan.h5", SCAN)
    cone = ["--cone", "0.01:0.02", "--pixel-size-um", "10", "--axis", "20", "--angles", "whole.txt"]
    (folder / "whole.txt").write_text("\n".join(str(angle) for angle in np.linspace(0, 360, N, endpoint=False)))
    result = beamline("recon", "scan.h5", "-m", "sirt", *cone, *options)
    assert result.exit_code == 5, result.output
    assert "cannot be reconstructed by sirt: the box reaches" in " ".join(result.stderr.split())
    assert left(folder) == {"scan.h5", "whole.txt"}
