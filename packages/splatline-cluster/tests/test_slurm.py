"""docs/install/batch_slurm.py reconstructs a batch with workers that a stand-in of Slurm starts."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.beamline.scans import TwoCylinders, write_exchange
from tests.free_ports import free_ports

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="Slurm is for POSIX"),
]

SCRIPT = Path(__file__).parents[3] / "docs" / "install" / "batch_slurm.py"

SBATCH = """#!/bin/sh
# Starts the job at once, in a group of its own, whose number is that of the job.
setsid sh "$1" > "$JOBS/worker.log" 2>&1 &
echo $! >> "$JOBS/submitted"
cat "$1" >> "$JOBS/scripts"
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
for job in "$@"; do kill -TERM -"$job"; echo "$job" >> "$JOBS/cancelled"; done
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """With an sbatch and an scancel that need no Slurm; a configuration of dask-jobqueue that is empty."""
    pytest.importorskip("dask_jobqueue")
    commands = tmp_path / "bin"
    commands.mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (commands / name).write_text(text, encoding="utf-8")
        (commands / name).chmod(0o755)
    path = os.pathsep.join((str(commands), os.environ["PATH"]))
    return {**os.environ, "PATH": path, "JOBS": str(tmp_path), "DASK_CONFIG": str(tmp_path / "dask")}


def command(*more: str) -> list[str]:
    words = ["recipe.yaml", "DAY", "a.h5", "b.h5", "--cpus", "1", "--memory", "1GB", *more]
    return [sys.executable, str(SCRIPT), *words, "--port", str(*free_ports(1))]


def running(job: str) -> bool:
    try:
        os.killpg(int(job), 0)
    except ProcessLookupError:
        return False
    return True


def test_a_batch_is_made_in_slabs_by_workers_of_slurm(environment: dict[str, str], tmp_path: Path) -> None:
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(96, 32), axis_col=15.7)
    for name in ("a.h5", "b.h5"):
        write_exchange(tmp_path / name, scan, {"data": scan.counts().astype(np.uint16)})
    recipe = "method: fista-tv\niterations: 2\ntv-weight: 0.002\nmemory: 4.1M"  # without a line end
    (tmp_path / "recipe.yaml").write_text(recipe, encoding="utf-8")
    done = subprocess.run(
        command("--workers", "2"),
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    worker = (tmp_path / "worker.log").read_text(encoding="utf-8")
    assert done.returncode == 0, done.stderr[-4000:] + worker[-2000:]
    assert "96 of 96 slices are done" in done.stderr
    with (tmp_path / "DAY" / "batch.csv").open(encoding="utf-8-sig", newline="") as file:
        assert [(row["name"], row["state"]) for row in csv.DictReader(file)] == [("a", "done"), ("b", "done")]
    assert (tmp_path / "DAY" / "a" / "recon.h5").is_file()
    jobs = (tmp_path / "submitted").read_text().split()
    assert len(jobs) == 2 and sorted((tmp_path / "cancelled").read_text().split()) == sorted(jobs)
    lines = (tmp_path / "scripts").read_text(encoding="utf-8")
    assert "#SBATCH --cpus-per-task=1" in lines and "#SBATCH -t 04:00:00" in lines and sys.executable in lines
    deadline = time.monotonic() + 30
    while any(map(running, jobs)):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_job_that_slurm_ends_in_the_queue_leaves_no_worker(environment: dict[str, str], tmp_path: Path) -> None:
    """With an sbatch that accepts a job and does not start it."""
    (tmp_path / "bin" / "sbatch").write_text('#!/bin/sh\ntouch "$JOBS/asked"\necho "Submitted batch job 1"\n', "utf-8")
    (tmp_path / "bin" / "scancel").write_text('#!/bin/sh\necho "$@" >> "$JOBS/cancelled"\n', "utf-8")
    (tmp_path / "recipe.yaml").write_text("memory: 1G\n", encoding="utf-8")
    waiting = subprocess.Popen(command("--workers", "1"), cwd=tmp_path, env=environment, stderr=subprocess.PIPE)
    with waiting:
        deadline = time.monotonic() + 60
        while not (tmp_path / "asked").exists():
            assert time.monotonic() < deadline and waiting.poll() is None
            time.sleep(0.1)
        time.sleep(1)  # until the answer of sbatch has been read
        waiting.send_signal(signal.SIGTERM)
        _, said = waiting.communicate(timeout=60)
    assert waiting.returncode == 130, said.decode()[-3000:]
    assert (tmp_path / "cancelled").read_text().split() == ["1"] and not (tmp_path / "DAY").exists()
