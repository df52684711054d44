"""Simulated ORCA-Quest: exposes the scene at the true angle of each trigger, with the timing of the real camera.

Nothing runs in the background. On each call, the camera catches up with the trigger line and the clock. A frame is
computed when it is read. For faults and noise, the camera numbers triggers and frames over its whole life, so that any
frame can be computed again alone. Framestamps start at 0 with every arm.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Set
from dataclasses import dataclass, replace

import numpy as np

from drivers import orca_quest
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource
from simulators.devices.in_beam import CameraView, Exposed
from simulators.devices.trigger_line import TriggerLine
from simulators.effects.chain import AnomalyLabel
from simulators.frame.sensor import CONVERSION, OFFSET
from simulators.frame.shot import CannotExposeError, Detector
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene

# s between two checks of the trigger line while waiting, because a stop may cancel pulses and a move may add some
POLL = 0.02
TOLERANCE = 1e-6  # s by which a trigger may come too early; a float64 of seconds since 1970 resolves 2e-7 s


@dataclass(frozen=True)
class OrcaQuestBuild:
    """A simulated camera, and its faults.

    Attributes:
        pixel_pitch: size of an unbinned sensor pixel at the sample in mm.
        ring_frames: number of frames in the ring buffer; a reader that falls further behind loses the oldest frames.
        lost: frames (numbered over the life of the camera) that are exposed and then lost, which leaves a gap in the
            framestamps.
        ignored: external or software triggers to which the camera does not react, so that there is no frame and no
            framestamp. They are also numbered over the life of the camera, counting all triggers for which it was ready
            (also internal ones).
        unplug_at: frame at which the camera is unplugged.
        model: one of `drivers.orca_quest.LINE_TIMES`.
    """

    pixel_pitch: float = orca_quest.PITCH_MM
    ring_frames: int = 128
    lost: Set[int] = frozenset()
    ignored: Set[int] = frozenset()
    unplug_at: int | None = None
    name: str = "camera"
    model: str = orca_quest.MODEL


_USUAL = OrcaQuestBuild()


class SimulatedOrcaQuest:
    """Implements drivers.base.protocols.Camera.

    External triggers come from `line`. Like the real camera, it silently ignores a trigger that comes earlier than the
    shortest period after the last accepted trigger. With internal triggers it runs at the shortest period, and stops
    after the number of frames for which it was armed.

    Args:
        scene: the scene in front of the camera.
        seed: seed of all random numbers, together with the name of the effect and the number of the frame over the life
            of the camera.
        beam_is_on, place_of_sample: called when a frame is exposed. If the beam is off, the frame is a dark. Otherwise
            `place_of_sample` returns how many mm the sample is moved sideways; None: the frame is a flat.
    """

    def __init__(
        self,
        scene: Scene,
        line: TriggerLine,
        clock: Clock,
        seed: int,
        beam_is_on: Callable[[], bool],
        place_of_sample: Callable[[], float | None],
        build: OrcaQuestBuild = _USUAL,
    ) -> None:
        self.name, self._model = build.name, build.model
        self._scene, self._line, self._clock, self._seed = scene, line, clock, seed
        self._beam_is_on, self._place_of_sample, self._build = beam_is_on, place_of_sample, build
        self._settings = CameraSettings(exposure=8.2944e-3, trigger=TriggerSource.INTERNAL)
        self._timing = orca_quest.timing(self._settings, model=self._model)
        self._connected = clock.now()
        self._triggers = self._frames = self._views = 0  # number over the life of the camera
        self._ring: deque[Exposed] = deque()
        self._armed_for = self._framestamp = 0  # requested number of frames (0: not armed), and the next framestamp
        # time of the last trigger that was examined, and of the last accepted trigger
        self._seen, self._accepted = 0.0, -np.inf
        self._gone = ""
        # the key is the time of the frame; only frames with labels are kept
        self._labels: dict[float, tuple[AnomalyLabel, ...]] = {}
        self._lock = threading.Lock()

    @property
    def timing(self) -> CameraTiming:
        return self._timing

    @property
    def detector(self) -> Detector:
        """Positions of the pixels of a frame in mm from the rotation axis: the ground truth for alignment."""
        return self._camera_view().detector

    @property
    def scene(self) -> Scene:
        """The scene in front of the camera."""
        return self._scene

    def show(self, scene: Scene) -> None:
        """Replace sample and beam by those of `scene`; the effects are kept. Exposed frames that were not read yet also
        show them.
        """
        with self._lock:
            self._scene = replace(self._scene, sample=scene.sample, beam=scene.beam)

    def labels_at(self, time: float) -> tuple[AnomalyLabel, ...]:
        """The anomalies in the frame exposed at `time` (s since the Unix epoch); the frame must have been read."""
        return self._labels.get(time, ())

    def rehearse(self) -> None:
        """Compute a frame of the sample with the present settings and discard it; the frame is not counted.

        Raises:
            CannotExposeError: the scene cannot be exposed with these settings; the message says what would help.
        """
        now = self._clock.now()
        expose(self._scene, self._camera_view().shot(Exposed(0, 0, now, self._line.angle_at(now), now, True, 0.0, 0)))

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Apply settings and read them back; the exposure is rounded to 10 ns. Raises DeviceRefused, with nothing
        changed.
        """
        with self._lock:
            self._answer()
            problem = orca_quest.refusal(settings, self._model)
            if self._armed_for:
                problem = "is armed and accepts no settings; disarm it first"
            if problem:
                raise DeviceRefused(self.name, problem, request=str(settings), state="Its settings were not changed")
            self._settings = replace(settings, exposure=round(settings.exposure, 8))
            self._timing = orca_quest.timing(self._settings, model=self._model)
            return self._settings

    def arm(self, n_frames: int) -> None:
        """Prepare for triggers. Framestamps start at 0; earlier triggers do not count."""
        with self._lock:
            self._answer()
            if n_frames < 1 or self._armed_for:
                problem = "is already armed" if self._armed_for else "cannot be armed for less than one frame"
                raise DeviceRefused(
                    self.name, problem, request=f"arm({n_frames})", advice="Call disarm() first, with n >= 1"
                )
            self._ring.clear()
            self._armed_for, self._framestamp = n_frames, 0
            self._seen, self._accepted = self._clock.now(), -np.inf

    def software_trigger(self) -> None:
        """Expose one frame now. Raises DeviceRefused if the camera is not armed for software triggers, or not ready."""
        with self._lock:
            self._answer(armed=True)
            now, source = self._clock.now(), self._settings.trigger
            wait = self._accepted + self._timing.min_period - now
            if source is not TriggerSource.SOFTWARE or wait > TOLERANCE:
                problem = f"is ready for the next trigger in {wait * 1e3:.3g} ms"
                if source is not TriggerSource.SOFTWARE:
                    problem = f"waits for {source} triggers, not for software"
                raise DeviceRefused(self.name, problem, state="Nothing was exposed")
            self._trigger(now, self._line.angle_at(now))

    def next_frame(self, timeout: float) -> CameraFrame:
        """The oldest frame that was not read yet; waits on the clock.

        Raises:
            DeviceTimeout: no frame came within `timeout` s.
            DeviceError: the ring buffer was overrun (the message names the lost framestamps; later frames can still be
                read), or the camera is unplugged.
        """
        deadline = self._clock.now() + timeout
        while True:
            with self._lock:
                now = self._clock.now()
                self._answer(armed=True)
                self._catch_up(now)
                self._check_overrun(now)
                if self._ring and self._ring[0].ready <= now:
                    return self._render(self._ring.popleft())
                if not self._ring:
                    self._answer()
                due = min(self._due(), deadline, now + POLL)
                exposed = self._framestamp
            if now >= deadline:
                raise DeviceTimeout(
                    self.name,
                    f"no frame arrived within {timeout:g} s; it was armed for {self._armed_for} and exposed {exposed}",
                    expected=f"a frame by {self._settings.trigger} trigger",
                    advice="Check that the stage moves and its trigger output is connected",
                )
            self._clock.sleep(due - now)

    def disarm(self) -> None:
        """Stop the run, and discard frames that were not read; allowed in every state."""
        with self._lock:
            self._armed_for = 0
            self._ring.clear()

    def describe(self) -> dict[str, str | int | float]:
        row0, col0, rows, cols = self._camera_view().roi
        return {
            "model": f"{self._model} (simulated)",
            "exposure": self._settings.exposure,
            "trigger": str(self._settings.trigger),
            "readout": self._settings.readout,
            "binning": self._settings.binning,
            "roi_row": row0,
            "roi_col": col0,
            "roi_rows": rows,
            "roi_cols": cols,
            "conversion_factor": CONVERSION[self._settings.readout],
            "conversion_offset": OFFSET[self._settings.readout],
            "sensor_pitch_mm": orca_quest.PITCH_MM,
            "min_period": self._timing.min_period,
            "row_period": self._timing.row_period,
            "seed": self._seed,
        }

    def close(self) -> None:
        self.disarm()
        self._gone = self._gone or "was closed"

    def _camera_view(self) -> CameraView:
        return CameraView(
            self._scene,
            self._settings,
            self._build.pixel_pitch,
            self._seed,
            self._line.angle_at,
            self._connected,
            self._model,
        )

    def _answer(self, armed: bool = False) -> None:
        """Raise DeviceError if the camera is unplugged (after its last frame was read), or if it must be armed and is
        not armed."""
        if self._gone and not self._ring:
            raise DeviceError(self.name, self._gone, advice="Connect it again", state="Frames already taken are good")
        if armed and not self._armed_for:
            raise DeviceRefused(self.name, "is not armed", advice="Call arm(n) before reading or triggering frames")

    def _catch_up(self, now: float) -> None:
        """Process every trigger up to `now`."""
        if self._settings.trigger is TriggerSource.EXTERNAL:
            while (pulse := self._line.next_after(self._seen)) and pulse.time <= now:
                self._seen = pulse.time
                if pulse.time - self._accepted > self._timing.min_period - TOLERANCE:
                    self._trigger(pulse.time, pulse.angle)
        elif self._settings.trigger is TriggerSource.INTERNAL:
            while not self._gone and self._framestamp < self._armed_for and (time := self._free_run()) <= now:
                self._trigger(time, self._line.angle_at(time))

    def _free_run(self) -> float:
        """Time of the next exposure in free run; `_seen` is the time at which the camera was armed."""
        return max(self._seen, self._accepted + self._timing.min_period)

    def _due(self) -> float:
        """Time of the next known event."""
        if self._ring:
            return self._ring[0].ready
        after = self._settings.exposure + self._timing.readout
        if self._settings.trigger is TriggerSource.INTERNAL and self._framestamp < self._armed_for:
            return self._free_run() + after
        pulse = self._line.next_after(self._seen) if self._settings.trigger is TriggerSource.EXTERNAL else None
        return pulse.time + after if pulse else np.inf

    def _trigger(self, time: float, angle: float) -> None:
        """Expose for a trigger, unless a fault suppresses it."""
        number, self._triggers = self._triggers, self._triggers + 1
        if self._gone or (number in self._build.ignored and self._settings.trigger is not TriggerSource.INTERNAL):
            return
        self._accepted = time
        if self._build.unplug_at is not None and self._frames >= self._build.unplug_at:
            self._gone = f"no longer answers: it was unplugged at frame {self._frames}"
            return
        ready = time + self._settings.exposure + self._timing.readout
        beam, sample = self._beam_is_on(), self._place_of_sample()
        if self._frames not in self._build.lost:
            self._ring.append(Exposed(self._framestamp, self._frames, time, angle, ready, beam, sample, self._views))
        self._framestamp += 1
        self._frames += 1
        self._views += beam and sample is not None

    def _check_overrun(self, now: float) -> None:
        over = sum(frame.ready <= now for frame in self._ring) - self._build.ring_frames
        if over > 0:
            gone = [self._ring.popleft().framestamp for _ in range(over)]
            raise DeviceError(
                self.name,
                f"its ring of {self._build.ring_frames} frames was overrun and {over} frames are "
                f"lost: framestamps {gone}",
                advice="Read frames faster, trigger more slowly, or use a larger ring buffer",
                state="Later frames can still be read",
            )

    def _render(self, frame: Exposed) -> CameraFrame:
        shot = self._camera_view().shot(frame)
        try:
            counts = expose(self._scene, shot)
        except CannotExposeError as error:
            advice = "Change the scene, or the settings that do not match it"
            raise DeviceRefused(self.name, f"cannot show the scene: {error}", advice=advice) from error
        if labels := self._scene.chain.labels(shot):
            self._labels[frame.time] = labels
        return CameraFrame(counts, frame.framestamp, frame.time)
