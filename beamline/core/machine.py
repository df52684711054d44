"""This computer: its description, its memory, and the time, memory and disk space that a task needs."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from beamline.core.text import count
from recon.base.registry import loaded


@dataclass(frozen=True, kw_only=True)
class Need:
    """Upper bounds of what a piece of work takes.

    Attributes:
        memory: bytes; None: not known.
        seconds: None: not known before it is tried.
        least_seconds: where the data choose what takes least; otherwise `seconds`.
        output: bytes of the result.
        scratch: bytes on its disk while it works, next to the result.
    """

    memory: int | None = None
    seconds: float | None = None
    least_seconds: float | None = None
    output: int = 0
    scratch: int = 0

    @property
    def disk(self) -> int:
        """Peak bytes on the disk of the output while the work runs."""
        return self.output + self.scratch

    @staticmethod
    def in_turn(needs: Iterable[Need]) -> Need:
        """The need of pieces of work done one after the other: the largest memory and scratch space, and the sum of
        known seconds.
        """
        each = list(needs)
        return Need(
            memory=max((need.memory or 0 for need in each), default=0),
            seconds=sum(need.seconds or 0.0 for need in each),
            least_seconds=sum(need.least_seconds or 0.0 for need in each),
            output=sum(need.output for need in each),
            scratch=max((need.scratch for need in each), default=0),
        )


if sys.platform != "win32":
    import resource

_CPUINFO, STATUS, _CLEAR = Path("/proc/cpuinfo"), Path("/proc/self/status"), Path("/proc/self/clear_refs")
CGROUPS, OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Of a control group: its line in OWN_CGROUP, its tree, the files of its limit and of its use. In memory.stat: the file
# cache that counts as used and is given up first.
_CGROUP_2 = (r"0::/(.*)", "", "memory.max", "memory.current", "inactive_file")
_CGROUP_1 = (r"\d+:memory:/(.*)", "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def machine() -> dict[str, str | int]:
    """Processor, cores this process may use, numba's threads, and the versions of computing libraries."""
    numba, torch = loaded("numba"), loaded("torch")  # not for callers that only ask for memory
    return {
        "processor": processor(),
        "cores": usable_cores(),
        "threads": int(numba.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numba": str(numba.__version__),
    }


def machine_line(found: dict[str, str | int] | None = None) -> str:
    """`machine()` as one line of text, to stand beside measured times."""
    m = found or machine()
    return (
        f"{m['processor']}, {count(int(m['cores']), 'core')}, {count(int(m['threads']), 'thread')}, {m['system']}, "
        f"Python {m['python']}, torch {m['torch']}, numba {m['numba']}"
    )


def usable_cores() -> int:
    """Cores that this process may use."""
    if sys.platform == "darwin":
        return psutil.cpu_count() or 1  # macOS binds no process to cores
    return len(psutil.Process().cpu_affinity())


def free_memory() -> int:
    """Free memory in bytes, without swapping, within the limits of the container and of `memory_limit`."""
    free = [int(psutil.virtual_memory().available), *_free_in_cgroups(CGROUPS, OWN_CGROUP)]
    if (limit := memory_limit()) is not None:
        free.append(max(limit - int(psutil.Process().memory_info().vms), 0))
    return min(free)


def memory_limit() -> int | None:
    """Limit of this process's address space in bytes (ulimit -v); None without a limit, and on Windows."""
    if sys.platform != "win32":
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        return None if limit == resource.RLIM_INFINITY else limit
    return None


def peak_memory() -> int | None:
    """Largest resident set of this process so far, in bytes; None if the system does not report it."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    if STATUS.is_file():
        # Linux lets a new process inherit ru_maxrss of the one that started it; VmHWM is its own.
        return _entry(STATUS, "VmHWM:") * 1024 or None
    return None


def reset_peak_memory() -> None:
    """Let `peak_memory` start again, if the system can (Linux); otherwise do nothing."""
    with suppress(OSError):
        _CLEAR.write_text("5", encoding="ascii")  # proc_pid_clear_refs(5): reset the peak resident set size


def state_folder() -> Path:
    """Folder in which this user's programs keep data between runs."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    else:
        base = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return base / "splatline"


def processor() -> str:
    """Name of this machine's processor."""
    if _CPUINFO.is_file():
        for line in _CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine() or "unknown processor"


def _free_in_cgroups(root: Path, own: Path) -> Iterator[int]:
    """Memory that each limit above this process leaves (cgroup v1 and v2), which psutil does not know.

    A container may see its own limit at the root.
    """
    lines: list[str] = []
    with suppress(OSError):
        lines = own.read_text(encoding="utf-8", errors="replace").splitlines()
    for pattern, tree, most, now, cache in (_CGROUP_2, _CGROUP_1):
        top = root / tree
        folder = top / next((match[1] for line in lines if (match := re.fullmatch(pattern, line))), "")
        for place in (folder, *folder.parents):
            if not place.is_relative_to(top):
                break
            with suppress(OSError, ValueError):  # without a limit it is the word "max", or more than the machine has
                limit, used = (int((place / name).read_text("ascii")) for name in (most, now))
                yield max(limit - used + _entry(place / "memory.stat", cache), 0)


def _entry(stat: Path, wanted: str) -> int:
    """The number after this name in a file; 0 without such a line."""
    for line in stat.read_text("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == [wanted]:
            return int(words[1])
    return 0
