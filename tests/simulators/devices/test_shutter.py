"""Simulated shutter and sample mover keep the state that they were last told."""

from __future__ import annotations

from drivers.base.protocols import SampleMover, Shutter
from simulators.devices.in_beam import SimulatedSampleMover, SimulatedShutter


def test_a_shutter_starts_closed_and_follows() -> None:
    shutter = SimulatedShutter()
    as_protocol: Shutter = shutter
    assert not as_protocol.is_open()
    shutter.open()
    shutter.open()
    assert shutter.is_open()
    shutter.close()
    assert not shutter.is_open()


def test_a_sample_starts_in_the_beam_and_comes_back() -> None:
    mover = SimulatedSampleMover()
    as_protocol: SampleMover = mover
    assert mover.is_in()
    as_protocol.out()
    assert not mover.is_in()
    as_protocol.back()
    assert mover.is_in()
