"""What every stage driver does whatever its controller seems to say: calls end in time, by DeviceError at worst.

A driver's fuzz draws `plans` of its own controller's words and hands them to these laws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.base.errors import DeviceError
from drivers.base.protocols import RotationStage, TriggerTrain
from simulators.wires.serial_url import register
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed
from tests.drivers.stages.rigs import NAMES, AnyRig

TIMEOUT = 0.2
LONG = 2.0
WITHIN = 60.0
"""s; far more than all queries of a call can take, each of which ends by its timeout."""
AFTER = 10.0
"""s; by then all has come that was on its way."""
Call = Callable[[RotationStage], Any]
CALLS: list[Call] = [
    lambda stage: stage.position(),
    lambda stage: stage.moving(),
    lambda stage: stage.start_move(math.radians(20), math.radians(20)),
    lambda stage: stage.start_home(),
    lambda stage: stage.wait(LONG),
    lambda stage: stage.arm(TriggerTrain(stage.to_counts(math.radians(2)), stage.to_counts(math.radians(0.1)), 20)),
    lambda stage: stage.disarm(),
    lambda stage: stage.stop(),
    lambda stage: stage.abort(),
]


@dataclass(frozen=True)
class Fuzzed:
    """A driver whose controller's replies are fuzzed.

    Attributes:
        rig: makes its controller.
        replies_to_open: how many come before the stage is open, all sound.
        disarmed: that no trigger is armed, by the controller itself.
        counts: where the controller itself is by its own counter; else the driver's counts are the true angle's.
        wire: puts the pieces of a plan in the place of replies.
    """

    rig: Callable[[], AnyRig]
    replies_to_open: int
    disarmed: Callable[[AnyRig], bool]
    counts: Callable[[AnyRig], int] | None = None
    wire: Callable[[Any, Sequence[Pieces | None]], FuzzedWire] = FuzzedWire


def opened(rig: AnyRig, wire: FuzzedWire) -> RotationStage | DeviceError:
    rig.url = register(next(NAMES), wire)
    return allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)


def opening_opens_or_says_why(fuzzed: Fuzzed, plan: list[Pieces | None]) -> None:
    """And once the line is sound it opens."""
    rig = fuzzed.rig()
    wire = fuzzed.wire(rig.controller, plan)
    stage = opened(rig, wire)
    if isinstance(stage, DeviceError):
        wire.end()
        rig.clock.sleep(AFTER)
        stage = allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)
        assert not isinstance(stage, DeviceError)
    stage.close()


def every_call_ends_in_time_and_the_stage_can_be_used_again(
    fuzzed: Fuzzed, plan: list[Pieces | None], calls: list[Call]
) -> None:
    """Once the line is sound it can be stopped, disarmed, searches its reference, and moves to whole counts."""
    rig = fuzzed.rig()
    sound: list[Pieces | None] = [None] * fuzzed.replies_to_open
    wire = fuzzed.wire(rig.controller, sound + plan)
    stage = opened(rig, wire)
    assert not isinstance(stage, DeviceError)
    assert wire.replies == fuzzed.replies_to_open
    for call in calls:
        result = allowed(lambda: call(stage), rig.clock, WITHIN)  # noqa: B023
        assert isinstance(result, None | bool | int | float | DeviceError)
    wire.end()
    rig.clock.sleep(AFTER)
    for _ in range(3):  # what had come before, its remains, and then the stop itself
        stopped = allowed(stage.stop, rig.clock, WITHIN)
    assert not isinstance(stopped, DeviceError)
    where = rig.line.angle_at(rig.clock.now())
    assert stage.to_counts(stage.position()) == (
        stage.to_counts(where) if fuzzed.counts is None else fuzzed.counts(rig)
    )
    rig.clock.sleep(AFTER)
    assert rig.line.angle_at(rig.clock.now()) == where
    stage.disarm()
    assert fuzzed.disarmed(rig)
    stage.start_home()
    stage.wait(WITHIN)
    stage.start_move(math.radians(1), math.radians(20))
    degree = stage.limits.counts_per_turn // 360
    assert stage.to_counts(stage.wait(LONG)) == degree
    assert stage.to_counts(stage.position()) == degree
    stage.close()
