"""FrameMemory: memory for frames that is reused, because new memory for each frame takes longer than copying its
pixels.
"""

from __future__ import annotations

import weakref
from collections import deque

import numpy as np
from numpy.typing import NDArray


class FrameMemory:
    """Allocates memory for frames, and reuses it when the frame and all its parts are released.

    It keeps as many buffers as there were frames at the same time. It can be used from any thread.
    """

    def __init__(self) -> None:
        self._free: deque[bytearray] = deque()
        self._bytes = 0

    def prepare(self, n: int, shape: tuple[int, int]) -> None:
        """Allocate memory for `n` frames of a shape, with all pages present.

        This replaces the kept buffers. Further frames allocate memory when they arrive.

        Raises:
            MemoryError: there is too little memory.
        """
        self._bytes = 2 * shape[0] * shape[1]
        self._free = deque()
        # written, so that the system really allocates it
        self._free.extend(bytearray(b"\1") * self._bytes for _ in range(n))

    def take(self, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """An array uint16 [row, col] of arbitrary content, in memory that no other frame uses."""
        wanted = 2 * shape[0] * shape[1]
        if wanted != self._bytes:  # buffers of another size return to the old list, which is dropped here
            self._free, self._bytes = deque(), wanted
        try:
            memory = self._free.pop()
        except IndexError:
            memory = bytearray(wanted)
        whole = np.frombuffer(memory, "<u2")  # every numpy view keeps the bytearray alive, also views of views
        weakref.finalize(whole, self._free.append, memory).atexit = False
        return whole.reshape(shape)
