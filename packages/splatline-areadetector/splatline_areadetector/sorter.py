"""Sorter: by their numbers, which trigger of the plan each frame belongs to, what is missing, and where a file ends.

A frame's trigger is its uniqueId less that of the first frame of its block. Frames beyond a block's plan belong to no
scan: cameras run free before and after. A number that falls begins another epoch, unless the kind of frames changed
with it: cameras may count from each start of an acquisition. All of it is arithmetic on numbers; no frame is touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.base.frame import FrameKind
from splatline_areadetector.plan import PlannedBlock


@dataclass(frozen=True)
class Phase:
    """What a scan does while a frame is taken.

    Attributes:
        serial: another one is another block, even of the same kind.
        kind: None: the frame belongs to no scan.
    """

    serial: int
    kind: FrameKind | None


UNPLANNED = 2**31
"""Frames at most of a block that the plan does not have: darks and flats that come all the same."""
NO_SCAN = Phase(0, None)


@dataclass(frozen=True)
class Place:
    """A frame's place in the plan: its block, and its trigger within it; `skipped`: triggers lost just before."""

    block: int
    kind: FrameKind
    trigger: int
    skipped: range = range(0)


@dataclass(frozen=True)
class Outside:
    """A frame that is not stored: of no scan, beyond its block's plan, or seen before; `lost`: numbers of the frames at
    the block's end that did not come, of its first frame beyond where the count did not begin anew in between."""

    repeated: bool = False
    lost: range = range(0)


@dataclass(frozen=True)
class NewEpoch:
    """The file ends before this frame; `why`: a sentence without a full stop."""

    why: str


@dataclass
class _Taken:
    """A block and the triggers that came."""

    kind: FrameKind
    n: int
    first_id: int
    last_id: int
    triggers: set[int] = field(default_factory=set)

    @property
    def is_over(self) -> bool:
        return self.last_id - self.first_id + 1 >= self.n


class Sorter:
    """Assigns frames to the plan's blocks, in the order in which they come.

    Args:
        blocks: planned.
        first_id: number of the first projection; None: that of the first one that comes.

    Attributes:
        repeats: frames that came twice.
    """

    def __init__(self, blocks: Sequence[PlannedBlock], first_id: int | None = None) -> None:
        self._planned, self._first_id = tuple(blocks), first_id
        self._taken: dict[int, _Taken] = {}  # by the number of the planned block; extra ones follow
        self._now, self._serial, self._closed, self._fell = -1, -1, False, False
        self.repeats = 0

    def take(self, unique_id: int, phase: Phase, *, reconnected: bool = False) -> Place | Outside | NewEpoch:
        """Where the next frame belongs.

        Args:
            reconnected: the server had gone since the frame before.
        """
        current = self._taken.get(self._now)
        fell = False
        if current is not None and unique_id < current.last_id:
            fell = self._fell = True
            if reconnected or (phase.serial == self._serial and not (self._closed or current.is_over)):
                return NewEpoch(
                    f"frame numbers began anew at {unique_id}, after {current.last_id}: the server restarted, or its "
                    "counter was reset"
                )
        if phase.kind is None:
            return self._outside(unique_id)
        if phase.serial != self._serial or current is None:
            return self._begin(unique_id, phase)
        trigger = unique_id - current.first_id
        if fell or self._closed or trigger >= current.n:
            self._closed = self._closed or fell
            return self._outside(unique_id)
        if unique_id == current.last_id:
            self.repeats += 1
            return Outside(repeated=True)
        skipped = range(current.last_id + 1 - current.first_id, trigger)
        current.last_id = unique_id
        current.triggers.add(trigger)
        return Place(self._now, current.kind, trigger, skipped)

    def _outside(self, unique_id: int) -> Outside:
        """A frame that is not stored. By its number the present block may be over, whatever is missing at its end."""
        current = self._taken.get(self._now)
        if current is None or self._closed or unique_id < current.first_id + current.n:
            return Outside()
        end, self._closed = current.first_id + current.n, True
        lost = range(0) if self._fell else range(current.last_id + 1, end)
        current.last_id = end - 1
        return Outside(lost=lost)

    def _begin(self, unique_id: int, phase: Phase) -> Place | Outside:
        kind, first = phase.kind, unique_id
        assert kind is not None
        if kind is FrameKind.PROJECTION and self._first_id is not None:
            if unique_id < self._first_id:
                return Outside()
            first = self._first_id
        n = next((block.n for block in self._planned if block.kind is kind), UNPLANNED)
        trigger = unique_id - first
        self._serial, self._closed, self._fell = phase.serial, trigger >= n, False
        if self._closed:
            return Outside()
        free = (i for i, block in enumerate(self._planned) if block.kind is kind and i not in self._taken)
        self._now = next(free, max([len(self._planned) - 1, *self._taken]) + 1)
        self._taken[self._now] = _Taken(kind, n, first, unique_id, {trigger})
        return Place(self._now, kind, trigger, range(trigger))

    def shift_first(self, steps: int) -> None:
        """So many frames of the present block came before its first one and were lost."""
        current = self._taken[self._now]
        current.first_id -= steps
        current.triggers = {trigger + steps for trigger in current.triggers}

    def pass_over(self, unique_id: int) -> range:
        """Frames up to this number of the present block will not come; the numbers of those that had not come yet."""
        current = self._taken.get(self._now)
        if current is None or self._closed or not current.last_id < unique_id < current.first_id + current.n:
            return range(0)
        lost = range(current.last_id + 1, unique_id + 1)
        current.last_id = unique_id
        return lost

    def lose(self, place: Place) -> None:
        """The frame at this place cannot be used."""
        self._taken[place.block].triggers.discard(place.trigger)

    @property
    def complete(self) -> bool:
        """Whether every planned block has begun and the present one is over, so that no more frames are expected."""
        return all(i in self._taken for i in range(len(self._planned))) and self._taken[self._now].is_over

    def missing(self, block: int) -> list[int]:
        """Triggers of a planned block that gave no frame."""
        came = self._taken[block].triggers if block in self._taken else set[int]()
        return [trigger for trigger in range(self._planned[block].n) if trigger not in came]
