"""The disk that fails: it counts every way to write, and fails where it is told to."""

import errno
import signal
import sys
from pathlib import Path

import pytest

from tests import faulty_disk

pytestmark = [faulty_disk.needed, pytest.mark.slow]

CODE = """
import os, sys
import numpy as np
folder = sys.argv[1]
with open(folder + "/a", "wb", buffering=0) as file:
    file.write(bytes(100))
    os.fsync(file)
    file.truncate(50)
np.arange(4.0).tofile(folder + "/b")
os.replace(folder + "/a", folder + "/c")
os.unlink(folder + "/c")
with open(os.devnull, "wb") as file:
    file.write(bytes(3))
"""


def test_every_write_is_counted_and_can_be_the_last(tmp_path: Path) -> None:
    def sizes() -> dict[str, int]:
        found = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
        for path in tmp_path.iterdir():
            path.unlink()
        return found

    command = [sys.executable, "-c", CODE, str(tmp_path)]
    assert faulty_disk.writes(command, str(tmp_path)) == 6
    assert sizes() == {"b": 32}
    left = [{"a": 0}, {"a": 100}, {"a": 100}, {"a": 50, "b": 0}, {"a": 50, "b": 32}, {"c": 50, "b": 32}]
    for n, expected in enumerate(left, start=1):
        assert faulty_disk.run(command, str(tmp_path), kill_at=n).returncode == -signal.SIGKILL
        assert sizes() == expected
    done = faulty_disk.run(command, str(tmp_path), fail_from=1, errno=errno.EFBIG, torn=True)
    assert "File too large" in done.stderr and sizes() == {"a": 50}
    done = faulty_disk.run(command, str(tmp_path), fail_at=2)
    assert "No space left on device" in done.stderr and sizes() == {"a": 100}
