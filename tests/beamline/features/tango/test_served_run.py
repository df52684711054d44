"""A run as Tango names it: the state of the device, and how sure each value is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from beamline.features.tango.device import device_state, quality
from beamline.page.followed_run import RunValues, StampedValues


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ("idle", "ON"), ("preparing", "INIT"), ("darks", "RUNNING"), ("flats", "RUNNING"), ("taxi", "RUNNING"),
        ("acquiring", "RUNNING"), ("paused", "STANDBY"), ("finishing", "RUNNING"), ("done", "ON"), ("stopped", "ON"),
        ("aborted", "FAULT"), ("failed", "FAULT"), ("died", "FAULT"),
    ],
)  # fmt: skip
def test_states_of_the_device(state: str, expected: str) -> None:
    """An alarm of the monitor is one of the device while the scan runs."""
    values = RunValues(state=state)
    assert device_state(values) == expected
    assert device_state(replace(values, alarms=1)) == ("ALARM" if expected == "RUNNING" else expected)


def test_qualities() -> None:
    stamped = StampedValues(RunValues(warnings=2, alarms=1, stored=3), 100.0)
    assert [quality(stamped, name) for name in ("warnings", "alarms")] == ["ATTR_WARNING", "ATTR_ALARM"]
    assert [quality(stamped, name) for name in ("planned", "rate", "stored")] == ["ATTR_INVALID"] * 2 + ["ATTR_VALID"]
    assert quality(replace(stamped, unread="the disk is gone"), "stored") == "ATTR_INVALID"
