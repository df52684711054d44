"""Fuzz of the PM16C driver: whatever the controller seems to say, calls end in time, and nothing but DeviceError."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceError
from drivers.protocols import StageStatus, TriggerTrain
from drivers.stages.pm16c import PM16CStage
from simulators.serial_url import register
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed, plans
from tests.drivers.pm16c_rig import NAMES, QUERIES_TO_OPEN, Rig

TIMEOUT = 0.2
LONG = 2.0
WITHIN = 60.0
"""s; far more than all queries of a call can take, each of which ends by its timeout."""
SAMPLES = [
    b"1.50 17-04-01 PM16C-04XDL-SIMULATED\r\n",
    b"RBS000+0000000\r\n",
    b"RBP007+0000100\r\n",
    b"RBS040-0000100\r\n",
    b"RBS---+2147483647\r\n",
    b"B123\r\n",
    b"+0000000\r\n",
    b"-0000135\r\n",
    b"0002500\r\n",
    b"017\r\n",
    b"HSPD\r\n",
    b"YES\r\n",
    b"NO\r\n",
    b"NO H.P\r\n",
    b"R4\r\n",
    b"NO ERROR\r\n",
    b"00000000\r\n",
    b"STOPB\r\n",
]
CALLS: list[Any] = [
    lambda stage: stage.position(),
    lambda stage: stage.status(),
    lambda stage: stage.moving(),
    lambda stage: stage.start_move(math.radians(20), math.radians(20)),
    lambda stage: stage.start_home(),
    lambda stage: stage.wait(LONG),
    lambda stage: stage.arm(TriggerTrain(500, 25, 20)),
    lambda stage: stage.disarm(),
    lambda stage: stage.stop(),
    lambda stage: stage.abort(),
]


def opened(rig: Rig, wire: FuzzedWire) -> PM16CStage | DeviceError:
    rig.url = register(next(NAMES), wire)
    return allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    rig = Rig()
    wire = FuzzedWire(rig.controller, plan)
    stage = opened(rig, wire)
    if isinstance(stage, DeviceError):
        wire.end()
        rig.clock.sleep(10.0)
        found = allowed(lambda: rig.open(timeout=TIMEOUT), rig.clock, WITHIN)
        assert isinstance(found, PM16CStage)
        found.close()
    else:
        stage.close()


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Any]
) -> None:
    rig = Rig(home_at=300)
    quiet: list[Pieces | None] = [None] * QUERIES_TO_OPEN
    wire = FuzzedWire(rig.controller, quiet + plan)
    stage = opened(rig, wire)
    assert isinstance(stage, PM16CStage)
    for call in calls:
        result = allowed(lambda: call(stage), rig.clock, WITHIN)  # noqa: B023
        assert isinstance(result, None | bool | float | StageStatus | DeviceError)
    wire.end()
    rig.clock.sleep(10.0)
    for _ in range(3):  # what had come before, its remains, and then the stop itself
        stopped = allowed(stage.stop, rig.clock, WITHIN)
    assert not isinstance(stopped, DeviceError)
    assert not rig.controller.box.sample.moving()
    assert stage.status().counts == rig.controller.box.sample.position()
    stage.start_move(math.radians(1), math.radians(20))
    assert stage.to_counts(stage.wait(LONG)) == 250
    stage.close()
