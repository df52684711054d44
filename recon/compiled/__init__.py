"""Compiled kernels in the package: numba compiles for a level of x86-64, so that users need not compile.

numba identifies a compiled kernel by its source, the version of numba, the minor version of Python, and the processor
for which it compiles. With a level instead of the processor, a kernel that was compiled on one machine can be used on
all machines of this level. In all other cases numba compiles as usual: for an edited kernel, another Python or numba,
an older or another processor, and on Windows.
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
    """The instructions of a level of the x86-64 psABI.

    Attributes:
        name: name of the level in LLVM.
        flags: flags that Linux reports for a processor of this level, in addition to those of the level below.
        features: the instructions as LLVM names them. Kernels check for them (`recon.kernels.cpu.picks`).
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
"""Any x86-64 processor; the package has no compiled kernels for it."""
LEVELS = (V4, V3)
"""The levels with compiled kernels, the highest first."""


def level_for(environment: Mapping[str, str], flags: Set[str]) -> ProcessorLevel | None:
    """The highest level that the processor supports; None below v3, or if the user has named a processor.

    A level that is already named in the environment is kept. A job on another node may inherit a level that its
    processor does not support; then the level is chosen again.
    """
    names = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
    stated = {name: environment[name] for name in names if name in environment}
    able = [level for level in LEVELS if level.flags <= flags]
    if not stated or not any(stated == level.environment for level in LEVELS):
        return able[0] if able and not stated else None
    return next((level for level in able if stated == level.environment), able[0] if able else BASELINE)


def processor_flags(cpuinfo: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Flags of the first processor as Linux reports them, on x86-64; empty on other systems."""
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
"""Where numba stores compiled kernels: the first folder that is writable.

The list also has a place that need not be writable.
"""


def use_compiled_kernels() -> None:
    """Set the cache and the level for numba, in this process and in those it starts from now on.

    Settings of numba by the user are kept: the processor, the cache, and compilation switched off. If numba is already
    imported, it may have compiled for this processor, and only the cache is set.
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
