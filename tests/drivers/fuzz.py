"""Fuzzing for drivers and simulated controllers: damaged bytes, a wire that sends them, and the allowed reactions.

For a driver: put a `FuzzedWire` before its stand-in, with `plans(samples)` drawn by hypothesis, and run each call
through `allowed`. For a simulated controller: let `replies` send it `received(samples)`. Number of examples:
tests/conftest.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from simulators.wires.wire import Wire

T = TypeVar("T")
Pieces = list[tuple[float, bytes]]
"""(s after the reply was due, bytes)."""
LOOKS = 500_000
"""Looks at a wire after which a driver hangs: on a virtual clock a loop that waits for nothing is never late."""


@st.composite
def mutated(draw: DrawFn, samples: Sequence[bytes]) -> bytes:
    """One of `samples` with up to four bytes or stretches lost, changed, doubled, or strange ones put in."""
    data = bytearray(draw(st.sampled_from(samples)))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(data)))
        to = draw(st.integers(at, min(len(data), at + 8)))
        kind = draw(st.sampled_from(("lose", "replace", "double", "insert", "flip", "cut")))
        if kind == "lose":
            del data[at:to]
        elif kind == "replace":
            data[at:to] = draw(st.binary(min_size=to - at, max_size=to - at))
        elif kind == "double":
            data[at:at] = data[at:to]
        elif kind == "insert":
            data[at:at] = draw(
                st.sampled_from((b"\r", b"\n", b"\r\n", b"\x00", b"\xff", b" ", b"-", b"9" * 30, b"\x1b"))
            )
        elif kind == "flip" and at < len(data):
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del data[at:]
    return bytes(data)


def received(samples: Sequence[bytes]) -> SearchStrategy[bytes]:
    """What may arrive in the place of `samples`: damaged ones, several, other bytes, endless ones, or nothing."""
    return st.one_of(
        mutated(samples),
        st.lists(mutated(samples), max_size=4).map(b"".join),
        st.binary(max_size=60),
        st.builds(lambda unit, times: unit * times, st.binary(min_size=1, max_size=3), st.integers(1, 1500)),
        st.just(b""),
    )


def plans(samples: Sequence[bytes], latest: float = 2.0) -> SearchStrategy[list[Pieces | None]]:
    """For each reply in turn: None, it comes as it is; or pieces that come instead, up to `latest` s late."""
    pieces = st.lists(st.tuples(st.floats(0.0, latest), received(samples)), max_size=3)
    return st.lists(st.one_of(st.none(), pieces), max_size=12)


class FuzzedWire:
    """A stand-in whose replies are replaced as planned; once the plan is used up it is left alone. `replies` counts
    them."""

    def __init__(self, wire: Wire, plan: Sequence[Pieces | None]) -> None:
        self._wire, self._plan = wire, iter(plan)
        self._coming: Pieces = []
        self._looks = self.replies = 0

    @property
    def clock(self) -> Clock:
        return self._wire.clock

    def end(self) -> None:
        """No more faults from now on; what is on its way still comes."""
        self._plan = iter(())

    def receive(self, data: bytes) -> None:
        self._wire.receive(data)

    def transmit(self) -> bytes:
        self._looks += 1
        assert self._looks < LOOKS, "the driver hangs"
        now = self.clock.now()
        if reply := self._wire.transmit():
            self.replies += 1
            pieces = next(self._plan, None)
            self._coming += [(now, reply)] if pieces is None else [(now + late, data) for late, data in pieces]
        due = [data for time, data in self._coming if time <= now]
        self._coming = [(time, data) for time, data in self._coming if time > now]
        return b"".join(due)


def replies(wire: Wire, story: Sequence[tuple[bytes, float]], line_end: bytes) -> Iterator[list[bytes]]:
    """Send bytes to a simulated controller, each followed by a wait in s; yields the complete lines sent back."""
    for data, seconds in story:
        wire.receive(data)
        wire.clock.sleep(seconds)
        *lines, rest = wire.transmit().split(line_end)
        assert rest == b""
        yield lines


def allowed(call: Callable[[], T], clock: Clock, within: float) -> T | DeviceError:
    """What the call gives, or the DeviceError that it raises; anything else, or later than `within` s, is a failure."""
    before = clock.now()
    result: T | DeviceError
    try:
        result = call()
    except DeviceError as error:
        assert str(error)
        result = error
    assert clock.now() - before <= within, f"it took {clock.now() - before:.1f} s"
    return result
