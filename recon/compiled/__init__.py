"""Kernels that need no compiling: numba compiles for a level of x86-64, whose compiled kernels the package carries.

numba finds a compiled kernel again by its source, numba's version, Python's minor version, and the processor that it
compiles for. With a level in place of the processor, what one machine compiled serves all of that level. Everything
else is a miss, and compiles as ever: an edited kernel, another Python or numba, an older or another processor, Windows.
"""

from __future__ import annotations

import os
import sys

from recon.compiled.archive import ROOT
from recon.compiled.level import ProcessorLevel, level_for, processor_flags

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
