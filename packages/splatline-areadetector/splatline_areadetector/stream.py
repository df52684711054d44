"""FrameStream: a subscription to an areaDetector's image over PVAccess, emptied at once into a ring of ours.

The server keeps a queue for each client and overwrites its newest entry when it is full, without a word. So it is asked
for about a second, and a process of its own (`receiver`) copies at once whatever it delivers. `pipeline=true` would
let the server wait for us, but today's servers of NDPluginPva then repeat frames. What is lost shows as a gap in the
frames' numbers.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import subprocess
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

from beamline.core.errors import BeamlineError, ConfigError
from beamline.core.text import size
from drivers.base.errors import DeviceTimeout
from splatline_areadetector.arrays import ArrayFrame, array_frame
from splatline_areadetector.receiver import HEAD, frame_of

SCHEME = "pva://"
_LEAST, _MOST = 4, 1000  # frames of the queue
_USUAL = 100.0  # frames/s of a camera whose period is not known
_STARTS, _AGAIN = 60.0, 0.5  # s for a receiver to start, and before another one is
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


@dataclass(frozen=True)
class Died:
    """The process that receives has died with this exit code; another one is being started."""

    code: int


Item = ArrayFrame | Refused | Overflow | Disconnected | Died


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

    The pixels of a frame stay where the receiver put them, in a ring of memory that both processes share; a frame's
    place is free again when nobody has its pixels any more.

    Args:
        url: pva://NAME.
        queues: see `Queues`.
        period: s between frames, about; None: not known.
        within: s to wait for the server's first answer.

    Attributes:
        name: of the process variable.
        first: the frame that the server had when it was asked; None: it had none yet.
        queue: frames that the server was asked to hold.
        still: intervals of the Unix time during which no frame could be received.

    Raises:
        ConfigError: the address is no pva://NAME, p4p is not installed, the variable is no NTNDArray, or there is too
            little memory.
        DeviceTimeout: no server answers.
        FrameRefusedError: its frames cannot be stored.
    """

    def __init__(
        self, url: str, queues: Queues | None = None, period: float | None = None, within: float = ANSWERS_WITHIN
    ) -> None:
        if problem := image_problem(url):
            raise ConfigError(f"{problem}. Nothing was started.")
        self.name, queues = url.removeprefix(SCHEME), queues or Queues()
        self._context = _context()
        self.still: list[tuple[float, float]] = []
        self._items: deque[Item] = deque()
        self._changed, self._ready, self._over = threading.Condition(), threading.Event(), False
        with ExitStack() as opened:
            opened.callback(self._context.close)
            value = self._get("", within)
            _refuse_other(self.name, value)
            self.first = array_frame(value, time.time(), is_current=True)
            self.queue = queues.frames(0 if self.first is None else self.first.n_bytes, period)
            self._n_bytes, self._died_at = int(1e6 * queues.ring_megabytes), math.nan
            if self.first is not None and self._n_bytes < 2 * (self.first.n_bytes + 2 * HEAD):
                raise ConfigError(
                    f"ring_mb is {queues.ring_megabytes:g}, which has no room for two frames of "
                    f"{size(self.first.n_bytes)}: raise it. Nothing was started."
                )
            self._start()
            self._reader = threading.Thread(target=self._read, name=f"receives {self.name}", daemon=True)
            self._reader.start()
            opened.callback(self._end)
            if not self._ready.wait(_STARTS) or not math.isnan(self._died_at):
                raise ConfigError(
                    f"The process that receives {self.name} did not start within {_STARTS:g} s, or ended. Nothing was "
                    "recorded."
                )
            self._close = opened.pop_all().close

    @property
    def waiting(self) -> int:
        """Items in the ring."""
        return len(self._items)

    def next(self, timeout: float) -> Item | None:
        """The next item; None: nothing came within the time (s)."""
        with self._changed:
            if not self._items and not self._changed.wait_for(lambda: self._items, timeout):
                return None
            return self._items.popleft()

    def put_back(self, item: Item) -> None:
        """Have `next` return this item again, before all others."""
        with self._changed:
            self._items.appendleft(item)
            self._changed.notify()

    def answers(self) -> bool:
        """Whether the server answers now; waits 1.5 s at most."""
        try:
            self._get("field(uniqueId)", ANSWERS_WITHIN / 2)
        except (BeamlineError, DeviceTimeout):
            return False
        return True

    def stood_still(self, begin: float, end: float) -> float:
        """s of this interval of the Unix time in which no frame could be received, or of a second after it."""
        return sum(max(0.0, min(end + 1.0, b) - max(begin, a)) for a, b in [*self.still])

    def close(self) -> None:
        """End the subscription; frames that were taken stay. A second time does nothing."""
        self._close()

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

    def _start(self) -> None:
        """Start a receiver, with new memory. Ctrl-C does not reach it, and it imports what this process does."""
        self._memory, word, self._let_go = _shared_memory(self._n_bytes)
        present = 0 if self.first is None else min(self.queue * self.first.n_bytes, self._n_bytes)
        arguments = (self.name, f"{self.queue}", word, f"{self._n_bytes}", f"{present}")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "splatline_areadetector.receiver", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
            | getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )

    def _end(self) -> None:
        self._over = True
        self._process.kill()
        self._reader.join()
        self._let_go()

    def _read(self) -> None:
        """Take what the receiver says, in a thread. Where it dies, another one is started."""
        while True:
            process = self._process
            assert process.stdin is not None and process.stdout is not None
            with process.stdin, process.stdout as lines:
                for line in lines:
                    self._take(*json.loads(line))
            code, self._died_at = process.wait(), time.time()
            if self._over or not self._ready.is_set():  # the constructor waits for the first, and raises
                self._ready.set()
                return
            self._put(Died(code))
            time.sleep(_AGAIN)
            self._let_go()
            self._start()

    def _take(self, what: str, *facts: Any) -> None:
        """Take a line of the receiver."""
        match what:
            case "frame":
                self._put(frame_of(self._memory, facts[0]))
            case "refused":
                self._put(Refused(*facts))
            case "overflow":
                self._put(Overflow(*facts))
            case "gone":
                self._put(Disconnected())
            case "still":
                self.still.append(facts)
            case "ready":
                if not math.isnan(self._died_at):
                    self.still.append((self._died_at, time.time()))
                self._ready.set()

    def _put(self, item: Item) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify()


def _shared_memory(n_bytes: int) -> tuple[mmap.mmap, str, Callable[[], None]]:
    """Memory, given where it is used, the word by which a receiver opens it, and what ends that: the memory itself goes
    with the last array in it. ConfigError: there is too little."""
    try:
        if sys.platform == "win32":
            word = f"splatline-{uuid.uuid4()}"
            return mmap.mmap(-1, n_bytes, tagname=word), word, lambda: None
        handle = os.memfd_create("frames")
        try:
            os.ftruncate(handle, n_bytes)
            memory = mmap.mmap(handle, n_bytes)
        except BaseException:
            os.close(handle)
            raise
        return memory, f"/proc/{os.getpid()}/fd/{handle}", partial(_closed_once, [handle])
    except (OSError, ValueError, OverflowError) as error:
        raise ConfigError(f"There is no memory of {size(n_bytes)} for frames ({error}): lower ring_mb.") from error


def _closed_once(handles: list[int]) -> None:
    while handles:
        os.close(handles.pop())


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
