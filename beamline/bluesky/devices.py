"""Devices for a RunEngine (ophyd-async): a whole scan as one flyer, and the rotation stage.

The scan is ours from trigger to file, in a thread: the RunEngine starts it, is told its rows as they are written, and
waits for its end. So lost frames, a device that fails, and a missing beam are found by the scan, and fail `complete`.
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
"""s between two looks at the rows of the file."""
MARGIN = 10.0
"""s beyond twice the time of a move after which it has failed."""


class TomoScan(Device):
    """A configured scan as flyer and detector; each kickoff is one scan, in a new run folder.

    Args:
        runs: folder of the run folders; the configured one unless given.
        instrument: connected devices, which stay open; None: each scan opens and closes those of the configuration.
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
        """Do nothing: staging moves no device."""
        self._refuse_second()

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop a scan that is still running, as `beamline stop` does, and close its file."""
        task, self._task = self._task, None
        if task is None or not task.done():  # a kickoff may be about to begin one
            self._stop.stop("the plan ended")
        if task is not None:
            await asyncio.wait([task])
            task.exception()  # looked at, so that asyncio does not report it

    async def pause(self) -> None:
        """Pause the scan, as `beamline pause` does, when the plan is paused, also by a suspender.

        Raises:
            NoReplayAllowed: always once the scan has begun: a second kickoff would be a second scan.
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
            asked = await asyncio.to_thread(ask, self._folder, verb)  # a disk that hangs must not hold the RunEngine
            while await asyncio.to_thread(asked.state) is None:  # an end of the plan need not wait for it
                await asyncio.sleep(POLL)
        except ConfigError:
            takes = self._task is not None and not self._task.done()
            if takes and not (await asyncio.to_thread(state_of, self._folder)).ended:
                raise

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Start the scan. Raises the errors that occur before its file exists; nothing has moved then."""
        self._refuse_second()
        self._stop, self._folder = StopRequest(), None
        self._stream = await asyncio.to_thread(ScanStream, self.config, self.name)  # which reads files of angles
        self._task = task = asyncio.create_task(asyncio.to_thread(self._scan))
        while self._folder is None and not task.done():
            await asyncio.sleep(POLL)
        if self._folder is None:
            task.result()

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Wait for the end of the scan. Raises the scan's own error: frames are missing, it was stopped, a device
        failed.
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
        if self._task is task:  # else it was unstaged: the plan knows why
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
    """The rotation stage, in degrees, at its full speed."""

    def __init__(self, stage: RotationStage, name: str = "rotation") -> None:
        super().__init__(name)
        self.limits, self.radians = stage.limits, stage.position()
        self._stage, self._setpoint = stage, math.degrees(self.radians)
        self._one_move, self._ended = threading.Lock(), threading.Event()

    @AsyncStatus.wrap
    async def set(self, value: float) -> None:
        """Move to the angle and wait, until it is there or `stop(success=True)`. Raises DeviceRefused beyond the
        limits, DeviceError if the stage stopped short."""
        self._setpoint, self._ended = value, (ended := threading.Event())
        await asyncio.to_thread(self._move, math.radians(value), ended)

    async def stop(self, success: bool = True) -> None:
        """Stop the stage. success: it was meant, as at each pause of a plan, which moves again afterwards: the move
        ends without an error."""
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
        with self._one_move:  # the one that was stopped may not stand yet
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
    """A plan: one scan, one run. `flush`: s between two datums. Returns the uid of the run."""

    @preprocessors.stage_decorator([scan])
    @preprocessors.run_decorator(md={"plan_name": "fly", "detectors": [scan.name], **(md or {})})
    def inner() -> Generator[Any, Any, None]:
        yield from plan_stubs.declare_stream(scan, name=STREAM, collect=True)
        yield from plan_stubs.kickoff(scan, wait=True)
        completed = yield from plan_stubs.complete(scan, wait=False)
        while not completed.done:  # a pause makes `wait`, as in collect_while_completing, forget what it waits for
            yield from plan_stubs.sleep(flush)
            yield from plan_stubs.collect(scan, name=STREAM)
        yield from plan_stubs.collect(scan, name=STREAM)
        if (error := completed.exception()) is not None:  # if the RunEngine has not raised it already
            raise error

    return (yield from inner())
