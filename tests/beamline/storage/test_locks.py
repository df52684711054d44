"""File systems without locks, and files open in another program: cause and remedy, no partial file."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from beamline.config.load import config_folder
from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.writer_lock import WITHOUT
from tests import faulty_disk
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import SMALL, Ran

pytestmark = faulty_disk.needed
SHIM = """
#include <errno.h>
#include <stdlib.h>
int flock(int file, int operation) { errno = atoi(getenv("FLOCK_FAILS")); return -1; }
"""
MISSING = [errno.ENOLCK, pytest.param(errno.EOPNOTSUPP, marks=pytest.mark.long)]


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shim")
    (folder / "shim.c").write_text(SHIM)
    made = folder / "shim.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", made, folder / "shim.c"], check=True, timeout=120)
    return made


def without_locks(shim: Path, number: int, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command of beamline where every lock fails."""
    known = os.environ | {"LD_PRELOAD": str(shim), "FLOCK_FAILS": str(number)} | environment
    command = [sys.executable, "-m", "beamline.cli.main", *words]
    return subprocess.run(command, env=known, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ran = Ran(tmp_path_factory.mktemp("runs"), FakeInstrument())
    assert ran.result is not None
    return ran.result.path


def config_of(folder: Path) -> list[str]:
    words = [
        *SMALL,
        "scan.mode=step",
        f"storage.folder={folder}",
        "simulation.clock=virtual",
        "devices.camera.roi=[1136, 2028, 32, 40]",
    ]
    return [str(config_folder() / "simulated.yaml"), *(part for word in words for part in ("--set", word))]


@pytest.mark.slow
@pytest.mark.parametrize("number", MISSING)
def test_a_scan_there_is_refused_by_check_and_by_itself_before_anything_is_made(
    shim: Path, number: int, tmp_path: Path
) -> None:
    for command in ("check", "scan"):
        done = without_locks(shim, number, command, *config_of(tmp_path))
        said = " ".join((done.stdout + done.stderr).split())
        assert done.returncode != 0, said
        assert "has no file locks" in said and WITHOUT in said and "NFS" in said
        assert list(tmp_path.iterdir()) == []
    done = without_locks(shim, number, "check", *config_of(tmp_path), HDF5_USE_FILE_LOCKING="FALSE")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_with_the_switch_a_scan_there_is_taken(shim: Path, tmp_path: Path) -> None:
    done = without_locks(shim, errno.ENOLCK, "scan", *config_of(tmp_path), HDF5_USE_FILE_LOCKING="FALSE")
    assert done.returncode == 0, done.stdout + done.stderr
    (run,) = tmp_path.iterdir()
    with h5py.File(run / "scan.h5") as file:
        assert file["entry/progress/status"][()] == b"complete"


def test_a_file_that_another_program_has_open_to_write(tmp_path: Path) -> None:
    path = tmp_path / "theirs.h5"
    code = (
        "import sys, h5py; file = h5py.File(sys.argv[1], 'w'); file['a'] = 1; file.flush(); "
        "print('ready', flush=True); "
        "sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline().strip() == "ready"
        with pytest.raises(DataError, match=f"open for writing.*{WITHOUT}"):
            hdf5.open_hdf5(path)
        other.communicate("")
    with hdf5.open_hdf5(path) as file:
        assert file["a"][()] == 1


ALL = """
import os, sys
from pathlib import Path
from beamline.config.load import load
from beamline.core.errors import DataError
from beamline.scan.dry_run import dry_run
from beamline.features.files.validate import describe
from beamline.storage.writers.layout import ScanInfo
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.clock import SystemClock
folder, finished, template = map(Path, sys.argv[1:4])
config = load(template, ["scan.mode=step"], {})
for number in ("37", "95"):
    os.environ["FLOCK_FAILS"] = number
    assert "has no file locks (errno " + number in dry_run(config, folder).timeline.violations[-1]
    try:
        NXtomoWriter(folder / "scan.h5", ScanInfo(sample="s"), (8, 12), clock=SystemClock())
    except DataError as error:
        print(error)
    assert not (folder / "scan.h5").exists()
    assert describe(finished)["kinds"]["projection"] == 12
os.environ["FLOCK_FAILS"] = "11"
assert not dry_run(config, folder).timeline.violations
try:
    describe(finished)
except DataError as error:
    print(error)
"""


@pytest.mark.slow
def test_all_of_it_in_one_process(shim: Path, finished: Path, tmp_path: Path) -> None:
    known = os.environ | {"LD_PRELOAD": str(shim), "FLOCK_FAILS": "37"}
    words = [str(tmp_path), str(finished), str(config_folder() / "simulated.yaml")]
    done = subprocess.run([sys.executable, "-c", ALL, *words], env=known, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    first, second, third = done.stdout.splitlines()
    assert "has no file locks (errno 37)" in first and "(errno 95)" in second and WITHOUT in first
    assert "is open for writing in another program" in third and WITHOUT in third
    assert list(tmp_path.iterdir()) == []
