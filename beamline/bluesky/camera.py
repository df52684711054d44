"""The camera as a detector of ophyd-async (StandardDetector), for `count`, step scans and fly scans of other plans.

From stage to unstage, the frames of the camera go into one NXtomo file of this program. If the detector triggers a
frame itself, the frame has the present angle of the stage. If a pulse on a cable exposes a frame, the angle is unknown
(NaN), because only a complete scan of this program (`TomoScan`) knows which pulse exposed which frame.
"""

from __future__ import annotations

import asyncio
import inspect
import math
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from bluesky.run_engine import RunEngine
from ophyd_async.core import (
    AsyncStatus,
    DetectorAcquireLogic,
    DetectorDataLogic,
    DetectorTriggerLogic,
    StandardDetector,
    StreamResourceDataProvider,
    StreamResourceInfo,
    StrictEnum,
    soft_signal_r_and_setter,
    soft_signal_rw,
)

from beamline.bluesky.documents import COLUMNS, file_url
from beamline.config.load import Config
from beamline.config.planned import camera_settings
from beamline.core.errors import InstrumentError
from beamline.core.files import SCAN, create_run_folder
from beamline.instrument.connect import ConnectedDevices
from beamline.monitor.digest import digest
from beamline.scan.preflight import scan_info
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.errors import DeviceTimeout
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraFrame, CameraSettings, TriggerSource

PATIENCE = 5.0
"""s after the exposure at which a frame that the detector triggered counts as lost."""
LOOK_EVERY = 0.2  # s; wait after a request to stop


class ShownFrames(StrictEnum):
    """The kind of the frames. Shutter and sample are moved to suit this kind."""

    PROJECTION = "projection"
    FLAT = "flat"
    DARK = "dark"


class _Frames(DetectorAcquireLogic):
    """Frames between stage and unstage. A thread takes and writes them. `n`, `settings`: number and settings of the
    next frames."""

    def __init__(self, config: Config, instrument: ConnectedDevices, runs: Path | None) -> None:
        self._config, self._instrument = config, instrument
        self._devices, self._clock = instrument.devices, instrument.clock
        self._runs, self._stop, self._ending = runs or Path(config.storage.folder), Event(), asyncio.Lock()
        self._writer: NXtomoWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self._lacking = range(0)  # triggers without a frame, among those requested last
        self.provider: _Rows | None = None
        self.ended_by: Callable[[], str] = lambda: "success"  # how the plan has ended
        self.kind, (self.rows, self._set_rows) = soft_signal_rw(ShownFrames), soft_signal_r_and_setter(int)
        self.settings, self.n, self._apart = CameraSettings(config.scan.exposure_s, TriggerSource.SOFTWARE), 1, 0.0

    async def prepare(self, trigger: TriggerSource, n: int, exposure: float, apart: float = 0.0) -> None:
        """Set the camera. `apart` is the time between exposures in s. Raises DeviceRefused if the camera does not
        accept it."""
        if n < 1:
            raise ValueError(f"the camera was prepared for {n} frames; expected 1 or more")
        wanted = camera_settings(self._config, exposure or self._config.scan.exposure_s, trigger)
        self.settings = await asyncio.to_thread(self._devices.camera.configure, wanted)
        self.n, self._apart = n, apart

    async def new_file(self) -> tuple[Path, tuple[int, int]]:
        """Create the file in the folder of a new run. Also returns the shape of its frames."""
        await self.ensure_stopped()
        self._writer, self._lacking = await asyncio.to_thread(self._created), range(0)
        self._set_rows(0)
        return self._writer.path, self._devices.camera.timing.shape

    def _created(self) -> NXtomoWriter:
        config, shape = self._config, self._devices.camera.timing.shape
        folder = create_run_folder(self._runs, config.sample.name, self._clock.now())
        # meanwhile no other code reads the beam monitor
        info = replace(scan_info(config, self._instrument), beam_unit=None)
        bin_ = config.storage.preview_bin
        return NXtomoWriter(folder / SCAN, info, shape, clock=self._clock, preview_bin=bin_)

    async def start_acquiring(self) -> None:
        """Bring shutter and sample to their positions, arm the camera, and take frames in the background."""
        kind, loop = FrameKind[(await self.kind.get_value()).name], asyncio.get_running_loop()
        self._stop.clear()
        rows = 0 if self._writer is None else self._writer.rows
        self._lacking = range(rows, rows + self.n)
        await asyncio.to_thread(self._arm, kind)
        self._task = asyncio.create_task(asyncio.to_thread(self._take, kind, loop))

    async def wait_for_idle(self) -> None:
        """Wait until the last frame. Raises the error that ended the frames early, if any."""
        if self._task is not None:
            await self._task

    async def refuse_failure(self) -> None:
        """Raise the error that ended the frames early, if there was one."""
        if self._task is not None and self._task.done():
            await self._task

    async def ensure_stopped(self) -> None:
        """Stop and disarm the camera, close shutter and file, and bring the sample back. A second call does nothing."""
        async with self._ending:
            self._stop.set()
            if self._task is not None:
                await asyncio.wait([self._task])
            error = self._task.exception() if self._task is not None else None
            await asyncio.to_thread(self._close, error)
            self._task = None

    def _close(self, error: BaseException | None) -> None:
        """Close shutter and file, and bring the sample back; the file states how many of the requested frames are
        missing, and why.
        """
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                self._devices.shutter.close()
                self._devices.sample.back()
            finally:
                status, reason = "complete", ""
                if error is not None or self._lacking:
                    status = "failed" if error is not None else "stopped"
                    why = f": {error}" if error is not None else ", because the plan ended earlier"
                    reason = f"{writer.rows} of {self._lacking.stop} frames were taken{why}."
                elif (ended_by := self.ended_by()) != "success":
                    status, reason = "stopped", f"{writer.rows} frames were taken before the plan ended ({ended_by})."
                writer.close(status, self._lacking, reason=reason)

    def _arm(self, kind: FrameKind) -> None:
        devices = self._devices
        if kind is FrameKind.DARK:
            devices.shutter.close()
        else:
            devices.sample.out() if kind is FrameKind.FLAT else devices.sample.back()
            devices.shutter.open()
        devices.camera.arm(self.n)

    def _take(self, kind: FrameKind, loop: asyncio.AbstractEventLoop) -> None:
        devices, camera, writer = self._devices, self._devices.camera, self._writer
        assert writer is not None
        by_software, exposure = self.settings.trigger is TriggerSource.SOFTWARE, self.settings.exposure
        period, triggered = max(camera.timing.min_period, exposure + self._apart), -math.inf
        try:
            for i in range(self.n):
                angle = math.nan
                if by_software:
                    angle = math.nan if devices.stage.moving() else devices.stage.position()
                    while (seconds_left := triggered + period - self._clock.now()) > 0 and not self._stop.is_set():
                        self._clock.sleep(min(seconds_left, LOOK_EVERY))
                    if self._stop.is_set():
                        return
                    camera.software_trigger()
                    triggered = self._clock.now()
                if (frame_taken := self._next(exposure + PATIENCE if by_software else math.inf)) is None:
                    return
                if frame_taken.framestamp != i:
                    raise InstrumentError(
                        f"Leave more time between the frames, and repeat the exposures. {camera.name}: frame "
                        f"{frame_taken.framestamp} arrived where frame {i} was expected, so frames were lost. Earlier "
                        "frames are in the file."
                    )
                row = writer.rows
                frame = Frame(np.array(frame_taken.counts), kind, row, row, i, angle, frame_taken.time, exposure)
                writer.append(frame, digest(frame.counts, 2**camera.timing.bits - 1, self._config.storage.preview_bin))
                loop.call_soon_threadsafe(self._set_rows, writer.committed)
        finally:
            self._lacking = range(writer.rows, self._lacking.stop)
            camera.disarm()

    def _next(self, patience: float) -> CameraFrame | None:
        """The next frame; None if the frames must end. Raises DeviceTimeout if no frame comes in time."""
        waited = 0.0
        while not self._stop.is_set():
            try:
                return self._devices.camera.next_frame(min(LOOK_EVERY, patience - waited))
            except DeviceTimeout as error:
                waited += LOOK_EVERY
                if waited >= patience:
                    raise error.told_by(error.device, f"sent no frame for {patience:g} s after the trigger") from error
        return None


class _Trigger(DetectorTriggerLogic):
    def __init__(self, frames: _Frames, instrument: ConnectedDevices) -> None:
        self._frames, self._camera = frames, instrument.devices.camera

    def get_deadtime(self, config_values: Any) -> float:
        return max(0.0, self._camera.timing.min_period - self._frames.settings.exposure)

    async def prepare_internal(self, num: int, livetime: float, deadtime: float) -> None:
        await self._frames.prepare(TriggerSource.SOFTWARE, num, livetime, deadtime)

    async def prepare_edge(self, num: int, livetime: float) -> None:
        await self._frames.prepare(TriggerSource.EXTERNAL, num, livetime)


class _Rows(StreamResourceDataProvider):
    """The rows of the file for events, from `first` on. Earlier rows that no event has used do not belong to any
    event."""

    first = 0

    async def make_stream_docs(self, collections_written: int, collections_per_event: int) -> AsyncIterator[Any]:
        async for name, document in super().make_stream_docs(collections_written, collections_per_event):
            if name == "stream_datum":
                document["indices"]["start"] = max(document["indices"]["start"], self.first)
            yield name, document


class _File(DetectorDataLogic):
    def __init__(self, frames: _Frames) -> None:
        self._frames = frames

    async def prepare_unbounded(self, datakey_name: str) -> _Rows:
        path, frame = await self._frames.new_file()
        resources = [
            StreamResourceInfo(
                data_key=datakey_name + ending, shape=column.row_shape(frame), dtype_numpy=column.kind,
                chunk_shape=(1, *column.row_shape(frame)), source=f"splatline:{column.dataset}",
                parameters={"dataset": column.dataset, "swmr": True},
            )
            for ending, column in COLUMNS.items()
        ]  # fmt: skip
        self._frames.provider = _Rows(file_url(path), resources, "application/x-hdf5", self._frames.rows)
        return self._frames.provider


class CameraDetector(StandardDetector):
    """The configured camera. `kind` is the kind of the next frames. The shutter is closed at the end.

    Args:
        instrument: connected devices, which stay open. runs: folder that contains the folders of runs; default: the
            configured folder.
    """

    def __init__(
        self, config: Config, instrument: ConnectedDevices, runs: Path | None = None, name: str = "camera"
    ) -> None:
        frames, self.config, self.runs = _Frames(config, instrument, runs), config, runs or Path(config.storage.folder)
        self._frames, self.kind, self._triggered = frames, frames.kind, None
        self.add_detector_logics(_Trigger(frames, instrument), frames, _File(frames))
        self.add_config_signals(self.kind)
        super().__init__(name)

    def stage(self) -> Any:
        """Begin. bluesky does not inform a device about the end of its plan, so the camera listens to the RunEngine
        that runs this task."""
        self._triggered, task = None, asyncio.current_task()
        engine = inspect.getcoroutinelocals(task.get_coro()).get("self") if task else None  # type: ignore[arg-type]
        if isinstance(engine, RunEngine):
            stops = list[Mapping[str, Any]]()
            token = engine.subscribe(lambda name, stop: stops.append(stop), "stop")

            def ended_by() -> str:
                engine.unsubscribe(token)
                status = stops[-1]["exit_status"] if stops else "success"
                return str(status if engine.state == "running" else engine.state)

            self._frames.ended_by = ended_by
        return super().stage()

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """End the frames and the file, and stop listening to the RunEngine."""
        await super().unstage()
        self._frames.ended_by()

    def trigger(self) -> Any:
        """Take one frame."""
        self._triggered = super().trigger()
        return self._triggered

    async def pause(self) -> None:
        """Handle a pause. After the pause, the plan repeats everything since its last checkpoint. A frame that is being
        exposed is still written, but no event refers to it."""
        if self._triggered is not None:
            await asyncio.wait([self._triggered.task])  # the first one makes the file
            if self._frames.provider is not None:
                self._frames.provider.first = await self.get_index()

    async def resume(self) -> None:
        """Do nothing, because the plan triggers again."""

    async def _wait_for_index(self, *args: Any, **more: Any) -> AsyncIterator[Any]:
        try:
            async for update in super()._wait_for_index(*args, **more):
                yield update
        except TimeoutError:
            await self._frames.refuse_failure()  # this error says more than that no frame came
            raise
