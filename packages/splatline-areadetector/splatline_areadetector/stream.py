"""FrameStream: a subscription to the image of an areaDetector over PVAccess. Frames are copied at once to memory of
this program.

The server keeps a queue for each client. If the queue is full, the server overwrites its newest entry without an error.
Therefore the stream requests a queue of about a second, and a separate process (`receiver`) takes frames as soon as the
server delivers them. With `pipeline=true` the server would wait for the client, but present servers of NDPluginPva then
repeat frames. Lost frames leave a gap in the frame numbers.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import IO, Any, Self

from beamline.core.errors import BeamlineError, ConfigError
from drivers.base.errors import DeviceTimeout
from splatline_areadetector.arrays import ArrayFrame, array_frame
from splatline_areadetector.receiver import frame_of

SCHEME = "pva://"
_LEAST, _MOST = 4, 1000  # frames in the queue
_USUAL = 100.0  # frames/s of a camera whose period is not known
_STARTS, _AGAIN = 60.0, 0.5  # s for a receiver to start, and before another one is started
_AT_HAND = 4  # number of items in this process; all other items wait in the receiver
_PIPE = 2**20  # bytes
ANSWERS_WITHIN = 3.0  # s
UNREACHABLE = "Check the name of the image, whether the IOC runs, and which hosts EPICS searches (EPICS_PVA_ADDR_LIST)"


@dataclass(frozen=True)
class Refused:
    """A frame that cannot be stored. `why` is without a full stop, and the same for all such frames."""

    unique_id: int
    why: str


@dataclass(frozen=True)
class Overflow:
    """A frame for which the ring buffer had no room, because frames were not taken from it in time."""

    unique_id: int


@dataclass(frozen=True)
class Disconnected:
    """The connection was lost: the server was stopped, or did not answer for EPICS_PVA_CONN_TMO (40 s)."""


@dataclass(frozen=True)
class Died:
    """The process that receives frames has died with this exit code; another one is being started."""

    code: int


Item = ArrayFrame | Refused | Overflow | Disconnected | Died


@dataclass(frozen=True)
class Queues:
    """How many frames may wait, and where.

    Attributes:
        seconds: s of frames in the server's queue, in the memory of its IOC.
        megabytes: size limit of this queue.
        ring_megabytes: size limit of the frames in our memory.
    """

    seconds: float = 1.0
    megabytes: float = 512.0
    ring_megabytes: float = 2048.0

    def frames(self, frame_bytes: int, period: float | None) -> int:
        """Length of the queue to ask the server for, in frames.

        Args:
            period: s between frames; None: not known.
        """
        wanted = math.ceil(self.seconds / period) + 1 if period else math.ceil(self.seconds * _USUAL)
        fits = int(1e6 * self.megabytes // max(frame_bytes, 1))
        return max(_LEAST, min(wanted, fits, _MOST))


def image_problem(url: str) -> str:
    """The fault of the address of an image; "" if the address is right."""
    name = url.removeprefix(SCHEME)
    good = name and name != url and not any(letter.isspace() for letter in name)
    return "" if good else f"{url!r} is not the address of an image; expected pva://PREFIX:Pva1:Image"


class FrameStream:
    """The frames of a process variable, in the order in which they came, until `close`.

    Args:
        url: pva://NAME.
        queues: see `Queues`.
        period: approximate s between frames; None: not known.
        within: s to wait for the server's first answer.

    Attributes:
        name: name of the process variable.
        first: the frame that the server had at the time of connecting, and later the last frame of the scan; None:
            there is no frame yet.
        queue: length of the server's queue that was asked for, in frames.
        still: intervals of Unix time during which no frame could be received.

    Raises:
        ConfigError: the address is not pva://NAME, p4p is not installed, or the variable is not an NTNDArray.
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
            self._room, self._died_at = int(1e6 * queues.ring_megabytes), math.nan
            self._start()
            self._reader = threading.Thread(target=self._read, name=f"receives {self.name}", daemon=True)
            self._reader.start()
            opened.callback(self._end)
            if not self._ready.wait(_STARTS) or not math.isnan(self._died_at):
                raise ConfigError(
                    f"The process that receives {self.name} ended, or did not start within {_STARTS:g} s. Nothing was "
                    "recorded."
                )
            self._close = opened.pop_all().close

    def next(self, timeout: float) -> Item | None:
        """The next item; None: nothing came within the time (s)."""
        with self._changed:
            if not self._items and not self._changed.wait_for(lambda: self._items, timeout):
                return None
            self._changed.notify_all()
            return self._items.popleft()

    def ahead(self, n: int, timeout: float) -> list[Item]:
        """The next items, at most n, without taking them from the stream. Waits for each."""
        items = list[Item]()
        while len(items) < n and (item := self.next(timeout)) is not None:
            items.append(item)
        for item in reversed(items):
            self.put_back(item)
        return items

    def put_back(self, item: Item) -> None:
        """Put an item back, so that `next` returns it again, before all others."""
        with self._changed:
            self._items.appendleft(item)

    def answers(self) -> bool:
        """Whether the server answers now. The check takes at most 1.5 s."""
        try:
            self._get("field(uniqueId)", ANSWERS_WITHIN / 2)
        except (BeamlineError, DeviceTimeout):
            return False
        return True

    def stalled_seconds(self, begin: float, end: float) -> float:
        """s during this interval of Unix time, and the second after it, in which no frame could be received."""
        return sum(max(0.0, min(end + 1.0, b) - max(begin, a)) for a, b in [*self.still])

    def close(self) -> None:
        """End the subscription; received frames stay. A second call does nothing."""
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
                self.name,
                f"no answer within {within:g} s",
                advice=UNREACHABLE,
                state="This program only read the image, and changed nothing",
            ) from None
        except RemoteError as error:
            raise ConfigError(
                f"The server of {self.name} does not allow this program to read the image: {error}. Nothing was "
                f"started."
            ) from None

    def _start(self) -> None:
        """Start a receiver. Ctrl-C does not reach it, and it imports from the same places as this process."""
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "splatline_areadetector.receiver",
                self.name,
                f"{self.queue}",
                f"{self._room}",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
            | getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        with suppress(ImportError, AttributeError, OSError):  # the system limits the pages of pipes of a user
            import fcntl

            assert self._process.stdout is not None
            fcntl.fcntl(self._process.stdout.fileno(), fcntl.F_SETPIPE_SZ, _PIPE)

    def _end(self) -> None:
        with self._changed:
            self._over = True
            self._process.kill()
            self._changed.notify_all()
        self._reader.join()

    def _read(self) -> None:
        """Take the items that the receiver passes on, in a separate thread. If the receiver dies, start another one."""
        while not self._over:
            process = self._process
            assert process.stdin is not None and process.stdout is not None
            # the process died within an item
            with process.stdin, process.stdout as stream, suppress(EOFError, ValueError):
                while line := stream.readline():
                    self._take(stream, *json.loads(line))
            code, self._died_at = process.wait(), time.time()
            if self._over or not self._ready.is_set():  # the constructor waits for this, and raises the error
                self._ready.set()
                return
            self._put(Died(code))
            with self._changed:
                if self._changed.wait_for(lambda: self._over, _AGAIN):
                    return
                self._start()

    def _take(self, stream: IO[bytes], what: str, *facts: Any) -> None:
        match what:
            case "frame":
                self._put(frame_of(stream, facts[0]))
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
            self._changed.wait_for(lambda: len(self._items) < _AT_HAND or self._over)
            self._items.append(item)
            self._changed.notify_all()


def _refuse_other(name: str, value: Any) -> None:
    if not value.getID().startswith("epics:nt/NTNDArray"):
        raise ConfigError(
            f"{name} is a {value.getID() or 'structure'}, not an image (NTNDArray). Expected the PvName of the plugin "
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
    return Context("pva", nt=False)  # p4p's own unwrapping would end the subscription at a compressed frame
