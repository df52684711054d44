"""Forks: a fork copies one thread, so it waits until no other thread is in the middle of an import or a compilation.

What such a thread holds would stay half loaded and locked in the child, which would wait for it for ever.
"""

from __future__ import annotations

import importlib
import logging  # noqa: F401  Its own hook is to lock after this one, as imports log.
import os
import sys
import threading
import time
from typing import Any

_PATIENCE = 60.0  # s, at most
_held = list[Any]()  # numba's lock of compilations, during a fork


def _others_import() -> bool:
    """By the locks that Python's importlib keeps of modules."""
    locks = [lock() for lock in [*vars(importlib._bootstrap).get("_module_locks", {}).values()]]
    return any(getattr(lock, "owner", None) not in (None, threading.get_ident()) for lock in locks)


def _wait() -> None:
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        numba = sys.modules.get("numba.core.compiler_lock")
        compiles = getattr(getattr(numba, "global_compiler_lock", None), "_lock", threading.RLock())
        if compiles.acquire(blocking=False):
            if not _others_import():
                _held.append(compiles)
                return
            compiles.release()
        time.sleep(0.01)


def _release() -> None:
    while _held:
        _held.pop().release()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_wait, after_in_parent=_release, after_in_child=_release)
