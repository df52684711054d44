"""The ring buffer: each frame is handed out once, in order, or counted as lost, whatever the timing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import CameraFrame, CameraSettings, TriggerSource
from drivers.orca_quest import DcamOptions
from tests.drivers.dcam.fake import World

ROI = (8, 12, 4, 8)
FRAME_BYTES = 4 * 8 * 2
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("pulse"), st.integers(1, 9)),
        st.tuples(st.just("take"), st.integers(1, 9)),
        st.tuples(st.just("drop"), st.integers(1, 3)),  # of the next exposures, on their way
        st.tuples(st.just("overrun_in_lock"), st.integers(1, 6)),  # frames that come while one is copied
    ),
    max_size=30,
)


@given(slots=st.integers(2, 7), steps=STEPS)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_exposure_is_taken_once_in_order_or_counted_as_lost(
    fake_library: Path, slots: int, steps: list[Any]
) -> None:
    world = World(fake_library)
    camera = world.connect(DcamOptions(ring=slots * FRAME_BYTES))
    camera.configure(CameraSettings(0.001, TriggerSource.EXTERNAL, roi=ROI))
    camera.arm(100)
    taken: list[CameraFrame] = []
    errors = 0

    def take(n: int) -> None:
        nonlocal errors
        for _ in range(n):
            before = len(taken)
            for _ in range(2):  # an overrun is reported at most once before a frame comes
                try:
                    taken.append(camera.next_frame(0.0))
                except DeviceTimeout:
                    return
                except DeviceError as error:
                    assert "overrun" in str(error)
                    errors += 1
                    continue
                break
            assert len(taken) == before + 1

    for what, n in steps:
        if what == "pulse":
            world.pulses(n)
        elif what == "take":
            take(n)
        else:
            world.fault(what, n)
    world.fault("overrun_in_lock", 0)
    while True:
        before = len(taken)
        take(1)
        if len(taken) == before:
            break
    stamps = [frame.framestamp for frame in taken]
    overwritten = int(camera.describe()["frames_overwritten"])
    delivered, exposed = world.delivered, world.exposed
    camera.close()
    assert world.live == 0
    assert stamps == sorted(set(stamps))
    assert len(stamps) + overwritten == delivered
    assert all(stamp < exposed for stamp in stamps)
    assert (errors > 0) == (overwritten > 0)
    for frame in taken:
        np.testing.assert_array_equal(frame.counts, world.pattern(frame.framestamp, ROI))
