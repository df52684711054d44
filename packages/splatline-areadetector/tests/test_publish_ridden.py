"""`beamline ride` records a scan that `beamline publish` serves: both files hold the same frames, to the bit."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
BEAMLINE = (sys.executable, "-m", "beamline.cli.main")
VIEWS = 16


@contextmanager
def _beamline(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [*BEAMLINE, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def _until_line(process: subprocess.Popen[str], words: str) -> str:
    """What a program has said until a line with these words."""
    assert process.stdout is not None
    said = ""
    while words not in said:
        line = process.stdout.readline()
        assert line, said
        said += line
    return said


def test_our_scan_ridden_by_ours_is_equal_to_the_bit(loopback: dict[str, str], tmp_path: Path) -> None:
    ride = {
        "image": "pva://T:SPL:Pva1:Image", "kinds": "Kind", "period_s": 0.1,
        "angles": {"from": "attribute", "views": VIEWS, "name": "Angle"},
        "darks": {"count": 4, "at": "start"}, "flats": {"count": 4, "at": "both"},
    }  # fmt: skip
    config = {"sample": {"name": "s"}, "ride": ride, "optics": {"pixel_size_um": 1}}
    (tmp_path / "my.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    (tmp_path / "runs").mkdir()
    scan = (
        "scan", "configs/simulated.yaml", "--no-live", "-o", tmp_path / "runs", "--set", "scan.mode=step",
        "--set", f"scan.angles.views={VIEWS}", "--set", "scan.angles.span_deg=16",
        "--set", "scan.darks.count=4", "--set", "scan.flats.count=4",
    )  # fmt: skip
    with ExitStack() as stack:
        server = stack.enter_context(_beamline("publish", tmp_path / "runs", "--prefix", "T:SPL:"))
        _until_line(server, "Ctrl-C ends the publishing")
        rider = stack.enter_context(_beamline("ride", tmp_path / "my.yaml", "--no-live", "-o", tmp_path / "rides"))
        said = _until_line(rider, "Waiting for the first frame")
        own = stack.enter_context(_beamline(*scan))
        assert own.communicate(timeout=300)[0] is not None and own.returncode == 0
        said += rider.communicate(timeout=120)[0]
        assert rider.returncode == 0, said
    (ours,), (theirs,) = ((tmp_path / name).glob("*/scan.h5") for name in ("runs", "rides"))
    with h5py.File(ours) as one, h5py.File(theirs) as other:
        for path in (
            "instrument/detector/data",
            "frame_log/kind",
            "frame_log/trigger",
            "instrument/detector/count_time",
        ):
            np.testing.assert_array_equal(other[f"entry/{path}"][:], one[f"entry/{path}"][:], err_msg=path)
        assert len(one["entry/frame_log/kind"]) == VIEWS + 12
        views = one["entry/frame_log/kind"][:] == 0
        degrees = [file["entry/sample/rotation_angle"][:][views] for file in (one, other)]
        np.testing.assert_allclose(degrees[1], degrees[0], rtol=0, atol=1e-13)
        assert other["entry/progress/status"][()] == b"complete"
