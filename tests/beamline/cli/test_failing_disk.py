"""If the disk fails at any write, an output is either correct, or absent with exit code 5, for all kinds of output."""

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import write_reconstruction
from recon.base.volume import Grid, Volume
from tests import faulty_disk
from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

Run = dict[str, Any]

pytestmark = [faulty_disk.needed, pytest.mark.slow, pytest.mark.timeout(900)]

FILES = {  # what each command writes
    "export volume.npy -o out/o.h5": {"o.h5"},
    "export volume.h5 -o out/o.tif": {"o.tif"},
    "export volume.h5 -o out/o": {"o"},
    "export volume.h5 -o out/o.npy": {"o.npy"},
    "export volume.h5 -o out/o.nrrd": {"o.nrrd"},
    "export volume.h5 -o out/o.zarr": {"o.zarr"},
    "ingest scan.h5 out/o.h5": {"o.h5"},
}
RESULTS = {
    "recon scan.h5 -m fbp -o out/o.h5": {"o.h5", "o.html"},
}
FOLDERS = {  # of results, which keep those of the trials that were done: so many
    "tradeoff scan.h5 --methods fbp,sirt -o out/o": 5,
    "study fixed-views views.h5 -m fbp -m sirt -o out/o": 2,
}
FORKS = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_THREADING_LAYER": "workqueue"}  # it outlives a fork
POINTS = 3  # writes of each fault; there are up to 315


@pytest.fixture
def inputs(tmp_path: Path, rng: np.random.Generator) -> Path:
    data = rng.normal(0, 0.05, (20, 24, 28)).astype(np.float32)
    z, y, x = np.indices(data.shape)
    for centre in ((6, 8, 8), (13, 15, 19)):
        data[(z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 < 20] += 1
    record = ReconRecord(
        volume=Volume(data, Grid(data.shape, 0.01)),
        length_unit="mm",
        raw_file="scan.h5",
        title="t",
        sample="s",
        time=0.0,
        parameters={"method": "fbp"},
    )
    write_reconstruction(tmp_path / "volume.h5", record)
    np.save(tmp_path / "volume.npy", data)
    os.utime(tmp_path / "volume.npy", (0, 0))
    write_exchange(tmp_path / "scan.h5", SCAN)
    write_exchange(tmp_path / "views.h5", replace(SCAN, angles=np.radians(np.arange(0, 180, 3.0))))
    return tmp_path


def _swept(inputs: Path, commands: Iterable[str], watched: str = "/out/") -> list[tuple[Run, list[Run]]]:
    """Of each command the run without a fault, and those with one."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.beamline.cli.disk_sweep", inputs, str(POINTS), *commands],
        env=os.environ | faulty_disk.environment(watched) | FORKS,
        cwd=Path(__file__).parents[3], capture_output=True, text=True, timeout=800, check=True,
    )  # fmt: skip
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    swept = []
    for command in commands:
        clean, *runs = [line for line in lines if line["command"] == command]
        assert clean["code"] == 0 and len(runs) >= 3 * POINTS, clean
        for run in runs:
            assert "Traceback" not in run["stderr"] and "ignored" not in run["stderr"], run
        swept.append((clean, runs))
    return swept


@pytest.mark.parametrize("commands", [FILES, RESULTS], ids=["files", "results"])
def test_an_output_is_right_or_absent(inputs: Path, commands: dict[str, set[str]]) -> None:
    for (clean, runs), outputs in zip(_swept(inputs, commands), commands.values(), strict=True):
        assert set(clean["outputs"]) == outputs, clean
        for run in runs:
            right = run["outputs"] == clean["outputs"]
            if run["fault"] == "kill":  # of several outputs some may be there, and these are right
                assert run["code"] == -9 and run["outputs"].items() <= clean["outputs"].items(), run
                continue
            said = [line for line in run["stderr"].splitlines() if line.startswith("beamline: ")]
            assert (run["code"], len(said)) in ((0, 0), (5, 1)) and run["hidden"] == 0, run
            assert right if run["code"] == 0 else not run["outputs"], run


@pytest.mark.long
def test_a_folder_of_results_holds_whole_files_and_the_trials_done(inputs: Path) -> None:
    for (clean, runs), trials in zip(_swept(inputs, FOLDERS), FOLDERS.values(), strict=True):
        assert set(clean["outputs"]) == {"o"}
        for run in runs:
            assert not run["cut"], run
            if run["fault"] == "kill":
                assert run["code"] == -9, run
                continue
            said = [line for line in run["stderr"].splitlines() if line.startswith("beamline: ")]
            assert (run["code"], len(said), run["hidden"]) == (5, 1, 0) and "could not be written" in said[0], run
            assert run["outputs"] or f"1/{trials} " not in run["stderr"], run
