"""A pause, a suspender, an abort and a stop of a RunEngine in a step scan: while the stage moves, in an exposure, and
between both. Each point has one event, whose row of the file has the angle of the point."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.instrument.connect import connect
from beamline.storage.writers.rows import ending_in
from drivers.base.errors import DeviceError
from tests.beamline.ball_scan import small
from tests.beamline.bluesky.heard import Heard

pytestmark = pytest.mark.skipif(find_spec("ophyd_async") is None, reason="could not find 'ophyd_async'")
SETTINGS = "recon.live=false", "simulation.clock=real", "scan.exposure_s=0.15"
POINTS = np.linspace(0, 50, 6)  # degrees: a move takes some tenths of a second


@contextmanager
def _scanner(folder: Path) -> Iterator[tuple[Any, Any]]:
    from beamline.bluesky.camera import CameraDetector
    from beamline.bluesky.devices import Rotation

    settings = small(*SETTINGS)
    with connect(settings) as instrument:
        yield CameraDetector(settings, instrument, folder), Rotation(instrument.devices.stage)


def _plan(camera: Any, rotation: Any) -> Any:
    from bluesky import plans

    return plans.list_scan([camera], rotation, POINTS.tolist())


def _at(engine: Any, heard: Heard, command: str, n: int, act: Callable[[], None], after: float) -> None:
    """Call `act` in a thread, so many s after the n-th message of this name to a device."""
    seen = [0]

    def hook(message: Any) -> None:
        seen[0] += message.command == command
        if message.command == command and seen[0] == n:
            threading.Timer(after, act).start()

    engine.msg_hook = hook


def _each_point_once(heard: Heard, folder: Path, status: str = "complete") -> None:
    (path,) = folder.glob("*/scan.h5")
    with h5py.File(path) as file:
        angles = file["entry/sample/rotation_angle"][()]
        assert file["entry/progress/status"].asstr()[()] == status
    assert [event["data"]["rotation"] for event in heard.of("event")] == pytest.approx(POINTS, abs=1e-3)
    assert [event["seq_num"] for event in heard.of("event")] == [*range(1, len(POINTS) + 1)]
    for resource in {datum["stream_resource"] for datum in heard.of("stream_datum")}:
        datums = [datum for datum in heard.of("stream_datum") if datum["stream_resource"] == resource]
        rows = [row for datum in datums for row in range(datum["indices"]["start"], datum["indices"]["stop"])]
        numbers = [n for datum in datums for n in range(datum["seq_nums"]["start"], datum["seq_nums"]["stop"])]
        assert numbers == [*range(1, len(POINTS) + 1)]
        np.testing.assert_allclose(angles[rows], POINTS, atol=1e-3)


MOVES, EXPOSES, BETWEEN = ("set", 0.1), ("trigger", 0.05), ("save", 0.0)


@pytest.mark.parametrize("point", [1, 3])
@pytest.mark.parametrize(("command", "after"), [MOVES, EXPOSES, BETWEEN, ("set", 0.0)])
def test_a_pause_and_a_resume_lose_no_point(
    engine: Any, tmp_path: Path, command: str, after: float, point: int
) -> None:
    from bluesky.utils import RunEngineInterrupted

    heard = Heard()
    engine.subscribe(heard)
    with _scanner(tmp_path) as (camera, rotation):
        _at(engine, heard, command, point, engine.request_pause, after)
        with pytest.raises(RunEngineInterrupted):
            engine(_plan(camera, rotation))
        there = [rotation._stage.position() for _ in range(2) if time.sleep(0.2) is None]
        assert there[0] == there[1]  # the stage stands
        _at(engine, heard, command, 2, engine.request_pause, after)  # and again
        with pytest.raises(RunEngineInterrupted):
            engine.resume()
        engine.resume()
    assert heard.of("stop")[0]["exit_status"] == "success"
    _each_point_once(heard, tmp_path)


@pytest.mark.parametrize(("command", "after"), [MOVES, EXPOSES])
def test_a_suspender_loses_no_point(engine: Any, tmp_path: Path, command: str, after: float) -> None:
    heard = Heard()
    engine.subscribe(heard)

    async def beam_is_back() -> None:
        await asyncio.sleep(0.5)

    with _scanner(tmp_path) as (camera, rotation):
        _at(engine, heard, command, 3, lambda: engine.request_suspend(beam_is_back), after)
        engine(_plan(camera, rotation))
    assert heard.of("stop")[0]["exit_status"] == "success"
    _each_point_once(heard, tmp_path)


@pytest.mark.parametrize("way", ["abort", "stop", "halt"])
@pytest.mark.parametrize("paused", [False, True])
def test_a_plan_that_is_ended_leaves_no_complete_file(engine: Any, tmp_path: Path, way: str, paused: bool) -> None:
    from bluesky.utils import RunEngineInterrupted

    heard = Heard()
    engine.subscribe(heard)
    with _scanner(tmp_path) as (camera, rotation):
        _at(engine, heard, "set", 4, engine.request_pause if paused else getattr(engine, way), 0.1)
        with pytest.raises(RunEngineInterrupted):
            engine(_plan(camera, rotation))
        if paused:
            getattr(engine, way)()
        asyncio.run_coroutine_threadsafe(_closed(camera), engine.loop).result(20)
    (path,) = tmp_path.glob("*/scan.h5")
    with h5py.File(path) as file:
        ending = ending_in(file)
    assert len(heard.of("event")) == 3 and ending.status == "stopped"
    assert ending.reason.startswith("3 frames were taken before the plan ended (")


async def _closed(camera: Any) -> None:
    await camera._frames.ensure_stopped()  # as of a halt, which waits for nothing


def test_a_plan_that_fails_leaves_no_complete_file(engine: Any, tmp_path: Path) -> None:
    with _scanner(tmp_path) as (camera, rotation):

        def fails(name: str, document: dict[str, Any]) -> None:
            if document["seq_num"] == 2:
                raise RuntimeError("enough")

        engine.subscribe(fails, "event")
        with pytest.raises(RuntimeError, match="enough"):
            engine(_plan(camera, rotation))
    (path,) = tmp_path.glob("*/scan.h5")
    with h5py.File(path) as file:
        assert ending_in(file).reason == "2 frames were taken before the plan ended (fail)."


@pytest.mark.parametrize("success", [True, False])
def test_a_stop_ends_a_move_with_or_without_an_error(success: bool) -> None:
    from beamline.bluesky.devices import Rotation

    async def moved(rotation: Any) -> None:
        status = rotation.set(90.0)
        await asyncio.sleep(0.3)
        await rotation.stop(success=success)
        if success:
            await status
        else:
            with pytest.raises(DeviceError, match="stopped short of 90"):
                await status
        there = (await rotation.locate())["readback"]
        assert 0 < there < 90
        await rotation.set(there + 1)  # it moves again
        assert (await rotation.locate())["readback"] == pytest.approx(there + 1, abs=0.01)
        await rotation.stop(success=True)  # while nothing moves
        await asyncio.gather(rotation.set(there + 5), rotation.stop(success=True))
        await rotation.set(there + 2)
        assert (await rotation.locate())["readback"] == pytest.approx(there + 2, abs=0.01)

    with connect(small(*SETTINGS)) as instrument:
        asyncio.run(moved(Rotation(instrument.devices.stage)))
