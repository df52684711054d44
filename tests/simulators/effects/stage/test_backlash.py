"""Backlash: the sample lags where the stage has turned backwards."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simulators.devices.clock import VirtualClock
from simulators.devices.motion import TrapezoidMove
from simulators.devices.motor import PulseMotor
from simulators.effects.stage.backlash import came_forwards
from tests.simulators import shots


def _moved(*angles: float, wait: float = 2.0) -> TrapezoidStage:
    return TrapezoidStage(angles, wait)


class TrapezoidStage:
    """Moves from angle to angle (radians) and stands `wait` s after each move."""

    def __init__(self, angles: tuple[float, ...], wait: float) -> None:
        self.moves: list[TrapezoidMove] = []
        self.end = 1000.0
        for here, there in pairwise(angles):
            self.moves.append(TrapezoidMove.between(here, there, 0.5, 1.0, begin=self.end))
            self.end = self.moves[-1].end + wait

    def __call__(self, time: float) -> float:
        begun = [move for move in self.moves if move.begin <= time] or self.moves[:1]
        return begun[-1].position(time)


def test_backwards_the_sample_stands_further_than_the_stage() -> None:
    scene = shots.scene({"kind": "backlash", "lost_motion_deg": 0.5})
    lagging = shots.frame(shots.scene(), shots.shot(angle=0.4 + math.radians(0.5)))
    for speed, expected in ((0.2, shots.frame(shots.scene())), (-0.2, lagging)):
        seen = shots.frame(scene, angle_at=lambda time, speed=speed: 0.4 + speed * (time - 1000.0))
        np.testing.assert_array_equal(seen, expected)


@given(
    turn=st.floats(0.002, 3.0).flatmap(lambda size: st.sampled_from((size, -size))),
    before=st.floats(-1.0, 1.0),
    wait=st.floats(0.01, 100.0),
)
def test_a_standing_stage_lags_by_its_last_move(turn: float, before: float, wait: float) -> None:
    """Whatever it did before, and however long it has stood."""
    stage = _moved(0.0, before, before + turn, wait=wait)
    assert came_forwards(stage, stage.end) is (turn > 0)


def test_going_beyond_and_back_to_the_target_is_a_move_backwards() -> None:
    stage = _moved(0.0, 1.05, 1.0, wait=0.1)
    now = stage.end + 3.0
    assert stage(now - 2.048) == stage(now) > stage(now - 4.096)  # two looks: it stood, and it came from below
    assert not came_forwards(stage, now)


def test_a_stage_that_never_moved_came_forwards() -> None:
    assert came_forwards(lambda time: 0.4, 1000.0)


def test_a_stage_that_goes_by_counts_is_understood() -> None:
    """The simulated motor's own memory, at the size of times of day."""
    clock = VirtualClock()
    motor = PulseMotor(clock, lambda: None, counts_per_turn=360_000)
    for target in (5000, 2000):
        motor.start(target, 10_000.0, 50_000.0)
        clock.sleep(motor.move.end - clock.now() + 5.0)
        assert came_forwards(motor.angle_at, clock.now()) is (target == 5000)
