"""Braking: assigns triggers to the frames that were taken while the stage was braking after a stop within a pulse
train.

Noise on the trigger line also exposes frames, and during braking the times of triggers are no longer regular. The final
position of the stage confirms the frames: with speed u and constant deceleration a, the stage stops u²/2a after braking
began. The final position therefore gives the time at which braking began, and the position of the stage at the time of
each frame. If the stage brakes in another way, for example with jerk-limited ramps, the number of exposures must equal
the number of triggers up to the final position, and the intervals between exposures must increase. Frames that are
confirmed by neither test are not assigned to a trigger. All functions are pure. A FlownTrain keeps the frames of a
train that wait for their trigger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from beamline.scan.ledger import EXTRA, DeliveredFrame, Ledger, enter, start_known
from beamline.scan.tally import ExposedFrame
from drivers.base.protocols import CameraFrame, TriggerTrain

EARLY, LATE = 0.02, 0.5  # s: braking begins at most this time before the stop was sent, and at most this time after it
MOST = 0.75  # share of the triggers that must have a frame at their times; by chance the share is 0.4
FEW = 4  # number of triggers; with fewer exposures the motion cannot be tested
SHRINKS = 0.2  # periods by which an interval may be shorter than the one before
NEAR_TRIGGER = 0.02  # intervals: a stage that stands this close to a trigger may or may not have passed it


@dataclass(frozen=True)
class Braking:
    """A stage that was stopped during a train of triggers and is now at rest."""

    stop_sent: float  # time in s at which the stop was sent
    position: float  # its position, in intervals beyond trigger 0
    deceleration: float  # intervals/s²


NOT_BRAKING = Braking(math.inf, math.inf, math.inf)
Placing = Callable[[Ledger, Braking, DeliveredFrame], DeliveredFrame]
"""Function that gives the time at which the trigger of a frame would have come at constant speed; NaN if it is
unknown."""


def placing(ledger: Ledger, braking: Braking, frames: Sequence[DeliveredFrame]) -> Placing:
    """The way to assign frames that arrived during braking: by the motion of the stage, by their number, or not at
    all."""
    ledger_before, ledger_by_motion, ledger_by_number = (
        assigned(ledger, braking, frames, assign_frame) for assign_frame in (unassigned, by_motion, by_number)
    )
    fewest, most = (
        min(math.floor(braking.position + tolerance), ledger.train.n - 1) for tolerance in (-NEAR_TRIGGER, NEAR_TRIGGER)
    )
    n_due = fewest - ledger_before.last_trigger
    if _matched(ledger_by_motion) - _matched(ledger_before) >= MOST * n_due:
        return by_motion
    all_counted = fewest <= ledger_by_number.last_trigger <= most and ledger_by_number.unconfirmed == ledger.unconfirmed
    return by_number if n_due >= FEW and all_counted and _intervals_increase(ledger, braking, frames) else unassigned


def assigned(ledger: Ledger, braking: Braking, frames: Sequence[DeliveredFrame], assign_frame: Placing) -> Ledger:
    """The ledger after all frames were assigned to triggers in this way."""
    for i in range(len(frames)):
        entered = enter(ledger, [assign_frame(ledger, braking, frame) for frame in frames[i:]], last=True)
        ledger = ledger if entered is None else entered[0]
    return ledger


def by_motion(ledger: Ledger, braking: Braking, frame: DeliveredFrame) -> DeliveredFrame:
    """Assign the frame to the position that a constant deceleration reaches at its time."""
    train = ledger.train
    if ledger.last_trigger >= 0:
        last, phase, period = ledger.last_trigger, ledger.phase, ledger.period
    elif train.first_time is not None and start_known(train):
        last, phase, period = 0, train.first_time, train.period
    else:
        return unassigned(ledger, braking, frame)
    full_braking_seconds = 1 / (period * braking.deceleration)
    began = phase + (braking.position - last) * period - full_braking_seconds / 2
    if not -EARLY <= began - braking.stop_sent <= LATE:
        return unassigned(ledger, braking, frame)
    if frame.time <= began:
        return frame
    braking_seconds = min(frame.time - began, full_braking_seconds)
    return DeliveredFrame(
        frame.framestamp, began + braking_seconds - braking_seconds**2 / (2 * full_braking_seconds), steady=False
    )


def by_number(ledger: Ledger, braking: Braking, frame: DeliveredFrame) -> DeliveredFrame:
    """Assign the frame by the number of exposures since the last one at constant speed."""
    if frame.time < braking.stop_sent or ledger.last_trigger < 0:
        return unassigned(ledger, braking, frame)
    exposures = ledger.unmatched + frame.framestamp - ledger.last_framestamp
    return DeliveredFrame(frame.framestamp, ledger.phase + exposures * ledger.period, steady=False)


def unassigned(ledger: Ledger, braking: Braking, frame: DeliveredFrame) -> DeliveredFrame:
    """Assign no frame after the stop to a trigger."""
    return frame if frame.time < braking.stop_sent else replace(frame, time=math.nan, steady=False)


def _matched(ledger: Ledger) -> int:
    return ledger.last_trigger + 1 - len(ledger.missing)


def _intervals_increase(ledger: Ledger, braking: Braking, frames: Sequence[DeliveredFrame]) -> bool:
    """True if the intervals between exposures increase after the last exposure at constant speed."""
    steady = [
        DeliveredFrame(ledger.last_framestamp, ledger.phase),
        *(frame for frame in frames if frame.time < braking.stop_sent),
    ]
    last_and_braking = [steady[-1], *(frame for frame in frames if frame.time >= braking.stop_sent)]
    intervals = [(b.time - a.time) / (b.framestamp - a.framestamp) for a, b in pairwise(last_and_braking)]
    period = ledger.train.period
    return all(later > before - SHRINKS * period for before, later in pairwise([period, *intervals]))


@dataclass
class FlownTrain:
    """A pulse train of a fly scan while the stage moves.

    Attributes:
        first_trigger: first trigger of the train within the block. seconds: duration of the move. stop_sent: time at
            which a stop was sent to the stage during the pass. paused: True for a pause; the triggers after the last
            stored frame are then exposed again after the pause. braking: for a stop, the data on the braking, as soon
            as the stage has stopped. waiting: frames whose trigger can be determined only with later frames.
    """

    ledger: Ledger
    train: TriggerTrain
    first_trigger: int
    seconds: float
    stop_sent: float = math.inf
    paused: bool = False
    braking: Braking = NOT_BRAKING
    waiting: list[CameraFrame] = field(default_factory=list)

    @property
    def so_far(self) -> Ledger:
        """The present ledger, closed as if no further frame came."""
        return assigned(self.ledger, self.braking, self._exposed, unassigned)

    @property
    def last_due(self) -> float:
        """The time at which the last trigger of the pass is due, in s since the Unix epoch; inf if it is not known."""
        ledger, train = self.so_far, self.ledger.train
        if ledger.last_trigger >= 0:
            return ledger.phase + (train.n - 1 - ledger.last_trigger) * ledger.period
        return math.inf if train.first_time is None else train.first_time + (train.n - 1) * train.period

    def enter(self, *frames: CameraFrame, last: bool = False) -> Iterator[ExposedFrame]:
        """Enter frames. Yields the frames whose trigger is now known (or EXTRA), with the trigger in the block and the
        angle.

        Args:
            last: True if no further frame will come; then no frame waits.
        """
        self.waiting += frames
        is_braking = self.braking is not NOT_BRAKING
        if is_braking and not last:
            return
        assign_frame = placing(self.ledger, self.braking, self._exposed) if is_braking else unassigned
        while self.waiting:
            exposed = [assign_frame(self.ledger, self.braking, frame) for frame in self._exposed]
            if (entered := enter(self.ledger, exposed, last)) is None:
                return
            self.ledger, entry = entered
            trigger = EXTRA if entry.trigger == EXTRA else self.first_trigger + entry.trigger
            yield self.waiting.pop(0), trigger, entry.angle, True

    @property
    def _exposed(self) -> list[DeliveredFrame]:
        return [DeliveredFrame(frame.framestamp, frame.time) for frame in self.waiting]
