"""The receiver: a process of its own that takes an image's updates over PVAccess at once, whatever holds the ride up.

HDF5 keeps Python's lock while it writes, so that a thread of the ride would come too late for frames. The receiver
copies each into memory that both processes share, and writes a line of JSON on it; a byte before the pixels says
whether the ride still has them. It ends with its stdin.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import queue
import sys
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import numpy as np

from splatline_areadetector.arrays import ArrayFrame, FrameRefusedError, Window, array_frame
from splatline_areadetector.subscribed import Subscribed

HEAD = 64  # bytes before the pixels of a place; the first one says whether it is taken
_MADV_POPULATE_WRITE, _SLICE = 23, 2**24  # of Linux, and bytes of a call
_TICK, _STILL = 0.1, 0.4  # s between two looks at the clock, and beyond it, at which this process stood still


class Places:
    """Parts of the shared memory for a frame each, all of one size."""

    def __init__(self, memory: Any) -> None:
        self._memory, self._size, self._end = memory, 0, 0
        self._starts, self._others = list[int](), list[int]()  # of this size, and of former ones

    def take(self, n_bytes: int) -> int | None:
        """The start of a place for so many bytes, which is taken now; None: there is no room."""
        size = HEAD * (1 + math.ceil(n_bytes / HEAD))
        if size != self._size:
            self._size, self._starts, self._others = size, [], self._others + self._starts
        start = next((each for each in self._starts if not self._memory[each]), None)
        if start is None:
            if self._end + size > len(self._memory) and not any(self._memory[i] for i in self._others + self._starts):
                self._end, self._starts, self._others = 0, [], []
            if self._end + size > len(self._memory):
                return None
            start, self._end = self._end, self._end + size
            self._starts.append(start)
        self._memory[start] = 1
        return start


class Receiver:
    """Puts the updates of an image into shared memory, and says so.

    Args:
        say: takes what is said of each, as a value for JSON.
    """

    def __init__(self, memory: Any, say: Callable[[list[Any]], None], now: Callable[[], float] = time.time) -> None:
        self._memory, self._places, self._say, self._now = memory, Places(memory), say, now
        self._fresh = True  # the next one is what the server had before
        self._told_ready = False

    def take(self, value: Any) -> None:
        """Take an update, or p4p's word that the server has gone. It never raises: the next one may be sound."""
        received = self._now()
        try:
            if isinstance(value, Exception):
                if not self._fresh:  # every subscription begins disconnected
                    self._say(["gone"])
                self._fresh = True
                return
            is_current, self._fresh = self._fresh, False
            try:
                frame = array_frame(value, received, is_current)
            except FrameRefusedError as error:
                self._say(["refused", int(value.uniqueId), str(error)])
                return
            if frame is not None:
                self._put(frame)
        except BaseException as error:
            self._say(["refused", -1, f"it cannot be read ({error!r})"])
        finally:
            if not (self._told_ready or self._fresh):
                self._told_ready = True
                self._say(["ready"])

    def _put(self, frame: ArrayFrame) -> None:
        payload = frame.payload
        start = self._places.take(max(payload.nbytes, frame.dtype.itemsize * math.prod(frame.window.shape)))
        if start is None:
            self._say(["overflow", frame.unique_id])
            return
        np.frombuffer(self._memory, payload.dtype, payload.size, start + HEAD)[:] = payload.ravel()
        facts = {**vars(frame), "payload": [payload.dtype.str, payload.size, start], "dtype": frame.dtype.str}
        self._say(["frame", {**facts, "window": asdict(frame.window), "attributes": {**frame.attributes}}])


def frame_of(memory: mmap.mmap, facts: dict[str, Any]) -> ArrayFrame:
    """The frame that a receiver has put into the shared memory. Its place is free again at the end of its array."""
    dtype, n_pixels, start = facts["payload"]
    payload = np.frombuffer(memory, np.dtype(dtype), n_pixels, start + HEAD)  # views hold it, also views of views
    weakref.finalize(payload, memory.__setitem__, start, 0).atexit = False
    window = Window(**{name: tuple(each) for name, each in facts["window"].items()})
    return ArrayFrame(**{**facts, "payload": payload, "dtype": np.dtype(facts["dtype"]), "window": window})


def opened_memory(word: str, n_bytes: int) -> mmap.mmap:
    """The memory that another process shares by this word: a file descriptor's path, on Windows a name."""
    if sys.platform == "win32":
        return mmap.mmap(-1, n_bytes, tagname=word)
    handle = os.open(word, os.O_RDWR)
    try:
        return mmap.mmap(handle, n_bytes)
    finally:
        os.close(handle)


def make_present(memory: mmap.mmap, n_bytes: int) -> None:
    """Have the system give this much of the memory now: its pages would else take five times as long as the pixels of
    the first frames. Without a word where the system cannot (before Linux 5.14, Windows)."""
    with suppress(OSError, AttributeError):
        for start in range(0, n_bytes, _SLICE):
            memory.madvise(_MADV_POPULATE_WRITE, start, min(_SLICE, n_bytes - start))


def _watch_clock(say: Callable[[list[Any]], None]) -> None:
    before = time.monotonic()
    while True:
        time.sleep(_TICK)
        now = time.monotonic()
        if (still := now - before) > _TICK + _STILL:
            say(["still", time.time() - still, time.time()])
        before = now


def main(name: str, n_frames: str, word: str, n_bytes: str, n_present: str) -> None:
    """Receive an image until stdin ends; lines of stdout say what came."""
    lines = queue.SimpleQueue[list[Any]]()  # so that a ride that stands still holds nothing up

    def write() -> None:
        while True:
            sys.stdout.write(json.dumps(lines.get(), default=str, allow_nan=True) + "\n")
            sys.stdout.flush()

    memory = opened_memory(word, int(n_bytes))
    make_present(memory, int(n_present))
    receiver = Receiver(memory, lines.put)
    subscribed = Subscribed({name: receiver.take}, f"record[queueSize={n_frames}]")
    for work in (write, lambda: _watch_clock(lines.put)):
        threading.Thread(target=work, daemon=True).start()
    while os.read(0, 1024):
        pass
    subscribed.close()
    os._exit(0)  # the thread that writes may wait for a ride that has died


if __name__ == "__main__":
    main(*sys.argv[1:])
