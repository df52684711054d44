"""The machine that figures were measured on, in one line: no time means anything without it."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

import numba
import torch

_CPUINFO = Path("/proc/cpuinfo")


def machine() -> dict[str, str | int]:
    """Processor, cores this process may use, numba's threads, and the versions of what computes."""
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "threads": int(numba.get_num_threads()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numba": str(numba.__version__),
    }


def machine_line(found: dict[str, str | int] | None = None) -> str:
    """`machine()` as people read it."""
    m = found or machine()
    return (
        f"{m['processor']}, {_counted(m['cores'], 'core')}, {_counted(m['threads'], 'thread')}, {m['system']}, "
        f"Python {m['python']}, torch {m['torch']}, numba {m['numba']}"
    )


def _counted(n: str | int, word: str) -> str:
    return f"{n} {word}" if n == 1 else f"{n} {word}s"


def usable_cores() -> int:
    """Cores that this process may run on, where the system tells; else all there are."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    if _CPUINFO.is_file():
        for line in _CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine() or "unknown processor"
