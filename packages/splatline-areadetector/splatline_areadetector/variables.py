"""Variables: process variables of an IOC, subscribed to over PVAccess or Channel Access, each with its history.

No variable is written. Values and frames arrive on different ways, and a computer that has stalled gets all of them at
once. Therefore a value is valid from the time stamp of its IOC on.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Self

from beamline.core.errors import ConfigError
from drivers.base.errors import DeviceTimeout
from drivers.epics.channel import waited
from splatline_areadetector.receiver import Subscribed

Value = float | str
_ANSWER, _OTHERS = 3.0, 1.5  # s to wait for an answer: for variables that are needed, and for others
_LONGEST_DELAY = 60.0  # s; if the clock of an IOC is wrong by more, it was never set


def url_problem(url: str) -> str:
    """The fault of the address of process variables; "" if the address is right."""
    scheme, _, name = url.partition("://")
    good = scheme in ("pva", "ca") and name and not any(letter.isspace() for letter in name)
    return "" if good else f"{url!r} is not a prefix of process variables; expected pva://PREFIX or ca://PREFIX"


class History:
    """The values of a variable by the time at which its IOC set them, s since the Unix epoch.

    Args:
        now: clock of this computer.

    Attributes:
        delay: the shortest time from a change to its arrival, including the difference of the clocks; None: no change
            yet.
    """

    def __init__(self, now: Callable[[], float] = time.time) -> None:
        self._now, self._stamps, self._values = now, list[float](), list[Value]()
        self.delay: float | None = None

    def add(self, stamp: float, value: Value) -> None:
        """Add the next value, with the IOC's time. The first value comes with the subscription and may be old."""
        received = self._now()
        if self._values:
            if not abs(received - stamp) < _LONGEST_DELAY:  # its clock was never set
                stamp = received
            delay = received - stamp
            self.delay = delay if self.delay is None else min(self.delay, delay)
            stamp = max(stamp, self._stamps[-1])
        self._stamps.append(stamp)
        self._values.append(value)

    @property
    def last(self) -> Value | None:
        """The present value; None: there is none yet."""
        return self._values[-1] if self._values else None

    @property
    def changed_at(self) -> float:
        """The IOC's time of the present value."""
        return self._stamps[-1] if self._stamps else 0.0

    def rise(self, begin: float, end: float) -> float | None:
        """The increase of a counter between two times of its IOC; None: not known."""
        try:
            before, after = (float(self.until(seconds)[-1]) for seconds in (begin, end))
        except (IndexError, ValueError):
            return None
        return max(0.0, after - before)

    def risen(self, end: float, rest: float) -> float | None:
        """The increase of a counter until a time of its IOC, since it last fell (to 0) or paused for `rest` s. None:
        the counter has neither fallen nor paused since it was first read."""
        n = bisect_right(self._stamps, end)
        values = [float(value) for value in self._values[:n]]
        for i in range(n - 1, 0, -1):
            if values[i] < values[i - 1]:
                return values[-1]
            if values[i] > values[i - 1] and self._stamps[i] - self._stamps[i - 1] > rest:
                return values[-1] - values[i - 1]
        return None

    def until(self, seconds: float) -> Sequence[Value]:
        """The values that the IOC had set by this time, oldest first. They always include the first value, which was
        set before the subscription."""
        return self._values[: max(1, bisect_right(self._stamps, seconds))]


class Variables:
    """Subscribed variables below a prefix, until `close`.

    Args:
        url: pva://PREFIX or ca://PREFIX.
        names: what follows the prefix.
        needed: names that must answer within 3 s.

    Raises:
        DeviceTimeout: a needed variable does not answer.
        ConfigError: the library is not installed.
    """

    def __init__(
        self, url: str, names: Sequence[str], needed: Sequence[str] = (), now: Callable[[], float] = time.time
    ) -> None:
        scheme, _, self.prefix = url.partition("://")
        self.histories = {name: History(now) for name in names}
        self._came = threading.Condition()
        subscribe = _over_pva if scheme == "pva" else _over_ca
        try:
            self.close = subscribe({self.prefix + name: partial(self._add, name) for name in names})
        except ImportError as error:
            raise ConfigError(
                f'{url} needs the library {error.name}: pip install "splatline[areadetector]". Nothing was started.'
            ) from error
        with self._came:
            self._came.wait_for(lambda: not self._silent(needed), _ANSWER)
            self._came.wait_for(lambda: not self._silent(names), _OTHERS)
        if silent := self._silent(needed):
            self.close()
            raise DeviceTimeout(
                url,
                f"no answer within {_ANSWER:g} s",
                request=", ".join(self.prefix + name for name in silent),
                advice=(
                    "Check the prefix, whether the IOC runs, and which hosts EPICS searches (EPICS_CA_ADDR_LIST, "
                    "EPICS_PVA_ADDR_LIST)"
                ),
                state="Nothing was started",
            )

    def _silent(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if self.histories[name].last is None]

    def _add(self, name: str, stamp: float, value: Value) -> None:
        with self._came:
            self.histories[name].add(stamp, value)
            self._came.notify()

    def number(self, name: str) -> float | None:
        """The present value as a number; None: not known."""
        with suppress(TypeError, ValueError):
            return float(self.histories[name].last)  # type: ignore[arg-type]
        return None

    def text(self, name: str) -> str:
        """The present value as text; "": not known."""
        last = self.histories[name].last
        return "" if last is None else str(last)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


Add = Callable[[float, Value], None]


def _plain(value: Any) -> Value:
    """A number, or text from a label, a string or an array of characters."""
    if hasattr(value, "dtype") and value.ndim:
        return bytes(value.astype("u1")).split(b"\0")[0].decode(errors="replace")
    return str(value) if isinstance(value, str) else float(value)


def _over_pva(adders: dict[str, Add]) -> Callable[[], None]:
    def take(add: Add, update: Any) -> None:
        if isinstance(update, Exception):
            return
        value, stamp = update.value, update.get("timeStamp")
        choices = getattr(value, "choices", None)
        seconds = 0.0 if stamp is None else stamp.secondsPastEpoch + 1e-9 * stamp.nanoseconds
        add(seconds, choices[value.index] if choices else _plain(value))

    return Subscribed({name: partial(take, add) for name, add in adders.items()}).close


def _over_ca(adders: dict[str, Add]) -> Callable[[], None]:
    import aioca

    async def take(add: Add, labels: list[str], update: Any) -> None:
        if not update.ok:
            return
        is_choice = update.datatype == aioca.DBR_ENUM
        if is_choice and not labels:  # because updates with a time stamp do not contain the labels
            labels.extend((await aioca.caget(update.name, format=aioca.FORMAT_CTRL)).enums)
        add(float(update.timestamp), labels[int(update)] if is_choice and int(update) < len(labels) else _plain(update))

    async def start() -> list[Any]:
        return [
            aioca.camonitor(name, partial(take, add, []), format=aioca.FORMAT_TIME, all_updates=True)
            for name, add in adders.items()
        ]

    async def end() -> None:
        for each in subscriptions:
            each.close()

    subscriptions = waited(start())
    # Wait for the closing. Otherwise aioca closes the rest at the end of the program in another thread, which crashes.
    return lambda: waited(end())
