"""Zaber driver: specific behaviour of this controller, from identity to faults, and a disturbed line."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import RotationStage
from drivers.stages.zaber.settings import ZaberSettings
from drivers.testing.stages.bench import LONG, SPEED
from simulators.wires.wire import register
from tests.drivers.stages.rig import NAMES
from tests.drivers.zaber_rig import REPLIES_TO_OPEN, Rig
from tests.messages import refused
from tests.simulators.wires.zaber.wire import Fault


@pytest.fixture
def rig() -> Rig:
    return Rig()


# opening and closing


@pytest.mark.parametrize("identity", ["device.id", "deviceid"])
def test_it_is_a_rotation_stage_and_says_what_it_found(identity: str) -> None:
    stage: RotationStage = Rig(identity=identity).open()
    described = stage.describe()
    assert (described["model"], described["serial"], described["firmware"]) == ("Zaber device 50952", "123456", "7.38")
    assert described["pulse_width_s"] == 1e-3


def test_opening_demands_checksums_and_closing_leaves_settings_as_they_were(rig: Rig) -> None:
    rig.say("/1 1 set maxspeed 4321", "/1 1 set motion.accelonly 33", "/1 1 set motion.decelonly 44")
    stage = rig.open()
    assert rig.say("/1 0 get comm.checksum") == "1"
    stage.start_move(0.1, SPEED)
    stage.wait(LONG)
    stage.close()
    settings = ("/1 1 get maxspeed", "/1 1 get motion.accelonly", "/1 1 get motion.decelonly", "/1 0 get comm.checksum")
    assert [rig.say(setting) for setting in settings] == ["4321", "33", "44", "0"]


def test_every_packet_has_a_checksum_and_an_id_of_its_own(rig: Rig) -> None:
    rig.bench().go(3.0)
    forms = [re.fullmatch(r"/1 [01] (\d\d)( [^:]*)?:[0-9A-F]{2}", packet) for packet in rig.sent if packet]
    assert all(forms)
    assert len(forms) > 20
    ids = [int(form[1]) for form in forms if form is not None]
    assert ids == [k % 98 for k in range(len(ids))]


def test_a_real_stages_turn_is_checked() -> None:
    rig = Rig(counts_per_turn=384_000)
    with refused(DeviceRefused):
        rig.open()
    stage = rig.open(counts_per_turn=384_000)
    assert stage.limits.counts_per_turn == 384_000


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"device": 0}, "device is 0"),
        ({"axis": 0}, "axis is 0"),
        ({"output": 0}, "output is 0"),
        ({"toggle": True, "pulse_width": 1e-3}, "choose a width or toggle"),
        ({"acceleration": 1e-6}, "become .* and 0 in the controller"),
        ({"max_speed": 0.0}, "max_speed is 0.0"),
    ],
)
def test_settings_that_it_cannot_have_are_refused_before_anything_is_sent(
    rig: Rig, wrong: dict[str, Any], match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        rig.open(**wrong)
    assert rig.sent == []


def test_another_device_in_the_chain_and_an_axis_that_is_not_there(rig: Rig) -> None:
    with pytest.raises(DeviceTimeout):
        rig.open(device=2)
    with refused(DeviceRefused):
        rig.open(axis=2)
    Rig(address=37).open(device=37).close()


# units


def test_native_units_are_speed_times_a_factor_and_acceleration_ten_thousand_times_less() -> None:
    """384 000 microsteps a turn, 10 deg/s and 100 deg/s²: 10 666.7/s and 106 667/s² times 1.6384."""
    usual = ZaberSettings(counts_per_turn=384_000, max_speed=math.radians(10), acceleration=math.radians(100))
    assert usual.native_limits == (17_476, 17)
    assert replace(usual, speed_unit=1.0).native_limits == (10_667, 10)


# references and faults


def test_a_driver_that_somebody_disabled_is_named(rig: Rig) -> None:
    stage = rig.open()
    rig.say("/1 1 driver disable")
    with refused(DeviceRefused):
        stage.start_move(0.1, SPEED)


def test_a_move_of_somebody_else_is_waited_for_or_named(rig: Rig) -> None:
    stage = rig.open()
    rig.say("/1 1 move abs 20000")
    with refused(DeviceRefused):
        stage.start_move(0.1, SPEED)
    assert math.degrees(stage.wait(LONG)) == pytest.approx(20.0)


SLIPS = [
    ("WS", "stalled and recovered"),
    ("WM", "displaced while at rest"),
    ("NC", "moved by its knob"),
    ("WL", "reached a limit switch at an unexpected position"),
]


@pytest.mark.parametrize(("flag", "words"), SLIPS)
def test_a_slip_during_a_move_is_an_error_of_that_move_though_it_arrived(flag: str, words: str, rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(30), SPEED)
    rig.clock.sleep(1.0)
    rig.controller.device.axis.flags.add(flag)
    with pytest.raises(DeviceError, match=rf"a fault at 30\.0000 deg.*is at 30\.0000 deg.*{words} \({flag}\)"):
        stage.wait(LONG)
    stage.start_move(0.0, SPEED)  # it was told: the next move clears it
    assert stage.wait(LONG) == 0.0


@pytest.mark.parametrize(("flag", "words"), SLIPS)
def test_a_slip_between_two_moves_is_told_once_by_the_next(flag: str, words: str, rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(10), SPEED)
    stage.wait(LONG)
    rig.controller.device.axis.disturb(lambda time: 5_000, flag)
    with pytest.raises(DeviceError, match=rf"disturbed since its last move: {words} \({flag}\).*15\."):
        stage.start_move(math.radians(20), SPEED)
    assert rig.controller.device.axis.position(rig.clock.now()) == 15_000
    stage.start_move(math.radians(20), SPEED)
    assert stage.wait(LONG) == pytest.approx(math.radians(20))


@pytest.mark.parametrize(("flag", "words"), SLIPS)
def test_a_slip_before_opening_is_in_the_description_and_refuses_nothing(flag: str, words: str, rig: Rig) -> None:
    rig.controller.device.axis.flags.add(flag)
    stage = rig.open()
    assert stage.describe()["found_at_opening"] == f"{words} ({flag})"
    stage.start_move(0.1, SPEED)
    assert stage.wait(LONG) == pytest.approx(0.1, abs=1e-4)


def test_a_stop_before_opening_is_not_told_for_the_stage_is_where_it_counts(rig: Rig) -> None:
    """Every scan that is stopped leaves this flag, and the next one would warn of it."""
    stage = rig.open()
    stage.start_move(math.radians(30), SPEED)
    stage.stop()
    stage.close()
    assert "NI" in rig.controller.device.axis.flags
    again = rig.open()
    assert "found_at_opening" not in again.describe()
    again.close()
    rig.controller.device.axis.flags.add("WM")
    assert rig.open().describe()["found_at_opening"] == "displaced while at rest (WM)"  # not NI


class _Bus:
    """Two devices with one address on one line: both hear everything, and both answer."""

    def __init__(self, one: Rig, other: Rig, delay: bool) -> None:
        self.clock, self._devices, self._late, self._delay = one.clock, (one, other), b"", delay

    def receive(self, data: bytes) -> None:
        for device in self._devices:
            device.receive(data)

    def transmit(self) -> bytes:
        first, second = (device.transmit() for device in self._devices)
        if not self._delay:
            return first + second
        late, self._late = self._late, second
        return late + first if first else late


@pytest.mark.parametrize("delay", [False, True], ids=["at once", "after the next request"])
def test_two_devices_with_one_address_are_refused_before_anything_moves(delay: bool) -> None:
    one, other = Rig(), Rig()
    one.url = register(next(NAMES), _Bus(one, other, delay))
    with refused(DeviceError):
        one.open()
    assert one.controller.device.axis.position(one.clock.now()) == 0


def test_other_outputs_can_be_switched_and_that_of_the_pulses_cannot(rig: Rig) -> None:
    stage = rig.open()
    output = stage.digital_output(2)
    output.set(True)
    assert output.get()
    assert rig.say("/1 0 io get do") == "0 1 0 0"
    with refused(DeviceRefused):
        stage.digital_output(1)


# a disturbed line


def test_the_reply_to_another_message_is_named_and_the_next_request_is_in_step_again() -> None:
    stage = Rig(faults={REPLIES_TO_OPEN: Fault.OTHER_ID}).open()
    with refused(DeviceError):
        stage.position()
    assert stage.position() == 0.0


@pytest.mark.parametrize("fault", [Fault.ALERT, Fault.AGAIN])
def test_an_alert_is_passed_over_and_a_request_to_repeat_is_followed(fault: Fault) -> None:
    rig = Rig(faults=dict.fromkeys(range(0, 200, 2), fault))
    bench = rig.bench()
    rig.say("/1 0 set comm.alert 1")
    assert bench.go(5.0) == pytest.approx(5.0)
    assert rig.controller.replies > 20


def test_a_device_that_asks_to_repeat_for_ever_is_named() -> None:
    stage = Rig(faults=dict.fromkeys(range(REPLIES_TO_OPEN, 1000), Fault.AGAIN)).open()
    with refused(DeviceRefused):
        stage.position()


def test_a_stop_that_got_lost_is_noticed(rig: Rig) -> None:
    stage = rig.open()
    stage.start_move(math.radians(100), math.radians(1))
    rig.lose("stop")
    with refused(DeviceTimeout):
        stage.stop()
