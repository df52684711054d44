"""kill -9 of a scan during its live reconstruction: the reconstruction ends, and the run has one complete volume."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from beamline.config.load import config_folder
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers.recon_file import read_reconstruction

BEAMLINE = (sys.executable, "-m", "beamline.cli.main")
VIEWS, WITHIN = 90, 240.0  # s, on a busy machine that compiles
SCAN = (
    "simulation.clock=real",
    f"scan.angles.views={VIEWS}",
    "scan.period_s=0.1",
    "scan.angles.start_deg=2",  # the run-up ends at a limit of the stage
    "scan.darks.count=2",
    "scan.flats.count=2",
    "scan.flats.at=start",
    "devices.camera.roi=[1080,1968,16,160]",
    "optics.axis_col=82.1",  # the sample is wider than the field: its axis would be found at the end of the turn
    "recon.live=true",
    "recon.seconds=1",
)


def _killed(runs: Path, at: str) -> tuple[Path, psutil.Process]:
    """The folder of a scan that was killed at the first event of this kind, and its live reconstruction."""
    words = [word for each in SCAN for word in ("--set", each)]
    command = [*BEAMLINE, "scan", str(config_folder() / "simulated.yaml"), *words, "--json", "-o", str(runs)]
    child: psutil.Process | None = None
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as scan:
        assert scan.stdout is not None
        for line in scan.stdout:
            if json.loads(line)["event"] == at:
                (child,) = psutil.Process(scan.pid).children()
                break
        scan.kill()
    assert child is not None
    return next(runs.iterdir()), child


def _ended(process: psutil.Process) -> bool:
    """Whether it ends; the process that adopted it may not have collected it."""
    deadline = time.monotonic() + WITHIN
    while time.monotonic() < deadline:
        if not process.is_running() or process.status() == psutil.STATUS_ZOMBIE:
            return True
        time.sleep(0.1)
    return False


def _events(*words: Any) -> list[dict[str, Any]]:
    done = subprocess.run([*BEAMLINE, *map(str, words), "--json"], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_killed_scan_takes_its_live_reconstruction_with_it_and_the_resumed_run_has_one_whole_volume(
    tmp_path: Path,
) -> None:
    run, live = _killed(tmp_path, at="snapshot")
    assert _ended(live)
    assert "has died" in (run / "recon.log").read_text()
    assert not (run / "recon.h5").exists() and not (run / "report.html").exists()
    for file in run.rglob("*"):
        os.utime(file, (time.time() - 2 * QUIET,) * 2)
    _events("scan", "--resume", run)
    assert [path.relative_to(run) for path in run.rglob("recon.h5")] == [Path("recon.h5")]
    assert [path.relative_to(run) for path in run.rglob("report.html")] == [Path("report.html")]
    assert not [*run.rglob("recon.snapshot.h5"), *run.rglob(".*.partial")]
    record = read_reconstruction(run / "recon.h5")
    assert record.parameters["n_views"] == VIEWS
    assert _events("runs", tmp_path)[-1]["runs"][0]["state"] == "done"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_follower_of_its_own_ends_when_its_scan_is_killed_before_anybody_recovers_the_file(tmp_path: Path) -> None:
    slower = "scan.period_s=0.2"  # this scan does not wait until its follower is ready
    words = [word for each in (*SCAN, slower, "recon.live=false") for word in ("--set", each)]
    command = [*BEAMLINE, "scan", str(config_folder() / "simulated.yaml"), *words, "--json", "-o", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as scan:
        assert scan.stdout is not None
        file = Path(json.loads(next(line for line in scan.stdout if '"run_started"' in line[:40]))["path"])
        follow = [*BEAMLINE, "recon", str(file), "--follow", "--json", "-o", str(tmp_path / "own.h5")]
        with subprocess.Popen(follow, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as follower:
            assert follower.stdout is not None
            for line in follower.stdout:
                if json.loads(line)["event"] == "recon_started":
                    scan.kill()
            assert follower.wait(WITHIN) == 5
            assert follower.stderr is not None
            assert "is no longer being written" in (said := follower.stderr.read()) and "scan --resume" in said
    assert not (tmp_path / "own.h5").exists()
