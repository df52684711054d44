"""A disk that fails at the n-th write: runs a program with a small preloaded library (Linux; needs `cc`).

It counts the calls that change files whose path contains a given text (write, pwrite, writev, fwrite, sendfile,
copy_file_range, ftruncate, posix_fallocate, fsync, msync, rename, unlink), in the program and in its child processes.
Writes through a memory map are not counted, except msync. Writes are counted from 1.

    n = faulty_disk.writes([python, "-c", code], "scan.h5")
    done = faulty_disk.run([python, "-c", code], "scan.h5", kill_at=n - 3)          # the write does not happen
    done = faulty_disk.run(command, "scan.h5", fail_from=7, errno=errno.EIO)        # nor any after it
    done = faulty_disk.run(command, "scan.h5", fail_at=7, torn=True)                # half of it does, as on a full disk
"""

import errno as errors
import functools
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

_SOURCE = Path(__file__).with_name("faulty_disk.c")

needed = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shutil.which("cc") is None,
    reason="a disk that fails needs Linux and a C compiler (cc)",
)
"""Marker for the tests that use this module."""


@functools.cache
def library() -> Path:
    """The library, compiled once per process."""
    folder = Path(tempfile.mkdtemp(prefix="faulty_disk_"))
    made = folder / "faulty_disk.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-w", "-o", made, _SOURCE, "-ldl"], check=True, timeout=120)
    return made


def run(
    command: Sequence[str | Path],
    path_pattern: str,
    *,
    kill_at: int = 0,
    fail_from: int = 0,
    fail_at: int = 0,
    errno: int = errors.ENOSPC,
    torn: bool = False,
    **options: Any,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end with one disk fault; a value of 0 means no fault of that kind.

    Args:
        path_pattern: text in the paths of the files that are watched.
        kill_at: the process is killed (SIGKILL) instead of this write.
        fail_from: this write and all after it fail with `errno`.
        fail_at: only this write fails.
        torn: half of the first of these writes reaches the file.
        options: options for subprocess.run; variables are added to `env`.

    Returns:
        The result of subprocess.run, with the output as text.
    """
    return _run(command, path_pattern, (kill_at, fail_from, fail_at, errno, torn), options)[0]


def writes(command: Sequence[str | Path], path_pattern: str, **options: Any) -> int:
    """Number of writes that a program makes without a fault; it must end without an error."""
    done, n = _run(command, path_pattern, (0, 0, 0, 0, False), options)
    assert done.returncode == 0, done.stderr
    return n


def environment(path_pattern: str) -> dict[str, str]:
    """Environment for a program that sets its faults itself.

    `faulty_disk_arm(kill_at, fail_from, fail_at, errno, torn)` in the library restarts the count, and
    `faulty_disk_count()` returns it.
    """
    return {"LD_PRELOAD": str(library()), "FAULTY_DISK_PATTERN": path_pattern}


def _run(
    command: Sequence[str | Path], path_pattern: str, fault: tuple[int, int, int, int, bool], options: dict[str, Any]
) -> tuple[subprocess.CompletedProcess[str], int]:
    names = ("KILL_AT", "FAIL_FROM", "FAIL_AT", "ERRNO", "TORN")
    given = {f"FAULTY_DISK_{name}": str(int(value)) for name, value in zip(names, fault, strict=True)}
    with tempfile.TemporaryDirectory() as folder:
        counted = Path(folder) / "count"
        counted.write_bytes(bytes(8))
        env = options.pop("env", os.environ) | environment(path_pattern) | given | {"FAULTY_DISK_COUNT": str(counted)}
        options = {"capture_output": True, "timeout": 300, "text": True} | options
        done = subprocess.run([str(word) for word in command], env=env, **options)
        return done, int.from_bytes(counted.read_bytes(), sys.byteorder)
