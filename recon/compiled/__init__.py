"""Kernels that need no compiling: numba compiles for a level of x86-64, whose compiled kernels the package carries.

numba finds a compiled kernel again by its source, numba's version, Python's minor version, and the processor that it
compiles for. With a level in place of the processor, what one machine compiled serves all of that level. Everything
else is a miss, and compiles as ever: an edited kernel, another Python or numba, an older or another processor, Windows.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from recon.compiled.archive import archive_of, unpack
from recon.compiled.level import ProcessorLevel, level_for, processor_flags

ROOT = Path(__file__).parents[2]
"""The folder of the packages `beamline`, `recon` and `simulators`."""


def use_compiled_kernels() -> None:
    """Sets the level for numba and for processes begun from here on, and unpacks the compiled kernels once.

    The user's own settings of numba stand: of the processor, of the cache, of no compilation. Where numba is imported
    already, it may have compiled for this very processor, and nothing is changed.
    """
    if "numba" in sys.modules or "NUMBA_DISABLE_JIT" in os.environ:
        return
    level = level_for(os.environ, processor_flags())
    if level is None:
        return
    os.environ |= level.environment
    if "NUMBA_CACHE_DIR" not in os.environ and "NUMBA_CACHE_LOCATOR_CLASSES" not in os.environ:
        unpack(archive_of(sys.version_info[:2]), ROOT)


__all__ = ["ROOT", "ProcessorLevel", "use_compiled_kernels"]
