"""FrameMemory: memory of frames that is used again. To get new memory for each costs more than to copy its pixels."""

from __future__ import annotations

import weakref
from collections import deque

import numpy as np
from numpy.typing import NDArray


class FrameMemory:
    """Gives memory for frames, and takes it back when nobody holds the frame, or a part of it, any longer.

    Keeps as many buffers as there were frames at one time. May be used from any thread.
    """

    def __init__(self) -> None:
        self._free: deque[bytearray] = deque()
        self._bytes = 0

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
