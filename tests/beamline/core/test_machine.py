"""Description of this machine: one short line; memory in bytes, within a container's limit; peak memory."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from beamline.core import machine as module
from beamline.core.machine import free_memory, machine, machine_line, peak_memory

KB = 1024


def test_what_a_time_means_nothing_without() -> None:
    found = machine()
    assert found["threads"] == numba.get_num_threads()
    assert int(found["cores"]) >= 1
    assert str(found["processor"]).strip()
    json.dumps(found)
    line = machine_line(found)
    assert "1 core, 1 thread," in machine_line({**found, "cores": 1, "threads": 1})
    assert "2 cores, 3 threads," in machine_line({**found, "cores": 2, "threads": 3})
    assert "\n" not in line and all(str(value) in line for value in found.values())


@pytest.mark.skipif(sys.platform not in ("linux", "win32"), reason="nothing is promised elsewhere")
def test_the_peak_is_bytes_and_stays() -> None:
    before = peak_memory()
    assert before is not None
    held = np.ones(int(before * 0.2 + 4e7) // 8)
    after = peak_memory()
    assert after is not None
    size = held.nbytes
    del held
    # What was free before may be taken up again, so that the peak grows by less than what is held.
    assert 10e6 < before <= after < before + 2 * size
    assert peak_memory() == pytest.approx(after, rel=0.2)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has another call")
def test_the_status_file_of_linux(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "STATUS", tmp_path / "status")
    assert peak_memory() is None
    write(tmp_path / "status", "Name:\tpython\n\nVmPeak:\t  999 kB\nVmHWM:\t  1234 kB\n")
    assert peak_memory() == 1234 * 1024
    write(tmp_path / "status", "Name:\tpython\n")
    assert peak_memory() is None


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="ascii")
    return path


def pretend(monkeypatch: pytest.MonkeyPatch, folder: Path, own: str = "0::/user/session\n") -> Path:
    """A computer with 8 MB available, whose control groups a test fills in."""
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=8192 * KB))
    monkeypatch.setattr(module, "OWN_CGROUP", write(folder / "cgroup", own))
    monkeypatch.setattr(module, "CGROUPS", folder / "groups")
    return folder / "groups"


@pytest.mark.parametrize("where", ["user/session", "user", "."])
def test_the_narrowest_limit_above_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str) -> None:
    groups = pretend(monkeypatch, tmp_path)
    assert free_memory() == 8192 * KB  # without limits
    for place in ("user/session", "user", "."):
        write(groups / place / "memory.max", "3000000\n" if place == where else "max\n")
        write(groups / place / "memory.current", "2500000\n")
        write(groups / place / "memory.stat", "anon 2000000\ninactive_file 400000\n")
    assert free_memory() == 3_000_000 - 2_500_000 + 400_000
