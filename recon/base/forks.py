"""Forks: a fork copies one thread, so it waits until no other thread is in the middle of an import or a compilation.

What such a thread holds would stay half loaded and locked in the child, which would wait for it for ever.
"""

import importlib
import logging  # noqa: F401  Its own hook is to lock after this one, as imports log.
import os
import sys
import threading
import time

_PATIENCE = 60.0  # s, at most
_held = list[threading.RLock]()  # numba's lock of compilations, during a fork


def _wait() -> None:
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        compiler = getattr(sys.modules.get("numba.core.compiler_lock"), "global_compiler_lock", None)
        if (lock := getattr(compiler, "_lock", threading.RLock())).acquire(blocking=False):
            _held.append(lock)
            owners = {getattr(ref(), "owner", None) for ref in [*vars(importlib._bootstrap)["_module_locks"].values()]}
            if owners <= {None, threading.get_ident()}:
                return
            _release()
        time.sleep(0.01)


def _release() -> None:
    if _held:
        _held.pop().release()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_wait, after_in_parent=_release, after_in_child=_release)
