"""A motor record that does not fit, is stopped by hand, hits a switch, or loses its controller or IOC."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from uuid import uuid4

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.epics.wire import MotorRecord
from simulators.wires.wire import register
from tests.drivers.soft_ioc import PREFIX, TickingClock, record_of, serve_pva
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat
from tests.messages import refused

SPEED = math.radians(10)


def _record(**build: Any) -> tuple[MotorRecord, str, TickingClock]:
    clock = TickingClock()
    record = record_of(clock, TriggerLine(clock), **build)
    return record, register(f"epics-{uuid4().hex}", record), clock


def _stage(url: str, clock: TickingClock, **settings: Any) -> EpicsStage:
    return EpicsStage(url, flat(EpicsSettings, **(USUAL | settings)), clock)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        ({"unit": "mm"}, r"its unit \(EGU\) is 'mm', expected 'deg'"),
        ({"counts_per_turn": 36_000}, r"the step of the motor record \(MRES\) is 0.01 deg, expected 0.001"),
        (
            {"fastest": 20.0},
            r"the maximum speed of the motor record \(VMAX\) is 20, below the maximum speed of 30 deg/s in the conf",
        ),
        ({"low": -5.0, "high": 99.0}, r"limited to -5.0000 deg to 99.0000 deg.*widen LLM and HLM"),
    ],
)
def test_a_record_that_does_not_fit_is_refused_before_anything_is_written(build: dict[str, Any], said: str) -> None:
    record, url, clock = _record(**build)
    before = dict(record.state)
    with pytest.raises(DeviceRefused, match=f"{said}.*Nothing has moved"):
        _stage(url, clock)
    assert record.state == before


def test_a_linear_axis_is_taken_in_its_own_unit() -> None:
    record, url, clock = _record(unit="mm", low=-5.0, high=100.0)
    stage = _stage(url, clock, unit="mm")
    stage.start_move(math.radians(12.5), SPEED)
    stage.wait(60)
    assert record.state[".VAL"] == pytest.approx(12.5)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [(".SPMG", 0.0, r"m?\.SPMG is Stop"), (".SPMG", 1.0, "is Pause"), (".SET", 1.0, "is Set")],
)
def test_a_record_that_would_take_a_place_without_a_move_is_refused(field: str, value: float, said: str) -> None:
    record, url, clock = _record()
    stage = _stage(url, clock)
    record.state[field] = value
    with pytest.raises(DeviceRefused, match=f"{said}.*on purpose.*Nothing has moved"):
        stage.start_move(0.1, SPEED)
    assert record.state[".VAL"] == 0.0 and record.motor.position() == 0


def test_limits_that_were_narrowed_meanwhile_are_told() -> None:
    record, url, clock = _record(low=-10.0, high=110.0)
    stage = _stage(url, clock)
    record.state[".HLM"] = 5.0
    with pytest.raises(DeviceRefused, match=r"LVIO.*HLM and LLM.*Nothing has moved"):
        stage.start_move(math.radians(20), SPEED)
    assert not stage.moving()


def test_a_limit_switch_ends_the_move_with_its_name() -> None:
    _, url, clock = _record(switch_at=10_000)
    stage = _stage(url, clock)
    stage.start_move(math.radians(20), SPEED)
    with pytest.raises(
        DeviceError, match=r"stopped short of 20.*Move the stage off.*stands at 10.0000 deg.*upper limit switch"
    ):
        stage.wait(60)


def test_a_controller_that_is_lost_is_never_taken_for_standing() -> None:
    record, url, clock = _record()
    stage = _stage(url, clock)
    stage.start_move(math.radians(20), SPEED)
    record.broken = True
    for act in (stage.moving, stage.position, lambda: stage.wait(60)):
        with pytest.raises(DeviceError, match=r"RBV.*is not known"):
            act()


def test_halt_stops_the_move_of_a_program_that_died() -> None:
    record, url, clock = _record()
    _stage(url, clock).start_move(math.radians(20), SPEED)
    clock.sleep(1)
    EpicsStage.halt(url, flat(EpicsSettings, **USUAL), clock)
    clock.sleep(1)
    assert not record.motor.moving() and record.motor.position() < 15_000


def test_it_gives_no_pulses_and_no_output() -> None:
    _, url, clock = _record()
    stage = _stage(url, clock)
    with refused(DeviceRefused):
        stage.digital_output(2)
    assert not stage.limits.trigger_output


def test_an_ioc_that_never_was_or_is_gone_is_an_error_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("p4p")
    clock = TickingClock()
    record = record_of(clock, TriggerLine(clock))
    with serve_pva(record, clock, monkeypatch) as ioc:
        with refused(DeviceTimeout):
            _stage("pva://nobody", clock, timeout=0.3)
        stage = _stage(f"pva://{PREFIX}", clock, timeout=1.0)
        stage.start_move(math.radians(20), SPEED)
        ioc.stop()
        with refused(DeviceTimeout):
            stage.wait(60)
        with pytest.raises(DeviceTimeout):
            stage.stop()
        stage.close()


@pytest.mark.parametrize("build", [{"late": 0.6}, {"early": 0.6}, {"late": 0.6, "early": 0.6}], ids=str)
def test_a_done_that_falls_late_or_comes_early_ends_no_move(build: dict[str, float]) -> None:
    record, url, clock = _record(**build)
    stage = _stage(url, clock)
    stage.start_move(math.radians(20), SPEED)
    while stage.moving():
        clock.sleep(0.02)
    assert math.degrees(stage.wait(0.02)) == pytest.approx(20, abs=0.01)
    assert abs(record.motor.position() - 20_000) <= 10


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda record: record.write(".SPMG", "Pause"), r"SPMG is Pause: somebody paused"),
        (lambda record: record.write(".STOP", 1), r"no reason given"),
        (lambda record: record.write(".VAL", 3.0), r"VAL is 3\.0: another client sent the motor somewhere else"),
    ],
    ids=["paused", "stopped", "sent elsewhere"],
)
def test_what_ends_a_move_on_the_way_is_named_and_stands_is_said_of_what_was_seen_to_stand(
    act: Callable[[MotorRecord], None], said: str
) -> None:
    record, url, clock = _record()
    stage = _stage(url, clock)
    stage.start_move(math.radians(20), SPEED)
    clock.sleep(0.5)
    act(record)
    with pytest.raises(DeviceError, match=rf"stopped short of 20.*It stands at .*{said}"):
        stage.wait(60)
    before = record.motor.position()
    clock.sleep(10)
    assert record.motor.position() == before


def test_a_disabled_record_that_takes_no_value_is_named() -> None:
    record, url, clock = _record()
    stage = _stage(url, clock)
    record.write(".DISP", 1)
    stage.start_move(math.radians(20), SPEED)
    with pytest.raises(DeviceError, match=r"0\.0000 deg, 0 counts: DISP is 1,"):
        stage.wait(60)
    stage.close()
