"""Kernels that need no compiling: numba compiles for a level of x86-64, whose compiled kernels the package carries.

numba finds a compiled kernel again by its source, numba's version, Python's minor version, and the processor that it
compiles for. With a level in place of the processor, what one machine compiled serves all of that level. Everything
else is a miss, and compiles as ever: an edited kernel, another Python or numba, an older or another processor, Windows.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path

from recon.compiled.archive import ROOT


@dataclass(frozen=True)
class ProcessorLevel:
    """Instructions of a level of the x86-64 psABI.

    Attributes:
        name: as LLVM knows it.
        flags: that Linux says of a processor of this level, beyond those of the level below.
        features: as LLVM names them. Kernels ask for them (`recon.kernels.cpu.picks`).
    """

    name: str
    flags: frozenset[str]
    features: str

    @property
    def environment(self) -> dict[str, str]:
        """The settings that make numba compile for this level."""
        return {"NUMBA_CPU_NAME": self.name, "NUMBA_CPU_FEATURES": self.features}


_V3 = "+avx,+avx2,+bmi,+bmi2,+f16c,+fma,+lzcnt,+movbe,+popcnt,+sse4.1,+sse4.2,+xsave"
V3 = ProcessorLevel(
    "x86-64-v3",
    frozenset({"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "popcnt", "sse4_1", "sse4_2", "xsave"}),
    _V3,
)
V4 = ProcessorLevel(
    "x86-64-v4",
    V3.flags | {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"},
    _V3 + ",+avx512bw,+avx512cd,+avx512dq,+avx512f,+avx512vl,-prefer-256-bit",
)
BASELINE = ProcessorLevel("x86-64", frozenset(), "")
"""Every processor of x86-64; nothing is carried for it."""
LEVELS = (V4, V3)
"""The highest first."""


def level_for(environment: Mapping[str, str], flags: Set[str]) -> ProcessorLevel | None:
    """The highest level whose instructions the processor has; None below v3, or where the user names a processor.

    A level that the environment names already is kept. A job on another node may inherit one that its processor lacks:
    that is chosen anew.
    """
    names = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
    stated = {name: environment[name] for name in names if name in environment}
    able = [level for level in LEVELS if level.flags <= flags]
    if not stated or not any(stated == level.environment for level in LEVELS):
        return able[0] if able and not stated else None
    return next((level for level in able if stated == level.environment), able[0] if able else BASELINE)


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Flags of the first processor by Linux, on x86-64; none elsewhere."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return frozenset()
    try:
        with cpuinfo.open(encoding="ascii", errors="replace") as lines:
            line_of_flags = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        return frozenset()
    return frozenset(line_of_flags.partition(":")[2].split())


LOCATORS = (
    "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,recon.compiled.cache.UnwritableFolder,"
    "IPythonCacheLocator,ZipCacheLocator"
)
"""Where numba keeps what it compiles, the first that can be written: its own places, and one that need not be."""


def use_compiled_kernels() -> None:
    """Sets the cache and the level for numba, and for processes begun from here on.

    The user's own settings of numba stand: of the processor, of the cache, of no compilation. Where numba is imported
    already, it may have compiled for this very processor, and only the cache is set.
    """
    if "NUMBA_DISABLE_JIT" in os.environ:
        return
    if (numba := sys.modules.get("numba")) is not None:
        numba.config.CACHE_LOCATOR_CLASSES = numba.config.CACHE_LOCATOR_CLASSES or LOCATORS
        return
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)
    level = level_for(os.environ, processor_flags())
    if level is not None:
        os.environ |= level.environment


__all__ = ["ROOT", "ProcessorLevel", "use_compiled_kernels"]
