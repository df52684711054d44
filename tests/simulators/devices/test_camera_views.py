"""Views of the simulated camera: anomalies count the projections exposed before, not the darks and flats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivers.base.protocols import TriggerSource
from simulators.devices.camera import SimulatedOrcaQuest
from simulators.devices.clock import VirtualClock
from simulators.devices.in_beam import SimulatedSampleMover, SimulatedShutter
from simulators.devices.trigger_line import TriggerLine
from tests.drivers.orca_bench import SETTINGS
from tests.simulators import shots


def test_a_beam_lost_in_view_two_is_lost_in_the_third_projection_whatever_was_taken_between() -> None:
    """And in the flat that is taken just before it: a flat counts to the view that is exposed next."""
    clock, shutter, sample = VirtualClock(), SimulatedShutter(), SimulatedSampleMover()
    scene = shots.scene({"kind": "lost_beam", "views": [2, 3]}, phantom={"kind": "solids", "solids": []})
    camera = SimulatedOrcaQuest(scene, TriggerLine(clock), clock, 5, shutter.is_open, sample.is_in)
    camera.configure(replace(SETTINGS, trigger=TriggerSource.INTERNAL))
    light = ""
    for kind in "dfpfpdfppf":  # dark, flat, projection
        (shutter.close if kind == "d" else shutter.open)()
        (sample.back if kind == "p" else sample.out)()
        camera.arm(1)
        light += ".*"[int(np.median(camera.next_frame(5.0).counts) > 0)]
        camera.disarm()
    assert light == ".****...**"
