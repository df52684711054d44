"""FrameMemory: memory of frames that is used again. To get new memory for each costs more than to copy its pixels."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import weakref
from collections import deque

import numpy as np
from numpy.typing import NDArray

if sys.platform == "win32":

    def _mapped(size: int) -> mmap.mmap:
        return mmap.mmap(-1, size)

    def _lock(address: int, size: int) -> None:
        kernel, this = ctypes.WinDLL("kernel32", use_last_error=True), ctypes.c_void_p(-1)
        least, most = ctypes.c_size_t(), ctypes.c_size_t()  # of the pages that Windows keeps of the process
        if not (
            kernel.GetProcessWorkingSetSize(this, ctypes.byref(least), ctypes.byref(most))
            and kernel.SetProcessWorkingSetSize(
                this, ctypes.c_size_t(least.value + size), ctypes.c_size_t(most.value + size)
            )
            and kernel.VirtualLock(ctypes.c_void_p(address), ctypes.c_size_t(size))
        ):
            raise ctypes.WinError(ctypes.get_last_error())

else:

    def _mapped(size: int) -> mmap.mmap:
        return mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANON)

    def _lock(address: int, size: int) -> None:
        if ctypes.CDLL(None, use_errno=True).mlock(ctypes.c_void_p(address), ctypes.c_size_t(size)):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))


class FrameMemory:
    """Gives memory for frames, and takes it back when nobody holds the frame, or a part of it, any longer.

    Keeps as many buffers as there were frames at one time. May be used from any thread.
    """

    def __init__(self) -> None:
        self._free: deque[bytearray | memoryview] = deque()
        self._bytes = 0

    def prepare(self, n: int, shape: tuple[int, int]) -> str:
        """Get memory for so many frames of a shape now, with every page of it there, and locked: not to be swapped out.

        In place of what was kept so far; memory for further frames is got when they come.

        Returns:
            why it is not locked, in the system's words, such as that the user may not; "" where it is.

        Raises:
            OSError: there is not so much memory. Then none is kept.
        """
        wanted = 2 * shape[0] * shape[1]
        self._free, self._bytes = deque(), wanted
        if not n:
            return ""
        slot = -(-wanted // mmap.PAGESIZE) * mmap.PAGESIZE
        memory = _mapped(n * slot)
        pages, why = np.frombuffer(memory, np.uint8), ""
        try:
            _lock(pages.ctypes.data, pages.size)  # until it is given back to the system
        except OSError as error:
            why = error.strerror or str(error)
        pages[:: mmap.PAGESIZE] = 0
        self._free.extend(memoryview(memory)[i * slot : i * slot + wanted] for i in range(n))
        return why

    def take(self, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """An array uint16 [row, col] of any content, in memory that no other array shares."""
        wanted = 2 * shape[0] * shape[1]
        if wanted != self._bytes:  # frames of another size that come back go to the list that is dropped here
            self._free, self._bytes = deque(), wanted
        try:
            memory = self._free.pop()
        except IndexError:
            memory = bytearray(wanted)
        whole = np.frombuffer(memory, "<u2")  # every view of it, and of its views, holds it: a bytearray is no array
        weakref.finalize(whole, self._free.append, memory).atexit = False
        return whole.reshape(shape)
