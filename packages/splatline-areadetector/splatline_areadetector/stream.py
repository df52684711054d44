"""FrameStream: a subscription to an areaDetector's image over PVAccess, emptied at once into a ring of ours.

The server keeps a queue for each client and overwrites its newest entry when it is full, without a word. So it is asked
for about a second, and whatever it delivers is copied at once. `pipeline=true` would let the server wait for us, but
today's servers of NDPluginPva then repeat frames. What is lost shows as a gap in the frames' numbers.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

from beamline.core.errors import BeamlineError, ConfigError
from drivers.base.errors import DeviceTimeout
from splatline_areadetector.arrays import ArrayFrame, FrameRefusedError, array_frame

SCHEME = "pva://"
_LEAST, _MOST = 4, 1000  # frames of the queue
_USUAL = 100.0  # frames/s of a camera whose period is not known
_TICK, _STILL = 0.1, 0.4  # s between two looks at the clock, and beyond it, at which this process stood still
ANSWERS_WITHIN = 3.0  # s
UNREACHABLE = "Check the name, that its IOC runs, and which hosts are asked (EPICS_PVA_ADDR_LIST)"


@dataclass(frozen=True)
class Refused:
    """A frame that cannot be stored, and why, without a full stop; every such frame is the same."""

    unique_id: int
    why: str


@dataclass(frozen=True)
class Overflow:
    """A frame for which the ring had no room, as frames were not taken from it in time."""

    unique_id: int


@dataclass(frozen=True)
class Disconnected:
    """The server has gone: it was stopped, or has not answered for EPICS_PVA_CONN_TMO (40 s)."""


Item = ArrayFrame | Refused | Overflow | Disconnected


@dataclass(frozen=True)
class Queues:
    """How many frames wait where.

    Attributes:
        seconds: of frames in the server's queue, which holds as many arrays of its IOC's memory.
        megabytes: of these, at most.
        ring_megabytes: of frames in ours, at most.
    """

    seconds: float = 1.0
    megabytes: float = 512.0
    ring_megabytes: float = 2048.0

    def frames(self, frame_bytes: int, period: float | None) -> int:
        """Frames to ask the server for.

        Args:
            period: s between frames; None: not known.
        """
        wanted = math.ceil(self.seconds / period) + 1 if period else math.ceil(self.seconds * _USUAL)
        fits = int(1e6 * self.megabytes // max(frame_bytes, 1))
        return max(_LEAST, min(wanted, fits, _MOST))


def image_problem(url: str) -> str:
    """What is wrong with the address of an image; "" if nothing is."""
    name = url.removeprefix(SCHEME)
    good = name and name != url and not any(letter.isspace() for letter in name)
    return "" if good else f"{url!r} names no image; expected pva://PREFIX:Pva1:Image"


class FrameStream:
    """The frames of a process variable, in the order in which they came, until `close`.

    The callback of p4p copies each into the ring and never raises: an exception there would end the subscription.

    Args:
        url: pva://NAME.
        queues: see `Queues`.
        period: s between frames, about; None: not known.
        within: s to wait for the server's first answer.

    Attributes:
        name: of the process variable.
        first: the frame that the server had when it was asked; None: it had none yet.
        queue: frames that the server was asked to hold.
        still: intervals of the Unix time during which this process stood still.

    Raises:
        ConfigError: the address is no pva://NAME, p4p is not installed, or the variable is no NTNDArray.
        DeviceTimeout: no server answers.
        FrameRefusedError: its frames cannot be stored.
    """

    def __init__(
        self,
        url: str,
        queues: Queues | None = None,
        period: float | None = None,
        within: float = ANSWERS_WITHIN,
        now: Callable[[], float] = time.time,
    ) -> None:
        if problem := image_problem(url):
            raise ConfigError(f"{problem}. Nothing was started.")
        self.name, self._now, queues = url.removeprefix(SCHEME), now, queues or Queues()
        self._context = _context()
        self.still: list[tuple[float, float]] = []
        self._items: deque[Item] = deque()
        self._held, self._room = 0, int(1e6 * queues.ring_megabytes)
        self._fresh, self._changed, self._over = True, threading.Condition(), threading.Event()
        try:
            value = self._get("", within)
            _refuse_other(self.name, value)
            self.first = array_frame(value, now(), is_current=True)
            self.queue = queues.frames(0 if self.first is None else self.first.n_bytes, period)
            self._subscription = self._context.monitor(
                self.name, self._on_update, request=f"record[queueSize={self.queue}]", notify_disconnect=True
            )
        except BaseException:
            self._context.close()
            raise
        threading.Thread(target=self._watch_clock, name="stands still", daemon=True).start()

    @property
    def waiting(self) -> int:
        """Items in the ring."""
        return len(self._items)

    def next(self, timeout: float) -> Item | None:
        """The next item; None: nothing came within the time (s)."""
        with self._changed:
            if not self._items and not self._changed.wait_for(lambda: self._items, timeout):
                return None
            item = self._items.popleft()
            if isinstance(item, ArrayFrame):
                self._held -= item.n_bytes
            return item

    def put_back(self, item: Item) -> None:
        """Have `next` return this item again, before all others."""
        with self._changed:
            self._items.appendleft(item)
            self._held += item.n_bytes if isinstance(item, ArrayFrame) else 0
            self._changed.notify()

    def answers(self) -> bool:
        """Whether the server answers now; waits 1.5 s at most."""
        try:
            self._get("field(uniqueId)", ANSWERS_WITHIN / 2)
        except (BeamlineError, DeviceTimeout):
            return False
        return True

    def stood_still(self, begin: float, end: float) -> float:
        """s of this interval of the Unix time in which this process stood still, or of a second after it."""
        return sum(max(0.0, min(end + 1.0, b) - max(begin, a)) for a, b in [*self.still])

    def close(self) -> None:
        """End the subscription. A second time does nothing."""
        if not self._over.is_set():
            self._over.set()
            self._subscription.close()
            self._context.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _get(self, request: str, within: float) -> Any:
        from p4p.client.thread import RemoteError

        try:
            return self._context.get(self.name, timeout=within, request=request or None)
        except TimeoutError:
            raise DeviceTimeout(
                self.name, f"no answer within {within:g} s", advice=UNREACHABLE, state="Nothing was asked"
            ) from None
        except RemoteError as error:
            raise ConfigError(f"{self.name} refuses to be read: {error}. Nothing was started.") from None

    def _on_update(self, value: Any) -> None:
        received = self._now()
        try:
            if isinstance(value, Exception):
                if not self._fresh:  # every subscription begins disconnected
                    self._put(Disconnected())
                self._fresh = True
                return
            item: Item | None
            is_current, self._fresh = self._fresh, False
            try:
                item = array_frame(value, received, is_current)
            except FrameRefusedError as error:
                item = Refused(int(value.uniqueId), str(error))
            if item is not None:
                self._put(item)
        except BaseException as error:  # whatever a message holds, the next one may be sound
            self._put(Refused(-1, f"it cannot be read ({error!r})"))

    def _put(self, item: Item) -> None:
        with self._changed:
            if isinstance(item, ArrayFrame):
                if self._held + item.n_bytes > self._room:
                    item = Overflow(item.unique_id)
                else:
                    self._held += item.n_bytes
            self._items.append(item)
            self._changed.notify()

    def _watch_clock(self) -> None:
        before = time.monotonic()
        while not self._over.wait(_TICK):
            now = time.monotonic()
            if (still := now - before) > _TICK + _STILL:
                self.still.append((self._now() - still, self._now()))
            before = now


def _refuse_other(name: str, value: Any) -> None:
    if not value.getID().startswith("epics:nt/NTNDArray"):
        raise ConfigError(
            f"{name} is a {value.getID() or 'structure'}, not an image (NTNDArray); expected the PvName of the plugin "
            "NDPluginPva or NDPluginPvxs, such as PREFIX:Pva1:Image. Nothing was started."
        )


def _context() -> Any:
    try:
        from p4p.client.thread import Context
    except ImportError as error:
        raise ConfigError(
            f'PVAccess needs p4p, which cannot be loaded ({error}): pip install "splatline[areadetector]". Nothing was '
            "started."
        ) from error
    return Context("pva", nt=False)  # p4p's own unwrapping ends the subscription at a compressed frame
