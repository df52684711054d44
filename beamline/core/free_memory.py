"""Free memory: how many bytes this process could still take, from whatever the operating system keeps."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_MEMINFO, _CGROUPS, _OWN_CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def free_memory() -> int | None:
    """Bytes that can be had without swapping, also within a container's limit; None where the system does not tell."""
    if sys.platform == "win32":
        return _windows()
    machine = _available(_MEMINFO)
    if machine is None:
        return _free_pages()
    return min([machine, *_left_in_cgroups(_CGROUPS, _OWN_CGROUP)])


def _available(meminfo: Path) -> int | None:
    """MemAvailable: free memory and the caches that the kernel would give up for it."""
    with suppress(OSError):
        for line in meminfo.read_text(encoding="ascii", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable" and value.split()[1:] == ["kB"]:
                return int(value.split()[0]) * 1024
    return None


def _left_in_cgroups(root: Path, own: Path) -> Iterator[int]:
    """What each limit above this process leaves (cgroup v2). A container may see its own limit at the root."""
    inner = ""
    with suppress(OSError):
        for line in own.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("0::/"):
                inner = line.removeprefix("0::/")
    folder = root / inner
    for place in (folder, *folder.parents):
        if not place.is_relative_to(root):
            return
        with suppress(OSError, ValueError):  # no limit is the word "max"
            limit, used = (int((place / name).read_text("ascii")) for name in ("memory.max", "memory.current"))
            yield max(limit - used + _reclaimable(place / "memory.stat"), 0)


def _reclaimable(stat: Path) -> int:
    """The file cache that counts as used and is given up first."""
    for line in stat.read_text("ascii").splitlines():
        name, _, value = line.partition(" ")
        if name == "inactive_file":
            return int(value)
    return 0


def _free_pages() -> int | None:
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on every system
        return None


class _MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of sysinfoapi.h."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        *((name, ctypes.c_uint64) for name in (
            "total", "available", "total_paging", "available_paging", "total_virtual", "available_virtual", "extended",
        )),
    )  # fmt: skip


def _windows() -> int | None:
    if sys.platform != "win32":
        return None
    status = _MemoryStatus(length=ctypes.sizeof(_MemoryStatus))
    if not ctypes.WinDLL("kernel32").GlobalMemoryStatusEx(ctypes.byref(status)):
        return None
    return int(status.available)
