"""Ledger: assigns frames to triggers, using framestamps and times, so that no angle is guessed.

A camera counts the frames that it exposes. A gap in its framestamps means that a frame was exposed but lost in
transfer. If a trigger comes too early, the camera ignores it: framestamps then stay contiguous, and only the times show
a gap of two periods. While the stage rotates at constant speed, trigger times are linear in the index of the trigger.
Therefore the index of a frame follows from the nearest whole number of periods since the previous frame. Slow drift is
followed by an alpha-beta filter (Benedict & Bordner 1962). Noise on the trigger line exposes frames, too. If the time
of the first trigger is not known precisely, the first frames are those that form a regular train. If two frames could
belong to a trigger, the nearer frame gets it. This decision needs the following frames, see `enter`. Frames exposed
while the stage brakes come with the times at which their triggers would have come at constant speed (see braking.py).
All functions are pure; a Ledger is a value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError

# largest distance of a frame from its trigger, in periods; a frame farther away was not exposed by a trigger
FREE = 0.35
NEAR = 0.1  # periods; if a frame is earlier than its trigger by more, it waits for the next frame, which may be nearer
CONFIRMED = 0.2  # periods; the same for a frame taken while the stage brakes
KNOWN = 0.25  # periods: largest error of the first trigger's time that still identifies the first frame
TRAIN, LOOK = 3, 6  # number of frames that make a train, and largest number of frames in which a train is searched
UNEVEN = 0.25  # periods; frames of a train are at least this regular
PHASE_GAIN, PERIOD_GAIN = 0.3, 0.05
PERIOD_RANGE = 0.2  # the true period may differ from the planned one by this fraction

EXTRA = -1  # stands for the trigger of a frame that no trigger exposed


class LedgerError(DataError):
    """Triggers and frames do not match. `missing` contains the planned rows without a frame."""

    def __init__(self, message: str, missing: Sequence[int]) -> None:
        super().__init__(message)
        self.missing = tuple(missing)


@dataclass(frozen=True, eq=False)
class Train:
    """The expected triggers."""

    angles: NDArray[np.float64]  # float64 [trigger] radians
    period: float  # s between triggers
    first_time: float | None = None  # time of trigger 0, s since the Unix epoch; None if unknown
    tolerance: float = 0.0  # largest error of `first_time` in s

    def __post_init__(self) -> None:
        if self.angles.ndim != 1 or self.angles.size == 0:
            raise ValueError(
                f"a series of triggers needs a list of at least one angle, got an array of shape {self.angles.shape}"
            )
        if not (math.isfinite(self.period) and self.period > 0):
            raise ValueError(f"the period must be positive, got {self.period} s")

    @property
    def n(self) -> int:
        return int(self.angles.size)


@dataclass(frozen=True)
class LedgerEntry:
    """The trigger of a frame (EXTRA: no trigger exposed it), and the angle in radians at the time of the frame."""

    trigger: int
    angle: float


@dataclass(frozen=True, eq=False)
class Ledger:
    """The assignment of frames to triggers so far. Use `Ledger(train)`, then `assign` for each frame, then `settle`.

    Without faults every trigger has its frame and every frame its trigger.
    """

    train: Train  # the expected triggers
    last_trigger: int = -1  # the trigger of the last matched frame, -1 before the first
    last_framestamp: int = -1  # framestamp of the last frame, whether it was matched or not; -1 before the first frame
    unmatched: int = 0  # number of exposures since the last matched frame, whether they were delivered or not
    # phase, period: estimated time of the last matched trigger, and estimated period, both in s
    phase: float = math.nan
    period: float = math.nan
    # first_match: framestamp and trigger of the first matched frame, and its periods since the expected time of
    # trigger 0
    first_match: tuple[int, int, float] = (-1, -1, math.nan)
    # triggers without a frame, ascending: those up to `last_trigger`; in a closed ledger, all
    missing: tuple[int, ...] = ()
    lost: int = 0  # number of these that were exposed but never delivered (gap in the framestamps)
    # number of these that were not exposed (gap in the times). Triggers after the last frame may be either
    ignored: int = 0
    extra: tuple[int, ...] = ()  # framestamps of frames that no trigger exposed
    beyond_last: int = 0  # number of these that came at the time of a trigger after the last one
    unconfirmed: int = 0  # number of extra frames that were exposed while the stage braked
    # largest_residual: largest distance of a matched frame from the expected time of its trigger, in periods. The angle
    # of a frame may be wrong by this many steps
    largest_residual: float = 0.0
    # possible_shift: number of triggers by which all angles may be wrong, after the ledger is closed. If frames are
    # missing or extra at one end of a block, they may in truth be missing or extra at the other end, because times do
    # not show where the block began. 0: nothing is missing or extra, or the time of the first trigger is known
    possible_shift: int = 0

    @property
    def complete(self) -> bool:
        """True if the last trigger has its frame, so that no more frames are expected."""
        return self.last_trigger == self.train.n - 1


@dataclass(frozen=True)
class DeliveredFrame:
    """A frame as it was received from the camera, see `assign`."""

    framestamp: int
    time: float
    steady: bool = True


def enter(ledger: Ledger, frames: Sequence[DeliveredFrame], last: bool) -> tuple[Ledger, LedgerEntry] | None:
    """Assign the first of the waiting frames with the help of the frames after it. Returns None if it must wait for
    further frames.

    Args:
        frames: waiting frames in the order in which they were exposed. last: True if there will be no further frames.
    """
    first, *following = frames
    following_timed = [frame for frame in following if not math.isnan(frame.time)]
    last = last or len(following_timed) < len(following)  # frames without a known time do not help
    after, entry = assign(ledger, first.framestamp, first.time, first.steady)
    if math.isnan(first.time):
        return after, entry
    if ledger.last_trigger < 0 and not start_known(ledger.train):
        regular_frames = _regular([frame.time for frame in (first, *following_timed)], ledger.train.period)
        if len(regular_frames) < min(TRAIN, ledger.train.n) and len(frames) < LOOK and not last:
            return None
        return (after, entry) if regular_frames[0] == 0 else _extra(ledger, first, 0.0)
    if entry.trigger == EXTRA or (periods_late := _periods_late(ledger, entry.trigger, first.time)) >= -NEAR:
        return after, entry
    if not following_timed and not last:
        return None
    for later_frame in following_timed:
        if assign(ledger, later_frame.framestamp, later_frame.time, later_frame.steady)[1].trigger == entry.trigger:
            nearer = abs(_periods_late(ledger, entry.trigger, later_frame.time)) < -periods_late
            return _extra(ledger, first, entry.trigger + periods_late) if nearer else (after, entry)
    return after, entry


def assign(ledger: Ledger, framestamp: int, time: float, steady: bool = True) -> tuple[Ledger, LedgerEntry]:
    """Assign a received frame. Returns the new ledger, and the trigger and the angle of the frame.

    Frames come in the order in which they were exposed.

    Args:
        time: time of the frame's trigger in s; nan: it is not known which trigger exposed the frame. steady: True if
            the stage rotated at constant speed. If False, `time` is the time at which the trigger would have come at
            constant speed, and must match more precisely.
    """
    train, frame = ledger.train, DeliveredFrame(framestamp, time, steady)
    if math.isnan(time):
        return _extra(ledger, frame, max(ledger.last_trigger, 0))
    new_exposures = framestamp - ledger.last_framestamp
    exposures = ledger.unmatched + new_exposures
    if ledger.last_trigger < 0:
        position, trigger, residual = _first_position(train, exposures - 1, time)
        steps = trigger + 1
    else:
        position = ledger.last_trigger + (time - ledger.phase) / ledger.period
        trigger = round(position)
        steps, residual = trigger - ledger.last_trigger, position - trigger
    fits = abs(residual) <= (FREE if steady else CONFIRMED)
    if new_exposures < 1 or steps < 1 or trigger >= train.n or not fits:
        return _extra(ledger, frame, position, beyond=trigger >= train.n and fits)
    lost = min(exposures, steps) - 1
    matched = replace(
        ledger,
        last_trigger=trigger,
        last_framestamp=framestamp,
        unmatched=0,
        missing=(*ledger.missing, *range(ledger.last_trigger + 1, trigger)),
        lost=ledger.lost + lost,
        ignored=ledger.ignored + steps - 1 - lost,
        largest_residual=max(ledger.largest_residual, abs(residual)),
    )
    if ledger.last_trigger < 0:
        matched = replace(matched, phase=time, period=train.period, first_match=(exposures - 1, trigger, position))
    elif steady:
        matched = _follow(ledger, matched, time, steps, residual)
    else:
        matched = replace(matched, phase=ledger.phase + steps * ledger.period)
    return matched, LedgerEntry(trigger, float(train.angles[trigger]))


def _extra(ledger: Ledger, frame: DeliveredFrame, position: float, beyond: bool = False) -> tuple[Ledger, LedgerEntry]:
    """Enter a frame that no trigger exposed, at a position in periods."""
    train, new_exposures = ledger.train, frame.framestamp - ledger.last_framestamp
    after = replace(
        ledger,
        last_framestamp=max(frame.framestamp, ledger.last_framestamp),
        # An extra frame is known, so it does not count among the exposures between two triggers.
        unmatched=ledger.unmatched + max(new_exposures - 1, 0),
        extra=(*ledger.extra, frame.framestamp),
        beyond_last=ledger.beyond_last + beyond,
        unconfirmed=ledger.unconfirmed + (not frame.steady),
    )
    return after, LedgerEntry(EXTRA, float(np.interp(position, np.arange(train.n), train.angles)))


def settle(ledger: Ledger, cut_short: bool = False) -> Ledger:
    """Close the ledger: every trigger after the last frame is marked missing.

    Args:
        cut_short: True if the scan was stopped. The scan did not wait for triggers after the last frame, so they do not
            count as missing.
    """
    missing_at_end = range(0 if cut_short else ledger.last_trigger + 1, 0 if cut_short else ledger.train.n)
    shift = _largest_shift(ledger, None if cut_short else len(missing_at_end))
    return replace(ledger, missing=(*ledger.missing, *missing_at_end), possible_shift=shift)


def start_known(train: Train) -> bool:
    return train.n == 1 or (train.first_time is not None and train.tolerance <= KNOWN * train.period)


def _periods_late(ledger: Ledger, trigger: int, time: float) -> float:
    """Periods from the expected time of a frame's trigger to the frame; negative if the frame came earlier."""
    if ledger.last_trigger >= 0:
        return (time - ledger.phase) / ledger.period - (trigger - ledger.last_trigger)
    return 0.0 if ledger.train.first_time is None else (time - ledger.train.first_time) / ledger.train.period - trigger


def _regular(times: Sequence[float], period: float) -> tuple[int, ...]:
    """The first frames that belong to a train of triggers: the frames that are most regularly spaced, whole periods
    apart."""
    # the best train that ends with each frame, and a measure of its quality
    best_trains: list[tuple[float, tuple[int, ...]]] = []
    for i, time in enumerate(times):
        trains: list[tuple[float, tuple[int, ...]]] = [(0.0, (i,))]
        for quality, frames in best_trains:
            steps = (time - times[frames[-1]]) / period
            if round(steps) >= 1:
                trains.append((quality + 1 - ((steps - round(steps)) / UNEVEN) ** 2, (*frames, i)))
        best_trains.append(max(trains, key=lambda train: train[0]))
    return max(best_trains, key=lambda train: train[0])[1]


def _window(train: Train) -> float:
    """Largest difference of the first frame from its expected time, in periods."""
    return math.inf if train.first_time is None else max(0.5, train.tolerance / train.period)


def _first_position(train: Train, framestamp: int, time: float) -> tuple[float, int, float]:
    """Position in periods, trigger, and distance between the two, of the first frame.

    Args:
        framestamp: number of exposures before the frame, without those that no trigger made.

    If the expected time is not precise enough, framestamps decide. The camera ignored no trigger before the first
    frame, because an armed, idle camera accepts every trigger.
    """
    if train.first_time is None:
        return float(framestamp), framestamp, 0.0
    position = (time - train.first_time) / train.period
    trigger = framestamp if abs(position - framestamp) <= _window(train) else round(position)
    # Only the distance beyond the uncertainty of the expected time counts.
    return position, trigger, max(0.0, abs(position - trigger) - train.tolerance / train.period)


def _largest_shift(ledger: Ledger, missing_at_end: int | None) -> int:
    """The largest shift of all angles that the time of the first frame allows.

    Args:
        missing_at_end: number of triggers without a frame at the end. None: it is not known, and the number that the
            time of the first frame suggests is used.
    """
    if ledger.last_trigger < 0:
        return 0
    framestamp, trigger, position = ledger.first_match
    window = _window(ledger.train)
    if missing_at_end is None:
        missing_at_end = max(0, round(position - trigger))
    shifts = range(framestamp - trigger - ledger.beyond_last, missing_at_end + 1)
    if math.isinf(window):
        return max((abs(j) for j in shifts), default=0)
    return max((abs(j) for j in shifts if abs(position - trigger - j) <= window), default=0)


def _follow(before: Ledger, after: Ledger, time: float, steps: int, residual: float) -> Ledger:
    """Update phase and period with a frame, slowly enough that jitter averages out."""
    nominal = after.train.period
    error = residual * before.period
    low, high = nominal * (1 - PERIOD_RANGE), nominal * (1 + PERIOD_RANGE)
    period = min(max(before.period + PERIOD_GAIN * error / steps, low), high)
    return replace(after, phase=time - (1 - PHASE_GAIN) * error, period=period)
