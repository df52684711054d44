"""The known facts about a frame, its number, and the decision on its place in the plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np

from drivers.base.frame import FrameKind

VIEW = FrameKind.PROJECTION
_NEAR = 100  # largest distance from the end of its range at which a counter may restart
_RANGES = ((0, 2**16 - 1), (0, 2**31 - 1), (-(2**31), 2**31 - 1))


@dataclass(frozen=True)
class BlockKey:
    """The phase of the scan in which a frame is taken.

    Attributes:
        serial: number that differs between two blocks of darks or flats, even if they have the same kind.
        kind: kind of the frame; None: the frame does not belong to a scan.
    """

    serial: int
    kind: FrameKind | None


NO_SCAN, BY_ORDER, UNKNOWN_KIND = (BlockKey(serial, None) for serial in (0, -1, -2))
"""A frame outside of a scan; a frame whose kind follows from the order of the blocks; a frame of unknown kind."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The known facts about a frame.

    Attributes:
        time: s, on the clock of the IOC.
        size: a value that is the same for all frames of a file.
        pixels: compared with those of a frame with the same number.
        reconnected: the connection was lost since the previous frame, or the server already had this frame when we
            connected.
        frame: the frame itself, which the sorter passes on.
        count_restarts: how often the numbers have restarted; the sorter sets it.
    """

    number: int
    phase: BlockKey
    time: float = math.nan
    size: Any = None
    pixels: Any = None
    reconnected: bool = False
    frame: Any = None
    count_restarts: int = 0

    def repeats(self, second: Seen, *, is_last: bool) -> bool:
        """Whether a frame is the same as another frame with this number, sent again: at once, or later with the same
        time."""
        is_same = self.phase == second.phase and (is_last or self.time == second.time)
        return is_same and np.array_equal(self.pixels, second.pixels)


class Basis(Enum):
    """How the number of a block's first frame was found, as the end of a sentence."""

    GIVEN = "the frame that ride.first_id states"
    NUMBERS = "the frame whose number is one above that of the last frame before the block"
    COUNTER = "the frame with the number that was calculated from the camera's counter"
    WAITED = "the first frame that arrived"
    UNKNOWN = "the first frame that arrived (frames before it may have been lost)"

    @property
    def is_sure(self) -> bool:
        return self not in (Basis.WAITED, Basis.UNKNOWN)


class Witness(Protocol):
    """The counters of the IOC, as evidence for lost frames."""

    def counted(self, first: float, second: float | None) -> int | None:
        """The camera's count in this acquisition, including its frame of this time; None: not known.

        Args:
            second: time of the next frame; None: not known.
        """

    def were_lost(self, begin: float, end: float, n: int) -> bool:
        """Whether more than n frames passed the plugin in this time, or the plugin dropped some."""


@dataclass(frozen=True)
class FramePosition:
    """The place of a frame in the plan.

    Attributes:
        trigger: trigger of the frame within its block. skipped: number of triggers that were lost just before this
            frame. basis: how the number of the first frame of the block was found. note: message on assumptions that
            had to be made; "": none were needed.
    """

    block: int
    kind: FrameKind
    trigger: int
    skipped: range = range(0)
    basis: Basis = Basis.WAITED
    note: str = ""


@dataclass(frozen=True)
class Outside:
    """A frame that is not stored, because it is outside of a scan, beyond the planned end of its block, or a
    repetition.

    Attributes:
        lost: numbers that are missing at the end of the block, given with the first frame beyond the end, if the
            numbers
            did not restart in between.
    """

    repeated: bool = False
    lost: range = range(0)


@dataclass(frozen=True)
class Unknown:
    """A frame of the scan that cannot be assigned. `why`: the end of a sentence. `fits`: it has the size of the
    others."""

    why: str
    fits: bool = True


@dataclass(frozen=True)
class NewEpoch:
    """The file is closed before this frame. `why`: a sentence without a full stop."""

    why: str


Decision = FramePosition | Outside | Unknown | NewEpoch


@dataclass
class ContinuedCount:
    """Continues the numbers of frames beyond the end of a counter of 16 or 32 bits.

    Attributes:
        raw: the last number as it was received.
    """

    raw: int | None
    # how far the counter went back at the end of its range: at the last time, and in total
    _last_wrap: int = 0
    _wrapped: int = 0

    def continued(self, raw: int, time: float, times: Sequence[float], *, is_anew: bool) -> tuple[int, str]:
        """The number of the next frame, continued, and a message if numbers were left out, otherwise "". If more time
        has passed than between the frames before, number 0 may be lost.

        Args:
            time, times: IOC's time of this frame, and of the frames before.
            is_anew: the counter may have restarted for another reason.
        """
        last, self.raw, note = raw if self.raw is None else self.raw, raw, ""
        for low, top in _RANGES:
            if top - _NEAR <= last <= top and low <= raw <= low + _NEAR and not is_anew:
                self._last_wrap = top - low + (low != 0 or raw == 0)  # cameras of GigE Vision leave out 0
                self._wrapped += self._last_wrap
                is_long = len(times) > 2 and time - times[-1] > 1.5 * float(np.median(np.diff(times)))
                if last < top or raw > low + 1 or (raw != low and is_long):
                    left_out = "" if self._last_wrap > top - low else f", and frame number {low} counts as skipped"
                    note = f"Frame numbers went from {last} to {raw}: the count is continued beyond {top}{left_out}."
            elif self._last_wrap and top - _NEAR <= raw <= top and low <= last <= low + _NEAR:
                self.raw = last  # exchanged with its neighbour
                return raw + self._wrapped - self._last_wrap, note
        return raw + self._wrapped, note
