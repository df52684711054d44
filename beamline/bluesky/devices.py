"""Devices for a RunEngine (ophyd-async): a whole scan as one flyer, and the rotation stage.

This program runs the scan from trigger to file, in a thread. The RunEngine starts the scan, gets the rows as they are
written, and waits for the end of the scan. Therefore the scan itself detects lost frames, failed devices and a missing
beam. In these cases `complete` fails.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import AsyncIterator, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bluesky import plan_stubs, preprocessors
from bluesky.utils import NoReplayAllowed
from ophyd_async.core import AsyncStatus, Device, WatchableAsyncStatus, WatcherUpdate

from beamline.bluesky.documents import STREAM, ScanStream
from beamline.config.load import Config, resolved_yaml
from beamline.core.errors import ConfigError
from beamline.core.events import Event, RunStarted, Sink
from beamline.core.run_result import RunResult
from beamline.core.stop import StopRequest
from beamline.instrument.connect import ConnectedDevices, connect
from beamline.scan.control import Verb, ask, state_of
from beamline.scan.run import run_scan
from drivers.base.errors import DeviceError
from drivers.base.protocols import RotationStage

POLL = 0.2
"""s between two checks of the rows of the file."""
MARGIN = 10.0
"""s after twice the expected time of a move at which the move counts as failed."""


class TomoScan(Device):
    """A configured scan as flyer and detector. Each kickoff is one scan, in the folder of a new run.

    Args:
        runs: folder that contains the folders of runs; default: the configured folder. instrument: connected devices,
            which stay open; None: each scan opens and closes the devices of the configuration.
    """

    def __init__(
        self, config: Config, runs: Path | None = None, name: str = "tomo", instrument: ConnectedDevices | None = None
    ) -> None:
        super().__init__(name)
        self.config, self.runs, self._instrument = config, runs, instrument
        self._stream, self._stop = ScanStream(config, name), StopRequest()
        self._folder: Path | None = None
        self._planned = 0
        self._task: asyncio.Task[RunResult] | None = None

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Do nothing, because staging moves no device."""
        self._refuse_second()

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop a scan that is still running, as `beamline stop` does, and close its file."""
        task, self._task = self._task, None
        if task is None or not task.done():  # a kickoff may be about to begin a scan
            self._stop.stop("the plan ended")
        if task is not None:
            await asyncio.wait([task])
            task.exception()  # retrieved, so that asyncio does not report it

    async def pause(self) -> None:
        """Pause the scan, as `beamline pause` does, when the plan is paused (also if a suspender pauses it).

        Raises:
            NoReplayAllowed: always if the scan has begun, because a second kickoff would be a second scan.
            ConfigError: the scan does not answer.
        """
        if self._task is not None:
            await self._tell(Verb.PAUSE)
            raise NoReplayAllowed

    async def resume(self) -> None:
        """Resume the paused scan."""
        if self._task is not None:
            await self._tell(Verb.RESUME)

    async def _tell(self, verb: Verb) -> None:
        if self._folder is None:
            return
        try:
            # a disk that does not respond must not block the RunEngine
            answer = await asyncio.to_thread(ask, self._folder, verb)
            while await asyncio.to_thread(answer.state) is None:  # an end of the plan need not wait for it
                await asyncio.sleep(POLL)
        except ConfigError:
            takes = self._task is not None and not self._task.done()
            if takes and not (await asyncio.to_thread(state_of, self._folder)).ended:
                raise

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Start the scan. Raises the errors that occur before its file exists. In case of such an error nothing has
        moved."""
        self._refuse_second()
        self._stop, self._folder = StopRequest(), None
        self._stream = await asyncio.to_thread(ScanStream, self.config, self.name)  # this reads files of angles
        self._task = task = asyncio.create_task(asyncio.to_thread(self._scan))
        while self._folder is None and not task.done():
            await asyncio.sleep(POLL)
        if self._folder is None:
            task.result()

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Wait for the end of the scan. Raises the error of the scan itself: frames are missing, the scan was stopped,
        or a device failed.
        """
        task, began = self._task, time.monotonic()
        if task is None:
            raise RuntimeError(f"{self.name}: call kickoff before complete")
        while not task.done():
            await asyncio.wait([task], timeout=POLL)
            yield WatcherUpdate(
                name=self.name, current=self._stream.rows, initial=0, target=self._planned, unit="frames",
                time_elapsed=time.monotonic() - began,
            )  # fmt: skip
        if self._task is task:  # otherwise it was unstaged, and the plan knows why
            task.result()

    async def describe_collect(self) -> dict[str, Any]:
        return self._stream.data_keys()

    async def get_index(self) -> int:
        """Number of rows that other processes can read."""
        return self._stream.rows

    async def collect_asset_docs(self, index: int | None = None) -> AsyncIterator[Any]:
        for asset in self._stream.assets(self._stream.rows if index is None else index):
            yield asset

    async def describe_configuration(self) -> dict[str, Any]:
        return {f"{self.name}-config": {"source": "splatline", "dtype": "string", "shape": []}}

    async def read_configuration(self) -> dict[str, Any]:
        return {f"{self.name}-config": {"value": resolved_yaml(self.config), "timestamp": time.time()}}

    def _refuse_second(self) -> None:
        if self._task is not None and not self._task.done():
            raise RuntimeError(f"{self.name}: a scan is running; call unstage to end it")

    def _scan(self) -> RunResult:
        sinks: list[Sink] = [self._stream, self._begun]
        return run_scan(self.config, self.runs, sinks, self._stop, instrument=self._instrument)

    def _begun(self, event: Event) -> None:
        if isinstance(event, RunStarted):
            self._planned, self._folder = event.n_frames, event.folder


class Rotation(Device):
    """The rotation stage, with angles in degrees. It moves at its full speed."""

    def __init__(self, stage: RotationStage, name: str = "rotation") -> None:
        super().__init__(name)
        self.limits, self.radians = stage.limits, stage.position()
        self._stage, self._setpoint = stage, math.degrees(self.radians)
        self._one_move, self._ended = threading.Lock(), threading.Event()

    @AsyncStatus.wrap
    async def set(self, value: float) -> None:
        """Move to the angle, and wait until the stage is there or `stop(success=True)` is called. Raises DeviceRefused
        if the angle is beyond the limits, and DeviceError if the stage stopped before reaching the angle."""
        self._setpoint, self._ended = value, (ended := threading.Event())
        await asyncio.to_thread(self._move, math.radians(value), ended)

    async def stop(self, success: bool = True) -> None:
        """Stop the stage. success: True if the stop was intended, for example at a pause of a plan that moves again
        afterwards; the move then ends without an error."""
        if success:
            self._ended.set()
        await asyncio.to_thread(self._stage.stop)

    async def locate(self) -> dict[str, float]:
        return {"setpoint": self._setpoint, "readback": await self._degrees()}

    async def read(self) -> dict[str, Any]:
        return {self.name: {"value": await self._degrees(), "timestamp": time.time()}}

    async def describe(self) -> dict[str, Any]:
        return {self.name: {"source": "splatline:stage", "dtype": "number", "shape": [], "units": "deg"}}

    @property
    def hints(self) -> Mapping[str, list[str]]:
        return {"fields": [self.name]}

    async def _degrees(self) -> float:
        return math.degrees(await asyncio.to_thread(self._stage.position))

    def _move(self, angle: float, ended: threading.Event) -> None:
        stage, limits = self._stage, self._stage.limits
        with self._one_move:  # the stage that was stopped may not be at rest yet
            seconds = abs(angle - stage.position()) / limits.max_speed + limits.max_speed / limits.acceleration
            try:
                if not ended.is_set():
                    stage.start_move(angle, limits.max_speed)
                if ended.is_set():  # by now
                    stage.stop()
                stage.wait(2 * seconds + MARGIN)
            except DeviceError:
                if not ended.is_set() or stage.moving():
                    raise


@contextmanager
def tomography(config: Config, runs: Path | None = None) -> Iterator[tuple[TomoScan, Rotation]]:
    """The instrument of a configuration, connected: its scan and its rotation stage for the plans of a RunEngine."""
    with connect(config) as instrument:
        yield TomoScan(config, runs, instrument=instrument), Rotation(instrument.devices.stage)


def fly(scan: TomoScan, md: Mapping[str, Any] | None = None, flush: float = 0.5) -> Generator[Any, Any, Any]:
    """A plan for one scan, which is one run. `flush`: s between two datums. Returns the uid of the run."""

    @preprocessors.stage_decorator([scan])
    @preprocessors.run_decorator(md={"plan_name": "fly", "detectors": [scan.name], **(md or {})})
    def inner() -> Generator[Any, Any, None]:
        yield from plan_stubs.declare_stream(scan, name=STREAM, collect=True)
        yield from plan_stubs.kickoff(scan, wait=True)
        completed = yield from plan_stubs.complete(scan, wait=False)
        # after a pause, `wait` (as in collect_while_completing) no longer knows what it waits for
        while not completed.done:
            yield from plan_stubs.sleep(flush)
            yield from plan_stubs.collect(scan, name=STREAM)
        yield from plan_stubs.collect(scan, name=STREAM)
        if (error := completed.exception()) is not None:  # raised here if the RunEngine has not raised it already
            raise error

    return (yield from inner())
