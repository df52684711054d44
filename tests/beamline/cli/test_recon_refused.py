"""`beamline recon` stops with an error because of the disk or of its own files; refusals.txt has the other cases."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.beamline.cli.small_scan import beamline, left, succeeds

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_disk_that_is_too_small_is_told_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(NamedTuple):
        free: int

    monkeypatch.setattr("beamline.reconstruct.options.shutil.disk_usage", lambda _: Full(2 * 40 * 40 * 4 - 1))
    result = beamline("recon", "scan.h5", "-m", "fbp")
    assert result.exit_code == 5
    assert "the volume needs 12.8 kB, but the disk of scan_fbp.h5 has 12.8 kB free" in result.stderr
    assert "slices" not in result.stderr  # no work was begun
    assert left(folder) == {"scan.h5"}


@pytest.mark.skipif(sys.platform == "win32", reason="has no folder that nobody can write to")
def test_a_folder_that_cannot_be_written_to_is_told_before_the_scan_is_read(folder: Path) -> None:
    result = beamline("recon", "scan.h5", "-m", "fbp", "-o", "/proc/out.h5")
    assert result.exit_code == 5
    assert "/proc cannot be written to" in result.stderr and "Nothing was read" in result.stderr


@pytest.mark.slow
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


def test_a_volume_to_reconstruct_is_named_with_its_method(folder: Path) -> None:
    succeeds("recon", "scan.h5", "-m", "fbp", "-o", "volume.h5", "--no-report")
    result = beamline("recon", "volume.h5")
    assert result.exit_code == 5
    assert "is a volume made by fbp, not a scan" in " ".join(result.stderr.split()) and "beamline view" in result.stderr
