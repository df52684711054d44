"""The receiver: a separate process that takes each frame over PVAccess at once, even while `beamline ride` is busy.

HDF5 keeps Python's lock while it writes, so a thread of `beamline ride` would be too late for frames. Frames that
`beamline ride` has not taken yet wait here. Each item is a line of JSON on stdout, followed by the pixels of a frame.
The process ends when its stdin is closed.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splatline_areadetector.arrays import ArrayFrame, FrameRefusedError, Window, array_frame

# s between two readings of the clock; if they are farther apart by more than the second value, the process has stalled
_TICK, _STILL = 0.1, 0.4


class Subscribed:
    """Subscriptions to process variables over PVAccess, until `close`. One thread takes the updates in their order.

    The subscriptions of p4p itself stop for ever in two cases: if the first update comes before `monitor` has returned,
    which happens on a busy computer; and if a callback raises an error.

    Args:
        takers: functions by the name of the variable. Each gets the updates (p4p's values, not unwrapped) and the
            exceptions (the connection to the server was lost). If a function raises an error, it misses this update.
        request: pvRequest; None: that of p4p.

    Raises:
        ImportError: p4p is not installed.
    """

    def __init__(self, takers: Mapping[str, Callable[[Any], None]], request: str | None = None) -> None:
        from p4p.client.raw import Context

        self._wake, self._over = threading.Event(), False
        self._context = Context("pva", useenv=True, nt=False)  # unwrapping fails at a compressed frame
        self._subscriptions = [
            (self._context.monitor(name, lambda *ignored: self._wake.set(), request), take)
            for name, take in takers.items()
        ]
        self._thread = threading.Thread(target=self._take, name="subscribed", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the subscriptions; no update is taken afterwards."""
        self._over = True
        self._wake.set()
        self._thread.join()
        for subscription, _ in self._subscriptions:
            subscription.close()
        self._context.close()

    def _take(self) -> None:
        while not self._over:
            self._wake.wait()
            self._wake.clear()
            for subscription, take in self._subscriptions:
                while not self._over and (update := subscription.pop()) is not None:
                    with suppress(Exception):
                        take(update)


class Receiver:
    """Takes the updates of an image in one thread; another thread passes them on.

    Args:
        room: largest number of bytes of waiting frames. A single frame may always wait, whatever its size.
    """

    def __init__(self, room: int, now: Callable[[], float] = time.time) -> None:
        self._room, self._now = room, now
        self._items = queue.SimpleQueue[tuple[list[Any], NDArray[Any] | None]]()
        self._taken = self._passed = 0  # bytes of frames
        self._fresh, self._ready = True, False  # fresh: the next frame is the one that the server had before

    def take(self, value: Any) -> None:
        """Take an update, or p4p's exception for a lost connection.

        The method never raises an error, because the next update may be good.
        """
        received = self._now()
        if isinstance(value, Exception):
            if not self._fresh:  # every subscription begins disconnected
                self.put("gone")
            self._fresh = True
            return
        is_current, self._fresh = self._fresh, False
        try:
            frame = array_frame(value, received, is_current)
            if frame is not None:
                self._take_frame(frame)
        except FrameRefusedError as error:
            self.put("refused", int(value.uniqueId), str(error))
        except BaseException as error:
            self.put("refused", -1, f"it cannot be read ({error!r})")
        if not self._ready:
            self._ready = True
            self.put("ready")

    def put(self, *facts: Any, payload: NDArray[Any] | None = None) -> None:
        """Queue an item, with the pixels of a frame."""
        self._items.put(([*facts], payload))

    def _take_frame(self, frame: ArrayFrame) -> None:
        waiting = self._taken - self._passed
        if waiting and waiting + frame.n_bytes > self._room:
            self.put("overflow", frame.unique_id)
            return
        self._taken += frame.n_bytes
        facts = {**vars(frame), "payload": [frame.payload.dtype.str, frame.payload.size], "dtype": frame.dtype.str}
        self.put(
            "frame",
            {**facts, "window": asdict(frame.window), "attributes": {**frame.attributes}},
            payload=frame.payload,
        )

    def pass_on(self, stream: IO[bytes]) -> None:
        """Wait for the next item and write it.

        Args:
            stream: without a buffer, because that of Python 3.11 loses bytes if the process is stopped while writing.
        """
        facts, payload = self._items.get()
        parts: list[Any] = [json.dumps(facts, default=str, allow_nan=True).encode() + b"\n"]
        if payload is not None:
            parts.append(np.ascontiguousarray(payload).data.cast("B"))
            self._passed += payload.nbytes
        for part in parts:
            rest = memoryview(part)
            while rest:
                rest = rest[stream.write(rest) :]


def frame_of(stream: IO[bytes], facts: dict[str, Any]) -> ArrayFrame:
    """The frame with these facts, as a receiver wrote them; its pixels follow in the stream."""
    dtype, n_pixels = facts["payload"]
    payload = np.empty(n_pixels, dtype)
    if stream.readinto(payload.data.cast("B")) < payload.nbytes:  # type: ignore[attr-defined]
        raise EOFError
    window = Window(**{name: tuple(each) for name, each in facts["window"].items()})
    return ArrayFrame(**{**facts, "payload": payload, "dtype": np.dtype(facts["dtype"]), "window": window})


def _watch_clock(say: Callable[..., None]) -> None:
    before = time.monotonic()
    while True:
        time.sleep(_TICK)
        now = time.monotonic()
        if (still := now - before) > _TICK + _STILL:
            say("still", time.time() - still, time.time())
        before = now


def main(name: str, n_frames: str, room: str) -> None:
    """Receive an image until stdin ends.

    Args:
        n_frames: length of the server's queue to ask for.
        room: see `Receiver`.
    """
    receiver = Receiver(int(room))

    def pass_on() -> None:
        with open(1, "wb", buffering=0) as stream:
            while True:
                receiver.pass_on(stream)

    for work in (pass_on, lambda: _watch_clock(receiver.put)):
        threading.Thread(target=work, daemon=True).start()
    subscribed = Subscribed({name: receiver.take}, f"record[queueSize={n_frames}]")
    while os.read(0, 1024):
        pass
    subscribed.close()
    os._exit(0)  # the writing thread may wait for a process that has died


if __name__ == "__main__":
    main(*sys.argv[1:])
