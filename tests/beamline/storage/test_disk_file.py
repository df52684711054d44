"""A disk that fails at a write or contains something else: an OSError, whatever HDF5 reports, and no partial file."""

from __future__ import annotations

import errno
import sys
from io import FileIO
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest

from beamline.core.errors import DataError
from beamline.storage import disk_file, hdf5
from beamline.storage.writers.recon_file import Checkpoint, read_checkpoint, write_checkpoint

FACTS = 12
CUBE = np.arange(6 * 16 * 16, dtype=np.float32).reshape(6, 16, 16)


class Failing(FileIO):
    """A disk on which one write, and what follows it where `goes_on`, raises `error`; writes count from 1."""

    n, at, goes_on = 0, 0, False
    error: BaseException = OSError(errno.EIO, "broken")

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        Failing.n += 1
        if Failing.n == Failing.at or (Failing.goes_on and Failing.n > Failing.at):
            raise Failing.error
        return super().write(data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> type[Failing]:
    monkeypatch.setattr(disk_file, "FileIO", Failing)
    for name in ("n", "at", "goes_on", "error"):
        monkeypatch.setattr(Failing, name, getattr(Failing, name))
    return Failing


def write(path: Path) -> None:
    """Chunks that are written when their dataset goes, compressed ones, small datasets, attributes."""
    with hdf5.created(path) as file:
        file.create_dataset("entry/volume", CUBE.shape, np.float32, chunks=(1, 16, 16))[...] = CUBE
        file.create_dataset("entry/packed", data=CUBE, chunks=(1, 16, 16), compression="gzip")
        for n in range(FACTS):
            file[f"facts/{n}"] = np.arange(n)
            file[f"facts/{n}"].attrs["units"] = "mm"


def is_whole(path: Path) -> bool:
    with h5py.File(path) as file:
        facts = all(np.array_equal(file[f"facts/{n}"], np.arange(n)) for n in range(FACTS))
        return facts and all(np.array_equal(file[f"entry/{name}"], CUBE) for name in ("volume", "packed"))


def test_every_single_write_that_fails_is_told(
    tmp_path: Path, disk: type[Failing], capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "whole.h5")
    assert is_whole(tmp_path / "whole.h5")
    writes, descriptors = disk.n, psutil.Process().num_fds() if sys.platform != "win32" else 0
    assert writes > 40
    for at in range(1, writes + 1):
        disk.n, disk.at, disk.error, path = 0, at, OSError(errno.EIO, "broken"), tmp_path / f"{at}.h5"
        with pytest.raises(OSError, match="broken") as error:
            write(path)
        assert (error.value.errno, error.value.filename) == (errno.EIO, str(path))
    assert capsys.readouterr().err == ""
    if descriptors:  # a file that stays open keeps its space
        assert psutil.Process().num_fds() == descriptors


def test_ctrl_c_within_a_write_is_passed_on(tmp_path: Path, disk: type[Failing]) -> None:
    disk.at, disk.error = 9, KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out.h5")


def test_a_disk_that_takes_no_more_is_seen_while_much_is_written(tmp_path: Path, disk: type[Failing]) -> None:
    disk.at, disk.goes_on, disk.error = 30, True, OSError(errno.ENOSPC, "full")
    with pytest.raises(OSError, match="full"), hdf5.created(tmp_path / "out.h5") as file:
        data = file.create_dataset("data", (10_000, 64, 64), np.float32, chunks=(1, 64, 64))
        for n in range(10_000):
            data[n] = 1
            file.require_taken()
    assert disk.n < 300


def test_a_snapshot_that_fails_leaves_the_older_file(tmp_path: Path, disk: type[Failing]) -> None:
    path = tmp_path / "fit.h5"
    write_checkpoint(path, Checkpoint({"x": CUBE}, {"seed": 1}, 5))
    disk.n, disk.at = 0, 4
    with pytest.raises(DataError, match=r"fit.h5.*existing file was not changed"):
        write_checkpoint(path, Checkpoint({"x": CUBE + 1}, {"seed": 1}, 6))
    assert read_checkpoint(path).steps == 5 and list(tmp_path.iterdir()) == [path]
