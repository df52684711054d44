"""Simulated PM16C: the search for the home switch, and the preset of the counter."""

from __future__ import annotations

import math

import pytest

from tests.simulators.pm16c_host import ACCELERATION, TURN, Wire

# the home switch


def searching(at: int | None) -> Wire:
    wire = Wire(home_at=at)
    wire.tell("SPDH01000")
    return wire


@pytest.mark.parametrize("at", [30_000, -30_000])
def test_a_search_passes_the_switch_remembers_it_and_stands_v_squared_over_2a_beyond(at: int) -> None:
    wire = searching(at)
    assert wire.ask("SHP?0") == "NO H.P"
    wire.tell("FDHP0")
    wire.clock.sleep(30.0)
    assert wire.ask("SHP?0") == "NO H.P"
    assert wire.ask("STS0?")[2] == ("P" if at > 0 else "N")
    wire.clock.sleep(0.1)
    assert int(wire.ask("SHP?0")) == at
    wire.clock.sleep(60.0)
    assert int(wire.ask("PS?0")) == at + math.copysign(1000**2 / (2 * ACCELERATION), at)
    wire.run("GTHP0")
    assert int(wire.ask("PS?0")) == at


def test_a_new_search_forgets_the_old_one_and_a_move_does_not() -> None:
    wire = searching(500)
    wire.run("FDHP0")
    wire.run("ABS0+20000")
    assert wire.ask("SHP?0") == "+0000500"
    wire.tell("FDHP0")
    assert wire.ask("SHP?0") == "NO H.P"


def test_a_limit_between_here_and_the_switch_ends_the_search() -> None:
    wire = searching(30_000)
    wire.tell("FL0+500", "SETLS010000000")
    wire.run("FDHP0")
    assert (wire.ask("STS0?"), wire.ask("SHP?0")) == ("R0S020+0000500", "NO H.P")


# the preset


def test_the_past_is_not_turned_by_a_preset() -> None:
    wire = Wire()
    wire.run("ABS0+100000")
    wire.tell("PS0-5")
    assert wire.line.angle_at(0.5) == pytest.approx(2 * math.pi * 1250 / TURN)


def test_a_preset_needs_a_motor_that_stands_and_is_not_armed() -> None:
    wire = Wire()
    wire.train(100, 200, 10)
    assert wire.ask("PS0+7", "PS?0") == "+0000000"
    wire.tell("TMGC0", "ABS0+10000", "PS0+7")
    wire.clock.sleep(60.0)
    assert wire.ask("PS?0") == "+0010000"
    assert wire.ask("ERRC", "PS0+2147483648", "ERRF?") == "01"
