"""The vendor's own library against the simulated Zaber over TCP: what it sends is understood, what comes back accepted.

An independent judge of packets, checksums, ids, alerts, warnings, outputs and triggers. No device database is needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.base.clock import SystemClock
from simulators.devices.trigger_line import TriggerLine
from tests.drivers.stages.flat_settings import flat
from tests.simulators.wires.transports import serve_tcp
from tests.simulators.wires.zaber.wire import ZaberBuild, ZaberController

pytest.importorskip("zaber_motion", reason="the vendor's library is not installed: pip install '.[oracle]'")

from zaber_motion import CommandFailedException, MovementFailedException, Units
from zaber_motion.ascii import Connection, DigitalOutputAction, TriggerAction, TriggerCondition

NATIVE = Units.NATIVE


class Vendor:
    """The library's view of a simulated stage on real time."""

    def __init__(self, connection: Connection, controller: ZaberController, line: TriggerLine) -> None:
        self.connection, self.controller, self.line = connection, controller, line
        self.device = connection.get_device(1)
        self.axis = self.device.get_axis(1)

    def pulses(self) -> list[int]:
        """Where they were, in microsteps."""
        edges = self.controller.device.triggers.edges
        return [round(edge.position) for edge in edges if (edge.channel, edge.value) == (0, 1)]


def serve(**settings: Any) -> Iterator[Vendor]:
    clock = SystemClock()
    line = TriggerLine(clock)
    controller = flat(ZaberBuild, counts_per_turn=360_000, **settings).controller(clock, line)
    with serve_tcp(controller) as url:
        host, port = url.removeprefix("socket://").split(":")
        with Connection.open_tcp(host, int(port)) as connection:
            connection.default_request_timeout = 5000
            yield Vendor(connection, controller, line)


@pytest.fixture
def vendor() -> Iterator[Vendor]:
    yield from serve()


def fast(vendor: Vendor) -> None:
    vendor.axis.settings.set("maxspeed", 163_840, NATIVE)
    vendor.axis.settings.set("accel", 200, NATIVE)


def test_settings_go_out_and_come_back(vendor: Vendor) -> None:
    vendor.axis.settings.set("maxspeed", 12_345, NATIVE)
    assert vendor.axis.settings.get("maxspeed", NATIVE) == 12_345
    assert vendor.axis.settings.get("limit.cycle.dist", NATIVE) == 360_000
    assert vendor.device.settings.get_string("version") == "7.38"
    with pytest.raises(CommandFailedException):
        vendor.axis.settings.get("limit.nonsense", NATIVE)


@pytest.mark.parametrize("checksums", [0, 1])
def test_moves_arrive_and_the_library_sees_it(vendor: Vendor, checksums: int) -> None:
    fast(vendor)
    vendor.device.generic_command(f"set comm.checksum {checksums}")
    vendor.axis.move_absolute(5000, NATIVE)
    vendor.axis.move_relative(-2000, NATIVE)
    assert vendor.axis.get_position(NATIVE) == 3000
    vendor.axis.move_absolute(200_000, NATIVE, wait_until_idle=False)
    assert vendor.axis.is_busy()
    vendor.axis.stop()
    assert not vendor.axis.is_busy()
    assert 3000 <= vendor.axis.get_position(NATIVE) < 200_000


def test_alerts_end_its_waiting(vendor: Vendor) -> None:
    fast(vendor)
    vendor.connection.enable_alerts()
    vendor.axis.move_absolute(3000, NATIVE)
    assert vendor.axis.get_position(NATIVE) == 3000


def test_homing_and_its_flag() -> None:
    for vendor in serve(homed=False):
        assert vendor.axis.warnings.get_flags() == {"WR"}
        assert not vendor.axis.is_homed()
        vendor.axis.home()
        assert vendor.axis.is_homed()
        assert vendor.axis.warnings.get_flags() == set()


def test_a_stall_is_its_movement_failed_exception() -> None:
    for vendor in serve(stall_at=2000):
        fast(vendor)
        with pytest.raises(MovementFailedException) as failure:
            vendor.axis.move_absolute(9000, NATIVE)
        assert failure.value.details.warnings == ["FS"]
        assert vendor.axis.warnings.get_flags() == set()  # it has cleared them


def test_outputs_and_scheduled_outputs(vendor: Vendor) -> None:
    io = vendor.device.io
    io.set_digital_output(2, DigitalOutputAction.ON)
    assert io.get_all_digital_outputs() == [False, True, False, False]
    assert io.get_digital_output(2)
    io.set_digital_output_schedule(1, DigitalOutputAction.ON, DigitalOutputAction.OFF, 20)
    assert vendor.pulses() == [0]


def test_triggers_give_a_train_and_tell_what_is_left(vendor: Vendor) -> None:
    """The chain that the driver uses, set up by the vendor's library instead."""
    fast(vendor)
    triggers = vendor.device.triggers
    assert (triggers.get_number_of_triggers(), triggers.get_number_of_actions()) == (6, 2)
    starter, repeater = triggers.get_trigger(1), triggers.get_trigger(2)
    repeater.fire_when_distance_travelled(1, 300, NATIVE)
    repeater.on_fire(TriggerAction.A, 0, "io set do 1 1 schedule 1 0")
    starter.fire_when_setting(1, "pos", TriggerCondition.GE, 1000, NATIVE)
    starter.on_fire(TriggerAction.A, 0, "io set do 1 1 schedule 1 0")
    starter.on_fire(TriggerAction.B, 0, "trigger 2 enable 9")
    starter.enable(1)
    assert [(state.enabled, state.fires_remaining) for state in triggers.get_enabled_states()][:2] == [
        (True, 1),
        (False, 0),
    ]
    vendor.axis.move_absolute(1450, NATIVE)
    assert [(state.enabled, state.fires_remaining) for state in triggers.get_enabled_states()][:2] == [
        (False, 0),
        (True, 8),
    ]
    state = repeater.get_state()
    assert (state.condition, state.actions) == (
        "when 1 dist 300",
        ["action a io set do 1 1 schedule 1 0", "action b none"],
    )
    assert (state.enabled, state.fires_total, state.fires_remaining) == (True, 9, 8)
    vendor.axis.move_absolute(9000, NATIVE)
    assert vendor.pulses() == [1000 + 300 * k for k in range(10)]
    assert not any(state.enabled for state in triggers.get_enabled_states())


def test_the_encoder_s_distance_and_an_action_taken_away(vendor: Vendor) -> None:
    fast(vendor)
    trigger = vendor.device.triggers.get_trigger(3)
    trigger.fire_when_encoder_distance_travelled(1, 500, NATIVE)
    trigger.on_fire(TriggerAction.A, 0, "io set do 1 t")
    trigger.enable()
    vendor.axis.move_absolute(2100, NATIVE)
    trigger.disable()
    assert vendor.pulses() == [500, 1500]
    trigger.clear_action(TriggerAction.A)
