"""PI GCS 2.0 driver over real transports: short moves on real time, and the plug."""

from __future__ import annotations

import gc
import math
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any

import pytest
import serial

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.stages.pi_gcs import PiGcsStage
from simulators.serial_url import SCHEME
from simulators.transports import serve_pty, serve_tcp
from simulators.trigger_line import TriggerLine
from simulators.wire import Wire
from tests.drivers.stage_bench import StageBench
from tests.drivers.stages.pi_gcs_rig import USUAL, controller

FAST = math.radians(30)
SOON = 10.0
"""s; a busy machine takes its time."""
Serve = Callable[[Wire], AbstractContextManager[str]]
needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals that pyserial opens")
transports = pytest.mark.parametrize("serve", [pytest.param(serve_pty, marks=needs_pty), serve_tcp])


def real(serve: Serve, plugged: ExitStack, **build: Any) -> StageBench:
    """A stage on real time; closing `plugged` pulls its cable out."""
    clock = SystemClock()
    line = TriggerLine(clock)
    url = plugged.enter_context(serve(controller(clock, line, **build)))
    return StageBench(
        PiGcsStage(url, clock=SystemClock(), **(USUAL | {"acceleration": math.radians(2000)})), clock, line
    )


@transports
def test_a_search_a_move_and_a_train_on_real_time(serve: Serve) -> None:
    with ExitStack() as plugged:
        bench = real(serve, plugged, referenced=False, found_at=0.5)
        stage = bench.stage
        stage.start_home()
        assert stage.wait(SOON) == 0.0
        assert stage.status().homed is True
        stage.arm(bench.train(1.0, 0.1, 60))
        stage.start_move(math.radians(8), FAST)
        assert math.degrees(stage.wait(SOON)) == pytest.approx(8.0)
        assert [stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [250 + 25 * k for k in range(60)]
        stage.close()


@transports
def test_a_stop_on_the_way_stands_short_on_real_time(serve: Serve) -> None:
    with ExitStack() as plugged:
        stage = real(serve, plugged).stage
        stage.start_move(math.radians(90), math.radians(10))
        stage.stop()
        with pytest.raises(DeviceError, match="stopped short"):
            stage.wait(SOON)
        assert 0 <= stage.status().counts < 22_500
        stage.close()


# pyserial leaves a socket that was reset to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
@transports
def test_a_plug_pulled_in_the_middle_of_a_move_is_said(serve: Serve) -> None:
    with ExitStack() as plugged:
        stage = real(serve, plugged).stage
        stage.start_move(math.radians(90), math.radians(1))
        plugged.close()
        for again in (stage.moving, stage.stop, stage.abort):
            with pytest.raises(DeviceError, match=r"may still be doing|no whole reply|still no answer"):
                again()
        stage.close()
    gc.collect()


def test_a_controller_that_nobody_registered_opens_by_its_name() -> None:
    url = SCHEME + "pi_gcs?counts_per_turn=90000&axis=ROT&output=2&referenced=no&latency=0.001"
    stage = PiGcsStage(url, clock=SystemClock(), **(USUAL | {"axis": "ROT"}))
    status = stage.status()
    assert (status.counts, status.moving, status.homed, status.fault) == (0, False, False, "")
    stage.close()
    with pytest.raises(serial.SerialException, match="output=9"):
        serial.serial_for_url(SCHEME + "pi_gcs?output=9")
