"""njit: replaces numba's decorator and imports numba only at the first call of a kernel, so that other commands start
faster."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from recon.base.registry import loaded


def thread_count() -> int:
    """Number of threads that numba uses, from NUMBA_NUM_THREADS."""
    return int(loaded("numba").config.NUMBA_NUM_THREADS)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As `numba.njit(**options)`; the function is compiled, or read from numba's cache, when it is first used."""
    return lambda function: _Kernel(function, options)


class _Kernel:
    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options = function, options

    @cached_property
    def _dispatcher(self) -> Any:
        numba, around = loaded("numba"), self._function.__globals__
        for name in self._function.__code__.co_names:  # inside a kernel, numba can call only its own kernels
            if isinstance(kernel := around.get(name), _Kernel) and kernel is not self:
                around[name] = kernel._dispatcher
        return numba.njit(**self._options)(self._function)

    def __call__(self, *args: Any) -> Any:
        return self._dispatcher(*args)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dispatcher, name)
