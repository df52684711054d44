"""PI GCS 2.0 driver: specific behaviour of this controller; common behaviour is tested in conformance."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import RotationStage
from drivers.testing.stages.bench import LONG, SPEED
from tests.drivers.stages.pi_gcs_rig import COUNTS, Rig
from tests.messages import refused


@pytest.fixture
def rig() -> Rig:
    return Rig()


# opening and closing


def test_it_is_a_rotation_stage_and_says_what_it_found(rig: Rig) -> None:
    stage: RotationStage = rig.open()
    described = stage.describe()
    assert "C-863.12" in str(described["identity"])
    assert (described["axis"], described["trigger_output"]) == ("1", "digital output 2")


def test_errors_of_the_past_and_half_a_line_left_over_do_not_matter(rig: Rig) -> None:
    rig.say("XYZ", b"MOV 1 5")
    stage = rig.open()
    assert stage.position() == 0.0


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"axis": "2"}, r"no axis '2', but 1"),
        ({"trigger_line": 7}, r"error 36.*trigger_line"),
        ({"acceleration": 1e4}, r"error 17.*acceleration"),
        ({"counts_per_turn": 100_000}, r"has 90000 counts per turn, which is not a multiple of the configured 100000"),
        ({"counts_per_turn": 0}, "counts_per_turn is 0"),
        ({"max_speed": 0.0}, "max_speed is 0.0"),
        ({"max_speed": 1e-9}, "must be 1e-06 deg/s"),
        ({"acceleration": math.nan}, "acceleration is nan"),
        ({"pulse_width": 1e-3}, "the firmware of a pi_gcs controller fixes the pulse width"),
        ({"first_pulse": "some time"}, "some time"),
    ],
)
def test_settings_that_do_not_fit_are_refused_with_a_remedy(rig: Rig, settings: dict[str, Any], says: str) -> None:
    with pytest.raises((DeviceRefused, ValueError), match=says):
        rig.open(**settings)
    rig.open().close()


def test_counts_that_are_whole_counts_of_the_controllers_will_do(rig: Rig) -> None:
    rig.open(counts_per_turn=COUNTS // 3).close()
    rig = Rig(wire={"unknown": {"SPA?"}})
    rig.open().close()


@pytest.mark.parametrize("vast", ["1.79769e+308", f"{1.7e308:.6f}"])
def test_the_limits_of_an_endless_stage_may_be_as_large_as_numbers_are(rig: Rig, vast: str) -> None:
    rig.spoil = lambda reply: reply.replace(b"720.000000", vast.encode())
    rig.open().close()
    rig.spoil = lambda reply: reply.replace(b"=720.000000", b"=50.0").replace(b"720.000000", vast.encode())
    with refused(DeviceRefused):
        rig.open()


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        ((b"(c)2026 Physik Instrumente", b"(c)2026 Somebody"), "identity of a PI controller"),
        ((b"2.0\n", b"1.1\n"), "does not use GCS 2.0"),
    ],
)
def test_another_controller_on_the_port_is_named(rig: Rig, spoilt: tuple[bytes, bytes], says: str) -> None:
    rig.spoil = lambda reply: reply.replace(*spoilt)
    with pytest.raises(DeviceError, match=says):
        rig.open()
    rig.spoil = lambda reply: reply
    rig.open().close()


def test_where_acc_and_dec_are_missing_parameters_do() -> None:
    rig = Rig(wire={"unknown": {"ACC", "DEC"}})
    rig.open()
    assert (rig.say("SPA? 1 0xB"), rig.say("SPA? 1 0xC")) == ("1 0xB=60.000000", "1 0xC=60.000000")


# moves and the reference


@pytest.mark.parametrize(
    ("reference", "command", "has"),
    [("switch", "FRF", "reference sensor"), ("negative_limit", "FNL", "limit switches")],
)
def test_a_search_for_a_switch_that_is_not_there_is_refused(reference: str, command: str, has: str) -> None:
    rig = Rig(reference_switch=False, limit_switches=False)
    stage = rig.open(reference=reference)
    with pytest.raises(DeviceRefused, match=f"{command} is.*{has}.*Nothing has moved"):
        stage.start_home()
    assert not stage.moving()


def test_a_search_by_the_positive_limit_switch_ends_there() -> None:
    rig = Rig(high=110.0)
    stage = rig.open(reference="positive_limit")
    stage.start_home()
    assert math.degrees(stage.wait(LONG)) == pytest.approx(110.0)


def test_a_search_that_fails_says_so_and_leaves_the_axis_unreferenced() -> None:
    rig = Rig(reference_fails=True, found_at=3.0)
    stage = rig.open()
    stage.start_home()
    with refused(DeviceError):
        stage.wait(LONG)


def test_a_search_ends_a_train(rig: Rig) -> None:
    bench = rig.bench()
    bench.stage.arm(bench.train(1.0, 1.0, 3))
    bench.stage.start_home()
    bench.stage.wait(LONG)
    bench.go(10.0)
    assert bench.pulses() == []


def test_a_servo_that_needs_its_time_is_waited_for() -> None:
    rig = Rig(settle=0.4)
    stage = rig.open()
    stage.start_move(math.radians(10), SPEED)
    begun = rig.clock.now()
    stage.wait(LONG)
    assert rig.clock.now() - begun == pytest.approx(10 / 10 + 10 / 60 + 0.4, abs=0.06)
    assert rig.say("ONT?") == "1=1"


def test_a_servo_that_never_settles_but_is_near_has_arrived() -> None:
    rig = Rig(settle=1e9)
    stage = rig.open()
    stage.start_move(math.radians(10), SPEED)
    assert math.degrees(stage.wait(LONG)) == pytest.approx(10.0)


# what stops a move


def test_a_motion_error_is_named_with_where_it_stands_and_no_move_follows_before_it_was_looked_at() -> None:
    rig = Rig(stall_at=2500)
    stage = rig.open()
    stage.start_move(math.radians(30), SPEED)
    with refused(DeviceError) as e:
        stage.wait(LONG)
    assert "It is at 10.0000 deg, 2500 counts" in str(e.value)
    assert not isinstance(e.value, DeviceTimeout | DeviceRefused)
    with refused(DeviceRefused):
        stage.start_move(math.radians(5), SPEED)
    stage.close()
    stage = rig.open()
    stage.start_move(math.radians(5), SPEED)
    stage.wait(LONG)


@pytest.mark.parametrize(("degrees", "side"), [(30.0, "positive"), (-4.0, "negative")])
def test_a_limit_switch_is_named(degrees: float, side: str) -> None:
    rig = Rig(switch_at=round(math.copysign(500, degrees)))
    stage = rig.open()
    stage.start_move(math.radians(degrees), SPEED)
    with pytest.raises(DeviceError, match=rf"stopped short.*\({side} limit switch\)"):
        stage.wait(LONG)


def test_limits_that_another_program_narrowed_are_the_controllers_to_name() -> None:
    rig = Rig(low=-5.0, high=200.0)
    stage = rig.open(low=math.radians(-5), high=math.radians(200))
    object.__setattr__(rig.controller.box.axis.build, "high", 50.0)
    with refused(DeviceRefused):
        stage.start_move(math.radians(60), SPEED)
    assert not stage.moving()


@pytest.mark.parametrize("code", [504, 1025, 333])
def test_an_error_of_the_motion_is_that_of_its_move_or_told_by_the_next(code: int, rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(5), SPEED)
    rig.controller.box.axis.error = code
    with refused(DeviceError):
        stage.wait(LONG)
    stage.start_move(math.radians(6), SPEED)
    stage.wait(LONG)
    rig.controller.box.axis.error = code
    with pytest.raises(DeviceError, match=rf"error {code}"):
        stage.start_move(math.radians(7), SPEED)
    stage.start_move(math.radians(7), SPEED)
    assert math.degrees(stage.wait(LONG)) == pytest.approx(7, abs=0.01)


def test_an_error_before_opening_is_in_the_description(rig: Rig) -> None:
    rig.controller.box.axis.error = 1024
    stage = rig.open()
    assert "motion error" in str(stage.describe()["found_at_opening"])
    stage.start_move(math.radians(5), SPEED)
    stage.wait(LONG)


def test_other_outputs_can_be_set_and_that_of_the_pulses_cannot(rig: Rig) -> None:
    stage = rig.open()
    output = stage.digital_output(3)
    assert output.name == "stage output 3"
    output.set(True)
    assert rig.controller.box.levels == {1: False, 2: False, 3: True, 4: False}
    assert output.get() is None
    output.set(False)
    assert not rig.controller.box.levels[3]
    with refused(DeviceRefused):
        stage.digital_output(2)
    with refused(DeviceRefused):
        stage.digital_output(9).set(True)
