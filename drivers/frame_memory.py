"""FrameMemory: reused memory of frames. New memory for each frame would cost more than copying its pixels."""

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

    def lock_pages(address: int, size: int) -> None:
        kernel, this = ctypes.WinDLL("kernel32", use_last_error=True), ctypes.c_void_p(-1)
        least, most = ctypes.c_size_t(), ctypes.c_size_t()  # pages that Windows keeps of the process
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

    def lock_pages(address: int, size: int) -> None:
        if ctypes.CDLL(None, use_errno=True).mlock(ctypes.c_void_p(address), ctypes.c_size_t(size)):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))


class FrameMemory:
    """Allocates memory for frames, and reuses it when the frame and all its parts are released.

    It keeps as many buffers as there were frames at one time. May be used from any thread.
    """

    def __init__(self) -> None:
        self._free: deque[bytearray | memoryview] = deque()
        self._bytes = 0

    def prepare(self, n: int, shape: tuple[int, int]) -> str:
        """Allocate memory for so many frames of a shape, with all pages present and locked against swapping.

        It replaces the kept buffers. Further frames allocate memory when they come.

        Returns:
            the system's reason if it is not locked, such as a missing permission; "" if it is locked.

        Raises:
            OSError: there is too little memory. No buffer is kept then.
        """
        wanted = 2 * shape[0] * shape[1]
        self._free, self._bytes = deque(), wanted
        if not n:
            return ""
        slot = -(-wanted // mmap.PAGESIZE) * mmap.PAGESIZE
        memory = _mapped(n * slot)
        pages, why = np.frombuffer(memory, np.uint8), ""
        try:
            lock_pages(pages.ctypes.data, pages.size)  # until the system gets it back
        except OSError as error:
            why = error.strerror or str(error)
        pages[:: mmap.PAGESIZE] = 0
        self._free.extend(memoryview(memory)[i * slot : i * slot + wanted] for i in range(n))
        return why

    def take(self, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """An array uint16 [row, col] of arbitrary content, in memory that no other frame uses."""
        wanted = 2 * shape[0] * shape[1]
        if wanted != self._bytes:  # frames of another size return to the list that is dropped here
            self._free, self._bytes = deque(), wanted
        try:
            memory = self._free.pop()
        except IndexError:
            memory = bytearray(wanted)
        whole = np.frombuffer(memory, "<u2")  # every view holds the bytearray, also views of views
        weakref.finalize(whole, self._free.append, memory).atexit = False
        return whole.reshape(shape)
