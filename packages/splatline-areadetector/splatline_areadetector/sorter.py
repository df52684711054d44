"""Sorter: determines for each frame which dark, flat or projection it is, and how certain this is.

It uses the number, size, kind, pixels and time of a frame, the planned length of each block, and the counter of the
camera. The trigger of a frame is its number minus that of the first frame of its block. Four properties of the numbers
are handled:

- Neighbours may be exchanged: a frame whose number is ahead waits until some more have come.
- A counter of 16 or 32 bits restarts at its end: the count continues.
- A plugin that averages n frames passes on every nth number.
- Numbers may restart with each acquisition: after a complete block the next block begins, within a block the file ends.

The sorter only computes with values. It uses no file, no server and no clock.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from beamline.core.errors import DataError
from beamline.core.text import count
from drivers.base.frame import FrameKind
from splatline_areadetector.frame_places import (
    BY_ORDER,
    UNKNOWN_KIND,
    VIEW,
    Basis,
    ContinuedCount,
    Decision,
    FramePosition,
    NewEpoch,
    Outside,
    Seen,
    Unknown,
    Witness,
)
from splatline_areadetector.plan import PlannedBlock

WINDOW = 4  # largest number of frames that may come before a frame with a lower number
_RUNNING = 3  # longest time between two frames of the same acquisition, in periods


UNPLANNED = 2**31
"""Largest length of a block that is not planned: darks and flats that come nevertheless."""


@dataclass
class _Taken:
    """A block and the triggers that came. `first_frame_of_other_kind`: the first one after the block's last frame."""

    kind: FrameKind
    n: int
    first: int
    step: int
    last: int
    count_restarts: int
    basis: Basis
    triggers: set[int] = field(default_factory=set)
    closed: bool = False
    first_frame_of_other_kind: Seen | None = None

    def trigger(self, number: int) -> int:
        return (number - self.first) // self.step

    @property
    def end(self) -> int:
        """Number of the first frame beyond the planned end."""
        return self.first + self.n * self.step

    @property
    def n_left(self) -> int:
        """Number of frames still expected."""
        return (self.end - self.last) // self.step - 1

    @property
    def is_over(self) -> bool:
        return self.closed or self.last >= self.end - self.step


def not_set(number: int) -> str:
    """The message about numbers that stay the same."""
    return (
        "Let the server count frames in the uniqueId of its NTNDArray, because beamline ride identifies frames by "
        f"their uniqueId: uniqueId stays at {number} while the pixels change"
    )


def n_before_views(blocks: Sequence[PlannedBlock]) -> int:
    """Number of frames that are planned before the projections."""
    return sum(block.n for block in blocks[: [*(block.kind for block in blocks), VIEW].index(VIEW)])


class Sorter:
    """Assigns frames to the plan's blocks.

    Args:
        blocks: the planned blocks.
        first_id: number of the first projection; None: the sorter finds it.
        witness: counters of the IOC; None: it has none.
        before: the frame before the first one.
        began_within_scan: the scan may have begun earlier, because the numbers have restarted within it.

    Attributes:
        repeats: number of frames that came twice.
        held: frames that wait for earlier numbers, in the order of their numbers.
    """

    def __init__(
        self, blocks: Sequence[PlannedBlock], first_id: int | None = None, witness: Witness | None = None,
        before: Seen | None = None, *, began_within_scan: bool = False,
    ) -> None:  # fmt: skip
        self._planned, self._first_id, self._witness = tuple(blocks), first_id, witness
        self._began_within_scan = began_within_scan
        self._taken: dict[int, _Taken] = {}  # by the number of the planned block; blocks that were not planned follow
        self._now, self._serial, self._step = -1, 0, 0  # step 0: not known yet
        self._numbers = ContinuedCount(None if before is None else before.number)
        self._last = self._known = before
        self._recent = deque[Seen](maxlen=WINDOW)
        self._size: Any = None
        self._note = ""
        self.held: list[Seen] = []
        self.repeats = 0

    def take(self, seen: Seen) -> Iterator[tuple[Seen, Decision]]:
        """Add the next frame. Yields the frames that need not wait any longer, see `decided`."""
        newest = self.held[-1] if self.held else self._last
        number = self._unwrapped(seen.number, seen.time, is_anew=seen.reconnected)
        restarts = 0 if newest is None else newest.count_restarts
        nearby = [*self._recent, *self.held]
        same = [each for each in nearby if (each.number, each.count_restarts) == (number, restarts)]
        if same and not seen.reconnected and seen.repeats(same[-1], is_last=same[-1] is newest):
            self.repeats += 1
            yield replace(seen, number=number), Outside(repeated=True)
            return
        if newest is not None and number <= newest.number:
            restarts = self._count_restarts_of(seen, number, newest) + bool(same)
        now = replace(seen, number=number, count_restarts=restarts)
        insort(self.held, now, key=lambda each: (each.count_restarts, each.number))
        yield from self.decided(2)

    def _count_restarts_of(self, seen: Seen, number: int, newest: Seen) -> int:
        """The restarts of a frame whose number is not beyond that of the newest one: it is exchanged with a neighbour,
        or the numbers restarted. Frames of different phases are only exchanged with their direct neighbours."""
        last, step = self._last, self._step or 1
        is_other = seen.phase != newest.phase and UNKNOWN_KIND not in (seen.phase, newest.phase)
        one_before = [each.number for each in self.held[:-1] if each.count_restarts == newest.count_restarts]
        if seen.reconnected:
            return newest.count_restarts + 1
        if last is not None and last.count_restarts == newest.count_restarts:
            most = step if is_other else WINDOW * step
            return newest.count_restarts + (number <= last.number or number < newest.number - most)
        if last is not None and len(self.held) == 1 and seen.phase == last.phase != newest.phase:
            return newest.count_restarts - (number == last.number + step)
        if one_before:
            return newest.count_restarts + (number <= one_before[-1])
        return newest.count_restarts + (seen.phase != newest.phase or number < newest.number - step)

    def decided(self, patience: int) -> Iterator[tuple[Seen, Decision]]:
        """The frames that need not wait any longer, in the order of their numbers, with where they belong.

        Args:
            patience: 2: more frames are coming; 1: no frame has come for a while; 0: no frame will come.

        Raises:
            DataError: all numbers are the same.
        """
        while self.held and not (len(self.held) <= WINDOW and self._waits(patience)):
            seen = self.held.pop(0)
            yield seen, self._decide(seen, patience)

    def _waits(self, patience: int) -> bool:
        """Whether the first of the held frames must wait for others."""
        seen, last = self.held[0], self._last
        if self._size not in (None, seen.size):
            return patience > 0 and all(each.size != self._size for each in self.held)
        goes_on = last is not None and seen.count_restarts == last.count_restarts and bool(self._taken)
        if goes_on and last is not None and seen.number <= last.number + max(self._step, 1):
            block = self._taken[self._now]  # a number between those of the step waits, because others may follow
            return patience > 1 and self._step > 1 and bool((seen.number - block.first) % block.step)
        return patience > 1 or (patience == 1 and goes_on and self._step == 0 and len(self.held) < 2)

    def _decide(self, seen: Seen, patience: int) -> Decision:
        last, block = self._last, self._taken.get(self._now)
        if self._size not in (None, seen.size):
            is_alone = not patience or any(each.size == self._size for each in self.held)
            return Unknown("it has another size than the others", fits=False) if is_alone else NewEpoch("")
        is_anew = last is not None and seen.count_restarts != last.count_restarts
        if last is not None and block is not None:
            if (is_anew or self._is_another_count(seen, last)) and (why := self._new_epoch(seen, last, block)):
                return NewEpoch(why)
            if not is_anew and (not self._step or self._is_step_wrong(seen, last, block)):
                self._learn_step(seen, last, block)
        place = self._place(seen, block, is_anew)
        self._size, self._last = seen.size, seen
        self._recent.append(seen)
        if isinstance(place, Unknown):
            return place
        self._known, views = self._known if seen.phase == UNKNOWN_KIND else seen, self._views
        if views is not None and not (isinstance(place, FramePosition) and self._taken[place.block] is views):
            views.first_frame_of_other_kind = views.first_frame_of_other_kind or seen
        if isinstance(place, FramePosition):
            place, self._note = replace(place, note=self._note), ""
        return place

    def _is_another_count(self, seen: Seen, last: Seen) -> bool:
        """Whether the numbers rose by far more or less than the time did while the server was gone."""
        oldest = self._recent[0]
        if not seen.reconnected or seen.count_restarts != oldest.count_restarts or last.number == oldest.number:
            return False
        period = (last.time - oldest.time) / (last.number - oldest.number)
        expected = (seen.number - last.number) * period
        return not expected / 2 <= seen.time - last.time <= 2 * expected + 2 * period

    def _new_epoch(self, seen: Seen, last: Seen, block: _Taken) -> str:
        """The reason why the file ends, if numbers have restarted; "" if the file does not end."""
        if (seen.number, seen.phase) == (last.number, last.phase) and not (seen.reconnected or block.is_over):
            raise DataError(f"{not_set(seen.number)}. Earlier frames are in the file.")
        is_same = seen.phase in (BY_ORDER, UNKNOWN_KIND) or (
            seen.phase.kind is block.kind and (block.kind is VIEW or seen.phase.serial == self._serial)
        )
        if not seen.reconnected and (block.is_over or not is_same):
            return ""
        return (
            f"frame numbers restarted at {seen.number}, after {last.number} (the server restarted, or the server's "
            "counter was reset)"
        )

    def _learn_step(self, seen: Seen, last: Seen, block: _Taken) -> None:
        """Find by how much numbers increase from frame to frame. The step is larger than 1 if it is the same for
        several frames and no frame was lost."""
        following = [last, seen, *self.held]
        rises = [b.number - a.number for a, b in pairwise(following) if a.count_restarts == b.count_restarts]
        step = math.gcd(*rises)
        if len(rises) < 2 and step > 1:
            return
        lost = self._witness is not None and self._witness.were_lost(last.time, following[-1].time, len(rises))
        step = 1 if lost else step
        if self._step:
            self._note = (
                f"Do not use the frames up to {last.number}, because they may have a wrong kind or angle. From frame "
                f"{seen.number} on, numbers rise by {step} instead of {block.step}, so frames were lost before this "
                "frame."
            )
            numbers = [block.first + block.step * trigger for trigger in block.triggers]
            if seen.phase == BY_ORDER:
                same = [i for i, each in self._taken.items() if each.count_restarts == block.count_restarts]
                block.first -= (block.step - step) * sum(self._planned[i].n for i in same if i < self._now)
            block.triggers = {i for number in numbers if (i := (number - block.first) // step) < block.n}
        elif step > 1:
            self._note = (
                f"Frame numbers rise by {step}, because a plugin averages {step} frames, or passes on only one of "
                f"{step} frames. Each frame that arrives counts as a frame of the plan. If the plan counts the "
                "camera's frames, take the image before that plugin (NDArrayPort)."
            )
        self._step = block.step = step

    def _is_step_wrong(self, seen: Seen, last: Seen, block: _Taken) -> bool:
        """Whether more than one number of the same acquisition is between those of the step."""
        now = (last.count_restarts, last.phase)
        ahead = [each for each in (seen, *self.held) if (each.count_restarts, each.phase) == now]
        return sum((each.number - block.first) % block.step > 0 for each in ahead) > 1

    def _place(self, seen: Seen, block: _Taken | None, is_anew: bool) -> Decision:
        """The place of a frame, if the file does not end."""
        kind, views = seen.phase.kind, self._views
        if seen.phase == UNKNOWN_KIND:
            if block is None or is_anew or block.closed or seen.number >= block.end:
                return Unknown("it is not known whether the frame is a dark, a flat or a projection")
        elif seen.phase == BY_ORDER:
            self._by_order(seen, block, is_anew)
        elif kind is None:
            return self._outside(seen, block)
        elif kind is VIEW and views is not None:
            if not views.is_over and views.first_frame_of_other_kind is not None:
                self._go_on(seen, views, views.first_frame_of_other_kind)
        elif block is None or kind is not block.kind or seen.phase.serial != self._serial:
            self._begin(seen, kind, is_anew)
        block = self._taken.get(self._now)
        if block is None or kind not in (None, block.kind) or seen.number < block.first:
            return Outside()
        trigger, rest = divmod(seen.number - block.first, block.step)
        if block.closed or seen.count_restarts != block.count_restarts or trigger >= block.n:
            return self._outside(seen, block)
        if rest:
            return Unknown(
                f"frame numbers rise by {block.step}, but the number of this frame is between two expected frame "
                "numbers"
            )
        skipped, block.last = range(block.trigger(block.last) + 1, trigger), seen.number
        block.triggers.add(trigger)
        if seen.reconnected and not self._note and len(block.triggers) > 1:
            self._note = (
                f"The connection to the server was lost before frame {seen.number}. The frame is assigned as if the "
                "count had continued."
            )
        return FramePosition(self._now, block.kind, trigger, skipped, block.basis)

    def _outside(self, seen: Seen, block: _Taken | None) -> Outside:
        """Handle a frame that is not stored. Its number may show that the present block is over, even if frames are
        missing at its end."""
        if block is None or block.closed or seen.number < block.end:
            return Outside()
        block.closed = True
        end = block.end if seen.count_restarts == block.count_restarts else 0
        return Outside(lost=range(block.last + block.step, end, block.step))

    def _by_order(self, seen: Seen, block: _Taken | None, is_anew: bool) -> None:
        """Open the planned block that follows from the order and the lengths of the blocks."""
        i, step = self._now, self._step or 1
        if block is not None and not is_anew:
            first, basis = block.first, block.basis
        elif self._first_id is not None and block is None:
            i, first, basis = 0, self._first_id - n_before_views(self._planned) * step, Basis.GIVEN
        else:
            i += 1
            begun = self._planned[i] if i < len(self._planned) else PlannedBlock(VIEW, 0)
            lost, basis = self._lost_before(seen, is_anew, begun)
            first = seen.number - lost * step
        while i < len(self._planned) and seen.number >= first:
            if i != self._now:
                self._open(i, self._planned[i], first, seen, basis)
            first, i = first + self._planned[i].n * step, i + 1

    def _begin(self, seen: Seen, kind: FrameKind, is_anew: bool) -> None:
        """Open the block that begins with this frame: of another kind, or of another series of darks or flats."""
        views, lost, basis = self._views, 0, Basis.WAITED
        if views is not None and not views.is_over:  # within the projections, or at their end if some are lost
            is_same_count = seen.count_restarts == views.count_restarts
            views.closed = seen.number >= views.end if is_same_count else views.n_left <= WINDOW
        is_later = views is None or views.is_over
        planned = [(i, each) for i, each in enumerate(self._planned) if each.kind is kind]
        free = [i for i, _ in planned if i not in self._taken and (is_later or VIEW in self._kinds(i))]
        n = planned[0][1].n if planned and (free or is_later) else UNPLANNED
        if kind is VIEW and self._first_id is not None:
            lost, basis = (seen.number - self._first_id) // (self._step or 1), Basis.GIVEN
        elif kind is VIEW:
            lost, basis = self._lost_before(seen, is_anew, PlannedBlock(VIEW, n))
        if lost >= 0:
            i = free[0] if free else max(len(self._planned) - 1, *self._taken, -1) + 1
            self._open(i, PlannedBlock(kind, n), seen.number - lost * (self._step or 1), seen, basis)

    def _open(self, i: int, block: PlannedBlock, first: int, seen: Seen, basis: Basis) -> None:
        step = self._step or 1
        if (before := self._taken.get(self._now)) is not None and i < len(self._planned):
            before.closed = True
        self._now, self._serial = i, seen.phase.serial
        self._taken[i] = _Taken(block.kind, block.n, first, step, first - step, seen.count_restarts, basis)

    def _lost_before(self, seen: Seen, is_anew: bool, block: PlannedBlock) -> tuple[int, Basis]:
        """Number of frames of a block that were lost before the first that came, and how that is known."""
        known, step, n, noun = self._known, self._step or 1, block.n, block.kind.name.lower()
        second = next((each for each in self.held if each.count_restarts == seen.count_restarts), None)
        gap, is_other = n, known is not None and known.phase != BY_ORDER and known.phase.kind is not seen.phase.kind
        if known is not None and is_other and known.count_restarts == seen.count_restarts and not seen.reconnected:
            gap = (seen.number - known.number) // step - 1  # if n or more: another count
        if gap == 0:  # or the numbers restarted: the last frames of the block before and as many first ones were lost
            before = self._taken.get(self._now)
            return 0, Basis.NUMBERS if before is None or before.is_over else Basis.WAITED
        if self._witness is not None and (second is None or second.number == seen.number + step):
            counted = self._witness.counted(seen.time, None if second is None else second.time)
            lost = -1 if counted is None else counted // step - 1
            if 0 <= lost < n and lost <= gap:
                words = count(lost, noun)
                self._note = (
                    f"The camera had counted {words} before the first {noun} that arrived, so the scan lost {words}."
                    if lost
                    else self._note
                )
                return lost, Basis.COUNTER
        is_known = seen.phase == BY_ORDER and bool(
            self._taken
        )  # the message is given for the file's first block; the other blocks follow from it
        is_late = (self._began_within_scan and not is_known) or seen.reconnected
        is_late = is_late or gap < n or (is_anew and seen.number > 1)
        if not (is_late or is_anew or is_other) and known is not None and second is not None:
            is_late = seen.time - known.time <= _RUNNING * (second.time - seen.time)
        if is_late:
            off = "" if block.kind is VIEW else "the kinds of frames and "
            self._note = (
                f"Frame {seen.number} counts as the first {noun} of the scan, but earlier {noun}s may be lost. If "
                f"earlier {noun}s are lost, {off}all angles are wrong by the number of lost steps. To avoid wrong "
                f"angles, set {'ride.camera' if block.kind is VIEW else 'ride.kinds'} or ride.first_id."
            )
        return 0, Basis.UNKNOWN if is_late else Basis.WAITED

    def _go_on(self, seen: Seen, views: _Taken, other: Seen) -> None:
        """The projections continue after frames of another kind, which do not use triggers of the projections."""
        lost, known = 0, self._known
        counts = {each.count_restarts for each in (seen, known, other, views) if each is not None}
        if known is not None and len(counts) == 1:
            lost = views.trigger(other.number) - views.trigger(views.last) - 1
            lost += (seen.number - known.number) // views.step - 1
        trigger = views.trigger(views.last) + 1 + lost
        self._note = (
            f"Darks or flats came between the projections. The projections continue with projection {trigger} at "
            f"frame number {seen.number}"
            + (f", because {lost} were lost before and after the other frames." if lost else ".")
        )
        views.first, views.count_restarts = seen.number - trigger * views.step, seen.count_restarts
        views.first_frame_of_other_kind = None
        views.last = seen.number - (lost + 1) * views.step
        self._now = next(i for i, each in self._taken.items() if each is views)

    def _unwrapped(self, raw: int, time: float = math.nan, *, is_anew: bool = False) -> int:
        times = [each.time for each in (*self._recent, *self.held)]
        number, note = self._numbers.continued(raw, time, times, is_anew=is_anew)
        self._note = note or self._note
        return number

    def pass_over(self, raw: int) -> range:
        """Record that no frame of the present block up to this number will come any more. Returns the numbers that are
        missing."""
        block, number = self._taken.get(self._now), self._unwrapped(raw)
        if block is None or block.closed or not block.last < number < block.end:
            return range(0)
        lost, block.last = range(block.last + block.step, number + 1, block.step), number
        self._last = None if self._last is None else replace(self._last, number=number)
        return lost

    def lose(self, place: FramePosition) -> None:
        """Record that the frame at this place cannot be used."""
        self._taken[place.block].triggers.discard(place.trigger)

    @property
    def _views(self) -> _Taken | None:
        return next((each for each in self._taken.values() if each.kind is VIEW), None)

    @property
    def basis(self) -> Basis:
        """How the number of the first projection was found."""
        return Basis.WAITED if self._views is None else self._views.basis

    @property
    def complete(self) -> bool:
        """Whether no more frames are expected: every planned block has begun, and the present block and the projections
        are over."""
        begun = all(i in self._taken for i in range(len(self._planned)))
        return begun and self._taken[self._now].is_over and (self._views is None or self._views.is_over)

    @property
    def is_by_order(self) -> bool:
        """Whether the kinds of frames follow from the order of the plan's blocks."""
        return self._serial == BY_ORDER.serial

    def _kinds(self, first: int) -> list[FrameKind]:
        """Kinds of the planned blocks, from this one on."""
        return [each.kind for each in self._planned[first:]]

    @property
    def n_left(self) -> int:
        """Number of frames that may still come at the end, counted from the first projection: of the projections or, if
        kinds follow from the order, of the whole plan."""
        views, n = self._views, 0
        if views is None:
            return 0
        after = range(len(self._planned) - 1, self._kinds(0).index(VIEW), -1) if self.is_by_order else ()
        for i in after:
            block = self._taken.get(i)
            if block is not None and block.count_restarts == views.count_restarts:
                return n + block.n_left
            n += self._planned[i].n if block is None else 0
        return n + views.n_left

    def is_over(self, block: int) -> bool:
        """Whether no more frames of a block are expected."""
        return self._taken[block].is_over

    def missing(self, block: int) -> list[int]:
        """Triggers of a planned block without a frame."""
        planned, taken, now = self._planned[block], self._taken.get(block), self._taken.get(self._now)
        if taken is None and now is not None and now.kind is planned.kind and self._now >= len(self._planned):
            taken = now  # unplanned frames at the end take the place of the planned ones
        return [trigger for trigger in range(planned.n) if taken is None or trigger not in taken.triggers]
