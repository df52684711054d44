"""The camera alone in bluesky plans: it writes our file format, emits valid documents, and names lost frames."""

import math
from collections.abc import Generator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.instrument.connect import connect
from beamline.storage.writers.rows import ScanEnding, ending_in
from drivers.base.protocols import TriggerTrain
from tests.beamline import ran
from tests.beamline.ball_scan import small
from tests.beamline.bluesky.heard import Heard
from tests.beamline.fakes import FakeInstrument, Faults

pytestmark = pytest.mark.skipif(find_spec("ophyd_async") is None, reason="could not find 'ophyd_async'")
N = 5


def _file(runs: Path) -> Path:
    (path,) = runs.glob("*/scan.h5")
    return path


def _flown(camera: Any, n: int, livetime: float = 0.0, timeout: float = 10.0) -> Generator[Any, Any, None]:
    """What a fly plan does: prepare, kickoff, collect, complete."""
    from bluesky import plan_stubs, preprocessors
    from ophyd_async.core import TriggerInfo

    @preprocessors.stage_decorator([camera])
    @preprocessors.run_decorator()
    def inner() -> Generator[Any, Any, None]:
        yield from plan_stubs.prepare(
            camera, TriggerInfo(number_of_events=n, livetime=livetime, exposure_timeout=timeout), wait=True
        )
        yield from plan_stubs.declare_stream(camera, name="primary", collect=True)
        yield from plan_stubs.kickoff(camera, wait=True)
        yield from plan_stubs.collect_while_completing([camera], [camera], flush_period=0.1, stream_name="primary")

    yield from inner()


def test_a_step_scan_of_bluesky_becomes_a_scan_file_with_angles(engine: Any, tmp_path: Path) -> None:
    from bluesky import plan_stubs, plans, preprocessors

    from beamline.bluesky.camera import CameraDetector
    from beamline.bluesky.devices import Rotation

    unmoved = "devices.filter={kind: simulated, places: [none, Al]}", "scan.filter=Al"
    heard, settings = Heard(), small("recon.live=false", "simulation.clock=virtual", *unmoved)
    engine.subscribe(heard)
    with ExitStack() as held:
        instrument = held.enter_context(connect(settings))
        camera, rotation = CameraDetector(settings, instrument, tmp_path), Rotation(instrument.devices.stage)

        @preprocessors.stage_decorator([camera])
        @preprocessors.run_decorator()
        def plan() -> Generator[Any, Any, None]:
            for kind, places in (("dark", [0.0]), ("flat", [0.0]), ("projection", [0.0, 30.0, 60.0])):
                yield from plan_stubs.abs_set(camera.kind, kind, wait=True)
                for place in places:
                    yield from plan_stubs.mv(rotation, place)
                    yield from plan_stubs.trigger_and_read([camera, rotation])

        engine(plan())
        assert not instrument.devices.shutter.is_open()
        engine(plans.count([camera], 2))
    first, second = sorted(tmp_path.glob("*/scan.h5"))
    with h5py.File(first) as file:
        kinds, angles = file["entry/frame_log/kind"][()], file["entry/sample/rotation_angle"][()]
        frames = file["entry/instrument/detector/data"][()].astype(float)
        assert file["entry/progress/status"].asstr()[()] == "complete"
        assert "entry/instrument/filter" not in file  # nobody moved it
    np.testing.assert_array_equal(kinds, [2, 1, 0, 0, 0])
    np.testing.assert_allclose(angles, [0, 0, 0, 30, 60], atol=1e-3)
    dark, flat, *views = frames
    assert flat.mean() > 5 * dark.mean()
    for view in views:
        assert (view < 0.8 * flat).any()  # the ball
    np.testing.assert_array_equal(heard.read("camera", 0), frames)
    np.testing.assert_allclose(heard.read("camera-angle", 0), angles)
    turned = [event["data"]["rotation"] for event in heard.of("event")[:N]]
    assert turned == pytest.approx([0, 0, 0, 30, 60], abs=1e-3)
    with h5py.File(second) as file:
        assert len(file["entry/frame_log/kind"]) == 2


def test_it_flies_by_its_own_trigger(engine: Any, tmp_path: Path) -> None:
    from beamline.bluesky.camera import CameraDetector

    heard, settings = Heard(), small("recon.live=false", "simulation.clock=virtual")
    engine.subscribe(heard)
    with connect(settings) as instrument:
        engine(_flown(CameraDetector(settings, instrument, tmp_path), N, livetime=0.03))
    with h5py.File(_file(tmp_path)) as file:
        np.testing.assert_allclose(file["entry/instrument/detector/count_time"][()], 0.03, rtol=0.01)
        frames = file["entry/instrument/detector/data"][()]
    assert len(frames) == N
    np.testing.assert_array_equal(heard.read("camera"), frames)
    (stop,) = heard.of("stop")
    assert (stop["exit_status"], stop["num_events"]) == ("success", {"primary": N})


def test_it_flies_by_the_pulses_of_a_stage_and_says_no_angle(engine: Any, tmp_path: Path) -> None:
    from bluesky import plan_stubs, preprocessors
    from ophyd_async.core import DetectorTrigger, TriggerInfo

    from beamline.bluesky.camera import CameraDetector

    heard, settings = Heard(), small("recon.live=false", "simulation.clock=real")
    engine.subscribe(heard)
    with connect(settings) as instrument:
        camera, stage = CameraDetector(settings, instrument, tmp_path), instrument.devices.stage

        @preprocessors.stage_decorator([camera])
        @preprocessors.run_decorator()
        def plan() -> Generator[Any, Any, None]:
            by_cable = TriggerInfo(
                number_of_events=N, trigger=DetectorTrigger.EXTERNAL_EDGE, livetime=0.01, deadtime=0.05
            )
            yield from plan_stubs.prepare(camera, by_cable, wait=True)
            yield from plan_stubs.declare_stream(camera, name="primary", collect=True)
            yield from plan_stubs.kickoff(camera, wait=True)
            step = stage.to_counts(math.radians(1))
            stage.arm(TriggerTrain(5 * step, step, N))
            stage.start_move(math.radians(15), math.radians(10))
            yield from plan_stubs.collect_while_completing([camera], [camera], flush_period=0.1, stream_name="primary")

        engine(plan())
        stage.wait(10)
    with h5py.File(_file(tmp_path)) as file:
        assert np.isnan(file["entry/sample/rotation_angle"][()]).all()
        np.testing.assert_allclose(np.diff(file["entry/frame_log/time"][()]), 0.1, atol=0.02)
    assert len(heard.read("camera")) == N


def test_a_lost_frame_fails_the_plan_and_leaves_the_shutter_closed(engine: Any, tmp_path: Path) -> None:
    from beamline.bluesky.camera import CameraDetector

    heard, instrument = Heard(), FakeInstrument(Faults(lost={2}))
    engine.subscribe(heard)
    camera = CameraDetector(ran.small(), instrument.connected(), tmp_path)
    with pytest.raises(Exception) as failed:
        engine(_flown(camera, N, timeout=1.0))
    told = "".join(map(repr, [failed.value, failed.value.__cause__, *failed.value.args]))
    assert "DeviceTimeout" in told or "frames are lost" in told
    assert not instrument.is_open and heard.of("stop")[0]["exit_status"] == "fail"
    with h5py.File(_file(tmp_path)) as file:
        assert (file["entry/progress/status"].asstr()[()], len(file["entry/frame_log/kind"])) == ("failed", 2)
        ending = ending_in(file)
    assert ending.missing == (2, 3, 4) and ending.reason.startswith("2 of 5 frames were taken: ")


def test_a_plan_that_ends_before_its_frames_leaves_a_stopped_scan(engine: Any, tmp_path: Path) -> None:
    from bluesky import plan_stubs, preprocessors
    from ophyd_async.core import DetectorTrigger, TriggerInfo

    from beamline.bluesky.camera import CameraDetector

    camera = CameraDetector(ran.small(), FakeInstrument().connected(), tmp_path)

    @preprocessors.stage_decorator([camera])
    @preprocessors.run_decorator()
    def plan() -> Generator[Any, Any, None]:
        by_cable = TriggerInfo(number_of_events=N, trigger=DetectorTrigger.EXTERNAL_EDGE, livetime=0.01, deadtime=0.05)
        yield from plan_stubs.prepare(camera, by_cable, wait=True)
        yield from plan_stubs.declare_stream(camera, name="primary", collect=True)
        yield from plan_stubs.kickoff(camera, wait=True)  # and no pulse comes

    engine(plan())
    with h5py.File(_file(tmp_path)) as file:
        assert ending_in(file) == ScanEnding(
            "stopped", tuple(range(N)), "0 of 5 frames were taken, because the plan ended earlier."
        )


@pytest.mark.parametrize("n", [0, 2])
def test_nothing_of_a_staging_stays_with_the_engine(engine: Any, tmp_path: Path, n: int) -> None:
    """Also of one without a file, and of one whose frames are not all taken."""
    from bluesky import plan_stubs

    from beamline.bluesky.camera import CameraDetector

    settings = small("recon.live=false", "simulation.clock=virtual")

    def staged(camera: Any) -> Generator[Any, Any, None]:
        yield from plan_stubs.stage(camera)
        yield from plan_stubs.unstage(camera, wait=True)

    with ExitStack() as held:
        camera = CameraDetector(settings, held.enter_context(connect(settings)), tmp_path)
        before = len(engine.dispatcher._token_mapping)
        for _ in range(3):
            engine(_flown(camera, n) if n else staged(camera))
        assert len(engine.dispatcher._token_mapping) == before
