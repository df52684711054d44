"""Every stage: impossible values, controllers of other makers, a second program."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import pytest

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED
from tests.drivers.stages.rigs import RIGS, RigOf, every_stage
from tests.messages import refused
from tests.simulators.wires.transports import serve_pty

needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")


# figures


FIGURES: tuple[tuple[str, float], ...] = (
    ("counts_per_turn", 0), ("counts_per_turn", -90_000), ("max_speed", math.inf), ("max_speed", math.nan),
    ("max_speed", 0.0), ("max_speed", -1.0), ("max_speed", 1e300), ("acceleration", math.inf),
    ("acceleration", math.nan), ("acceleration", 0.0), ("low", math.nan), ("low", -math.inf), ("low", 2.0),
    ("high", math.inf), ("high", 1e300), ("timeout", 0.0), ("timeout", math.nan),
)  # fmt: skip


@every_stage
def test_figures_that_no_stage_has_are_refused_before_anything_is_sent(rig_of: RigOf) -> None:
    rig = rig_of()
    heard: list[bytes] = []
    receive = rig.receive
    rig.receive = lambda data: (heard.append(data), receive(data))[1]  # type: ignore[method-assign]
    value: Any
    for name, value in FIGURES:
        with pytest.raises(ValueError, match=rf"{name}|its (speed|acceleration) cannot be|no room|float can resolve"):
            rig.open(**{name: value})
    assert heard == []
    rig.open().close()


@pytest.mark.parametrize("counts", [5000, 36_000, 1 << 23, 100_000_000])
@every_stage
def test_a_count_is_a_count_whether_a_turn_has_few_or_many(rig_of: RigOf, counts: int) -> None:
    rig = rig_of(counts_per_turn=counts)
    fast = math.radians(300) * min(1.0, 1e6 / counts)
    without_home = {"home": None, "home_speed": None} if rig_of is RIGS["pm16c"] else {}
    bench = rig.bench(counts_per_turn=counts, max_speed=fast, acceleration=10 * fast, **without_home)
    stage = bench.stage
    for target in (1, 0, -1, counts // 16, counts // 16 + 1):
        stage.start_move(stage.to_angle(target), fast)
        assert stage.to_counts(stage.wait(LONG)) == target
        assert bench.line.angle_at(bench.clock.now()) == pytest.approx(stage.to_angle(target), rel=1e-12, abs=1e-15)
    first, interval = counts // 16 - counts // 100, -(counts // 200)
    stage.arm(TriggerTrain(first, interval, 3))
    stage.start_move(0.0, fast)
    stage.wait(LONG)
    found = [pulse.angle / (2 * math.pi) * counts for pulse in bench.pulses()]
    assert found == pytest.approx(
        [first, first + interval, first + 2 * interval], abs=0.2
    )  # the clock's float of today
    stage.close()


@every_stage
def test_the_limits_that_the_stage_names_are_those_that_it_has(rig_of: RigOf) -> None:
    rig = rig_of()
    stage = rig.open()
    limits = stage.limits
    named = [math.degrees(figure) for figure in (limits.max_speed, limits.low, limits.high)]
    assert named == pytest.approx([30, -5, 100], rel=1e-3)
    assert 0.9 * math.radians(60) < limits.acceleration <= math.radians(60)
    stage.start_move(math.radians(60), math.radians(30))
    rig.clock.sleep(0.25)
    assert rig.line.angle_at(rig.clock.now()) == pytest.approx(0.5 * limits.acceleration * 0.25**2, rel=1e-5)
    stage.close()


@pytest.mark.parametrize(
    ("maker", "build", "said"),
    [
        ("pm16c", {}, ["REM", "FLB+20000", "BLB-2000", "SETLSB10000000"]),
        ("pi_gcs", {"low": -8.0, "high": 80.0}, []),
        ("zaber", {"low": -8000, "high": 80_000}, []),
    ],
)
def test_limits_in_the_controller_that_leave_no_room_are_respected(maker: str, build: Any, said: list[str]) -> None:
    rig = RIGS[maker](**build)
    for command in said:
        rig.say(command)
    too_low: dict[str, Any] = {"low": math.radians(-8.1), "high": 1.0}
    for limits in (dict[str, Any](), too_low):
        with pytest.raises(DeviceRefused, match=re.escape("-8.0000 deg to 80.0000 deg")):
            rig.open(**limits)
    rig.open(low=math.radians(-8), high=math.radians(80)).close()


@pytest.mark.parametrize(("maker", "unreferenced"), [("pi_gcs", {"referenced": False}), ("zaber", {"homed": False})])
def test_without_a_reference_it_does_not_move_until_it_has_searched_one(maker: str, unreferenced: Any) -> None:
    rig = RIGS[maker](**unreferenced)
    stage = rig.open()
    with refused(DeviceRefused):
        stage.start_move(math.radians(10), SPEED)
    stage.start_home()
    assert stage.wait(LONG) == 0.0
    stage.start_move(math.radians(10), SPEED)
    assert math.degrees(stage.wait(LONG)) == pytest.approx(10.0, abs=0.01)
    assert math.degrees(rig.line.angle_at(rig.clock.now())) == pytest.approx(10.0, abs=0.01)


@pytest.mark.parametrize("maker", ["pi_gcs", "zaber"])
def test_the_configured_serial_number_is_required(maker: str) -> None:
    rig = RIGS[maker]()
    stage = rig.open()
    serial = str(stage.describe()["serial"])
    stage.close()
    rig.open(serial=serial).close()
    with pytest.raises(DeviceRefused, match=rf"another device answered.*{serial}.*42.*swapped.*Nothing has moved"):
        rig.open(serial="42")


# somebody else's controller


@pytest.mark.parametrize("other", RIGS, ids=RIGS.keys())
@every_stage
def test_another_makers_controller_is_an_error_in_time_and_turns_nothing(rig_of: RigOf, other: str) -> None:
    if RIGS[other] is rig_of:
        pytest.skip("its own controller, which it must like")
    mine, theirs = rig_of(), RIGS[other]()
    mine.clock, mine.url = theirs.clock, theirs.url
    before = theirs.clock.now()
    with refused(DeviceError):
        mine.open()
    assert theirs.clock.now() - before < 10.0
    theirs.clock.sleep(60.0)
    assert theirs.line.angle_at(theirs.clock.now()) == 0.0
    assert theirs.line.next_after(-math.inf) is None
    theirs.open().close()


@pytest.mark.parametrize("serve", [None, pytest.param(serve_pty, marks=needs_pty)], ids=["sim", "pty"])
@every_stage
def test_a_second_driver_does_not_get_the_port_and_does_not_disturb_the_first(
    rig_of: RigOf, serve: Callable[[Any], AbstractContextManager[str]] | None
) -> None:
    rig = rig_of()
    with nullcontext(rig.url) if serve is None else serve(rig) as rig.url:
        bench = rig.bench()
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        with pytest.raises(DeviceError, match=r"does not open.*Nothing was sent"):
            rig.open()
        bench.go(10.0)
        assert len(bench.pulses()) == 3
        bench.stage.close()
        rig.open().close()
