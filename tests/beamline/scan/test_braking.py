"""Frames while the stage brakes: their triggers are confirmed by its motion or by their number, or not at all."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.scan.braking import Braking, by_motion, by_number, placing, unassigned
from beamline.scan.ledger import EXTRA, DeliveredFrame, Ledger, Train, assign, enter

PERIOD, FIRST, N = 0.05, 1_795_152_000.0, 200
STEADY, TOLD = 20, 20.3
"""Triggers before the stage is told to stop, and where it is then, in intervals."""

Path = Callable[[float, float], float]
"""Intervals travelled after so many s of a deceleration that takes `seconds` from the speed of one per PERIOD."""


def constant(t: float, seconds: float) -> float:
    return (t - t * t / (2 * seconds)) / PERIOD


def smooth(t: float, seconds: float) -> float:
    """The speed falls as a half wave of a cosine: no jump of the acceleration."""
    return (t + seconds / math.pi * math.sin(math.pi * t / seconds)) / (2 * PERIOD)


class Stage:
    """It brakes over `distance` intervals, `late` s after it was told to."""

    def __init__(self, distance: float, path: Path = constant, late: float = 0.0) -> None:
        self.seconds, self.path = 2 * distance * PERIOD, path
        self.began = FIRST + TOLD * PERIOD + late
        self.stood = self.at(self.began + self.seconds)

    def at(self, time: float) -> float:
        """Intervals beyond trigger 0."""
        braked = min(max(time - self.began, 0.0), self.seconds)
        return (min(time, self.began) - FIRST) / PERIOD + self.path(braked, self.seconds)

    def triggers(self) -> list[float]:
        times = [FIRST, *np.linspace(self.began, self.began + self.seconds, 1001).tolist()]
        places = [self.at(time) for time in times]
        return [float(np.interp(k, places, times)) for k in range(int(self.stood) + 1)]

    def braking(self, deceleration: float = 1.0) -> Braking:
        """As the driver knows it: with so much of the true deceleration."""
        return Braking(FIRST + TOLD * PERIOD, self.stood, deceleration / (PERIOD * self.seconds))


def confirmed(braking: Braking, times: Sequence[float], last: int = STEADY) -> tuple[object, list[int]]:
    """What confirms frames at these times, and their triggers; up to the `last` they were entered as they came."""
    ledger = Ledger(Train(np.arange(float(N)), PERIOD, FIRST))
    frames = [DeliveredFrame(stamp, time) for stamp, time in enumerate(times)]
    for frame in frames[: last + 1]:
        ledger, _ = assign(ledger, frame.framestamp, frame.time)
    left, found = frames[last + 1 :], []
    way = placing(ledger, braking, left)
    while left:
        entered = enter(ledger, [way(ledger, braking, frame) for frame in left], last=True)
        assert entered is not None
        ledger, entry = entered
        found.append(entry.trigger)
        left = left[1:]
    return way, found


def without(kept: Sequence[int]) -> list[int]:
    return [trigger for trigger in kept if trigger != EXTRA]


@given(st.floats(0.5, 25.0), st.floats(0.0, 0.1))
def test_all_triggers_of_a_stage_that_brakes_as_it_should(distance: float, late: float) -> None:
    stage = Stage(distance, late=late)
    way, found = confirmed(stage.braking(), times := stage.triggers())
    assert way is by_motion
    assert found == list(range(STEADY + 1, len(times)))


@given(st.floats(1.5, 20.0), st.lists(st.floats(0.0, 1.2), min_size=1, max_size=4))
def test_noise_shifts_no_trigger(distance: float, noise: list[float]) -> None:
    """At times between the order to stop and a little after it stands."""
    stage = Stage(distance)
    heard = [stage.began + share * stage.seconds for share in noise]
    times = sorted({*stage.triggers(), *heard})
    _, found = confirmed(stage.braking(), times)
    for trigger, time in zip(found, times[STEADY + 1 :], strict=True):
        assert trigger == EXTRA or abs(stage.at(time) - trigger) <= 0.36
    assert len(set(without(found))) == len(without(found)) >= int(stage.stood) - STEADY - len(noise)


@pytest.mark.parametrize(("path", "wrong"), [(smooth, 1.0), (constant, 0.7), (constant, 1.3)])
def test_their_number_confirms_frames_of_a_stage_that_brakes_otherwise(path: Path, wrong: float) -> None:
    stage = Stage(12.0, path)
    way, found = confirmed(stage.braking(wrong), times := stage.triggers())
    assert way is by_number
    assert found == list(range(STEADY + 1, len(times)))
    # A frame that was exposed and lost counts; one that noise exposed is one too many, and then nothing is confirmed.
    noisy = sorted([*times, stage.began + 0.31 * stage.seconds])
    assert confirmed(stage.braking(wrong), noisy) == (unassigned, [EXTRA] * (len(noisy) - STEADY - 1))


def test_noise_in_place_of_a_trigger_is_seen_by_the_intervals() -> None:
    """The number is right: the camera was not ready for the trigger that came after the noise."""
    stage = Stage(12.0, smooth)
    times = stage.triggers()
    times[STEADY + 4] -= 0.6 * PERIOD
    assert confirmed(stage.braking(), times)[0] is unassigned


def test_a_stage_that_braked_before_it_was_told_confirms_nothing() -> None:
    """It ran into something: it stands where it cannot have come to by its deceleration."""
    stage = Stage(3.0)
    braking = Braking(FIRST + TOLD * PERIOD, stage.stood - 2.0, stage.braking().deceleration)
    way, found = confirmed(braking, stage.triggers()[:-2])
    assert way is unassigned and without(found) == []


def test_where_the_start_is_vague_and_no_frame_came_before_nothing_is_confirmed() -> None:
    ledger = Ledger(Train(np.arange(float(N)), PERIOD, FIRST, tolerance=PERIOD))
    braking = Braking(FIRST - 0.3 * PERIOD, 2.7, 1 / (PERIOD * PERIOD * 6))
    assert placing(ledger, braking, [DeliveredFrame(0, FIRST), DeliveredFrame(1, FIRST + 1.2 * PERIOD)]) is unassigned
