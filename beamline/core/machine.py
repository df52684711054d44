"""Facts about this computer: its description and its memory. Also the time, memory and disk space that a task needs."""

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
    """Upper bounds for the memory, time and disk space of a piece of work.

    Attributes:
        memory: bytes; None: not known. seconds: duration in s; None: not known before the work is tried. least_seconds:
            shortest duration, if the data decide how much work is done; otherwise the same as `seconds`. output: bytes
            of the result. scratch: bytes of temporary files on the disk of the result.
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
        """The need of several pieces of work that are done one after the other: the largest memory and scratch space,
        and the sum of the known seconds.
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
# Facts about control groups: the line of a group in OWN_CGROUP, its tree, and the files with its limit and its use. The
# last value is the entry of memory.stat for the file cache, which counts as used but is freed first.
_CGROUP_2 = (r"0::/(.*)", "", "memory.max", "memory.current", "inactive_file")
_CGROUP_1 = (r"\d+:memory:/(.*)", "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def machine() -> dict[str, str | int]:
    """Processor, number of cores that this process may use, number of threads of numba, and versions of numerical
    libraries."""
    # imported here, because callers that only ask for memory do not need it
    numba, torch = loaded("numba"), loaded("torch")
    return {
        "processor": processor(),
        "cores": usable_cores(),
        "threads": int(numba.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numba": str(numba.__version__),
    }


def machine_line(facts: dict[str, str | int] | None = None) -> str:
    """`machine()` as one line of text, which can be printed next to measured times."""
    m = facts or machine()
    return (
        f"{m['processor']}, {count(int(m['cores']), 'core')}, {count(int(m['threads']), 'thread')}, {m['system']}, "
        f"Python {m['python']}, torch {m['torch']}, numba {m['numba']}"
    )


def usable_cores() -> int:
    """Number of cores that this process may use."""
    if sys.platform == "darwin":
        return psutil.cpu_count() or 1  # macOS does not bind processes to cores
    return len(psutil.Process().cpu_affinity())


def free_memory() -> int:
    """Free memory in bytes without swapping. It respects the limits of the container and of `memory_limit`."""
    free = [int(psutil.virtual_memory().available), *_free_in_cgroups(CGROUPS, OWN_CGROUP)]
    if (limit := memory_limit()) is not None:
        free.append(max(limit - int(psutil.Process().memory_info().vms), 0))
    return min(free)


def memory_limit() -> int | None:
    """Limit of this process's address space in bytes (ulimit -v). None if there is no limit, and on Windows."""
    if sys.platform != "win32":
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        return None if limit == resource.RLIM_INFINITY else limit
    return None


def peak_memory() -> int | None:
    """Largest resident set of this process so far, in bytes; None if the system does not report it."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    if STATUS.is_file():
        # on Linux, a new process inherits ru_maxrss of the process that started it; VmHWM is not inherited
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
    """Free memory under each limit that applies to this process (cgroup v1 and v2). psutil does not know these limits.

    In a container, its own limit may be at the root.
    """
    lines: list[str] = []
    with suppress(OSError):
        lines = own.read_text(encoding="utf-8", errors="replace").splitlines()
    for pattern, tree, limit_file, usage_file, cache in (_CGROUP_2, _CGROUP_1):
        top = root / tree
        folder = top / next((match[1] for line in lines if (match := re.fullmatch(pattern, line))), "")
        for place in (folder, *folder.parents):
            if not place.is_relative_to(top):
                break
            # without a limit, the value is the word "max", or more than the memory of the machine
            with suppress(OSError, ValueError):
                limit, used = (int((place / name).read_text("ascii")) for name in (limit_file, usage_file))
                yield max(limit - used + _entry(place / "memory.stat", cache), 0)


def _entry(stat: Path, wanted: str) -> int:
    """The number after this name in a file; 0 if there is no such line."""
    for line in stat.read_text("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == [wanted]:
            return int(words[1])
    return 0
