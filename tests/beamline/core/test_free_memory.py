"""Free memory: the system's own figure, within a container's limit, against files as Linux writes them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from beamline.core import free_memory as module
from beamline.core.free_memory import free_memory

KB = 1024


def test_this_computer_tells_something_plausible() -> None:
    free = free_memory()
    if free is None:
        assert sys.platform not in ("linux", "win32")
    else:
        assert 10**7 < free < 10**14


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="ascii")
    return path


def pretend(monkeypatch: pytest.MonkeyPatch, folder: Path, own: str = "0::/user/session\n") -> Path:
    """A computer with 8 MB available, whose control groups a test fills in."""
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(module, "_MEMINFO", write(folder / "meminfo", "MemFree: 1 kB\nMemAvailable:    8192 kB\n"))
    monkeypatch.setattr(module, "_OWN_CGROUP", write(folder / "cgroup", own))
    monkeypatch.setattr(module, "_CGROUPS", folder / "groups")
    return folder / "groups"


def test_without_limits_it_is_the_computer_s(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pretend(monkeypatch, tmp_path)
    assert free_memory() == 8192 * KB


@pytest.mark.parametrize("where", ["user/session", "user", "."])
def test_the_narrowest_limit_above_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, where: str) -> None:
    groups = pretend(monkeypatch, tmp_path)
    for place in ("user/session", "user", "."):
        write(groups / place / "memory.max", "3000000\n" if place == where else "max\n")
        write(groups / place / "memory.current", "2500000\n")
        write(groups / place / "memory.stat", "anon 2000000\ninactive_file 400000\n")
    assert free_memory() == 3_000_000 - 2_500_000 + 400_000


def test_a_limit_that_is_overdrawn_leaves_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    groups = pretend(monkeypatch, tmp_path, own="12:memory:/old\n0::/\n")
    write(groups / "memory.max", "1000")
    write(groups / "memory.current", "2000")
    write(groups / "memory.stat", "")
    assert free_memory() == 0


def test_a_system_that_tells_only_pages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pretend(monkeypatch, tmp_path)
    monkeypatch.setattr(module, "_MEMINFO", tmp_path / "absent")
    pages = {"SC_AVPHYS_PAGES": 10, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(module.os, "sysconf", pages.__getitem__, raising=False)
    assert free_memory() == 40_960

    def unknown(name: str) -> int:
        raise ValueError("unrecognized configuration name")

    monkeypatch.setattr(module.os, "sysconf", unknown, raising=False)
    assert free_memory() is None
