#!/usr/bin/env python3
# SBATCH --job-name=splatline
# SBATCH --cpus-per-task=8
# SBATCH --mem=32G
# SBATCH --time=04:00:00
# SBATCH --signal=B:TERM@120
"""Reconstruct many scans on a Slurm cluster: this job runs `beamline batch`, and its workers are jobs of their own.

    sbatch docs/install/batch_slurm.py RECIPE DAY SCAN.h5 ...

RECIPE is a recipe of `beamline batch` with a line `memory: SIZE`. If a volume needs more memory, the workers make it
in slabs. DAY is the folder for the results. Two minutes before the time limit Slurm sends TERM, and the batch ends
cleanly (exit code 4). Submit the same line again to reconstruct the scans that are left.

Needs splatline-cluster and dask-jobqueue. Partition, account and lines for the jobs of the workers are in the
configuration of dask-jobqueue. The resources of this job are in the lines above.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType

from dask_jobqueue import SLURMCluster

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
INTERRUPTED = 130  # exit code if the job ends before the batch has begun
QUEUE_CHECK_S = 60  # s between two looks whether the jobs of the workers are in the queue


def main() -> int:
    """Exit code of `beamline batch`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("day", type=Path)
    parser.add_argument("scans", nargs="+")
    parser.add_argument("--workers", type=int, default=4, help="jobs that reconstruct slabs. Default: %(default)s.")
    parser.add_argument("--cpus", type=int, default=8, help="cores of a worker. Default: %(default)s.")
    parser.add_argument("--memory", default="32GB", help="memory of a worker. Default: %(default)s.")
    parser.add_argument("--walltime", default="04:00:00", help="time limit of a worker. Default: %(default)s.")
    parser.add_argument("--port", type=int, default=8786, help="port of dask's scheduler. Default: %(default)s.")
    given = parser.parse_args()
    child: subprocess.Popen[bytes] | None = None

    def pass_on(number: int, frame: FrameType | None) -> None:
        if child is None:
            sys.exit(INTERRUPTED)
        child.send_signal(number)

    for number in STOPS:
        signal.signal(number, pass_on)
    with tempfile.TemporaryDirectory() as folder:
        # The address is the same in every job, so that `beamline batch` continues a folder of an earlier job.
        recipe = Path(folder, "recipe.yaml")
        own = given.recipe.read_text(encoding="utf-8").rstrip()
        recipe.write_text(f"{own}\ncluster: tcp://localhost:{given.port}\n", encoding="utf-8")
        with SLURMCluster(
            cores=1, processes=1, job_cpu=given.cpus, memory=given.memory, walltime=given.walltime,
            scheduler_options={"port": given.port, "dashboard": False},
        ) as jobs:  # fmt: skip
            jobs.scale(jobs=given.workers)
            wait_for_worker(jobs)
            command = [sys.executable, "-m", "beamline.cli.main", "batch", *given.scans]
            # In a session of its own, so that a signal reaches it once, through this process.
            child = subprocess.Popen(
                [*command, "--config", str(recipe), "-o", str(given.day)], start_new_session=True,
                env={**os.environ, "PYTHONSAFEPATH": "1"},
            )  # fmt: skip
            return child.wait()


def wait_for_worker(jobs: SLURMCluster) -> None:
    """Return when the first worker runs, which is when Slurm has started its job."""
    while True:
        try:
            return jobs.wait_for_workers(1, timeout=QUEUE_CHECK_S)
        except TimeoutError:
            if not any(job.job_id for job in jobs.workers.values()):
                sys.exit(
                    "Check partition and account in the configuration of dask-jobqueue: sbatch accepted no worker."
                )


if __name__ == "__main__":
    sys.exit(main())
