"""Exposures: a block of frames taken from camera and stage, flying, stepping or standing, each with its true angle."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, InstrumentError
from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.plan.plan import Block
from beamline.plan.timeline import move_seconds, passes
from beamline.scan.braking import Braking, assigned, placing, unassigned
from beamline.scan.control import State
from beamline.scan.ledger import EXTRA, DeliveredFrame, Ledger, Train, enter, settle
from beamline.scan.supervision import Supervision
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraFrame, CameraSettings, Devices, TriggerSource, TriggerTrain

SLICE = 0.5  # s: the longest wait for a frame between two checks of the stop request
POLL = 0.02  # s between status queries of a moving stage
PATIENCE = 2.0  # s without a frame (beyond exposure and readout) after which a camera is silent; at least
PATIENCE_PERIODS = 10  # so many trigger periods
RAMP_TOLERANCE = 0.1  # share of the time that acceleration adds before the first pulse
SILENT_EXPOSURES = 3  # triggers in a row without a frame, after which the camera counts as silent
TRIES = 3  # exposures of a view whose stage is not at its angle, after which the view counts as missing
STANDS_WITHIN = 10.0  # s that a stage which somebody else moves may take to stand, before it is sent to a view again
ASTRAY_ADVICE = (
    f"Such a frame is kept as an invalid row, and its view is taken again, up to {TRIES} times in all. Look for "
    "another program or person that moves the stage, a knob, a servo that hunts, or a controller that says too early "
    "that a move is done"
)
NOT_BRAKING = Braking(math.inf, math.inf, math.inf)


@dataclass
class BlockTally:
    """Frames and missing triggers of a block; filled while the block is recorded.

    Attributes:
        frames: delivered, with and without a trigger.
        rows: by trigger, counted within the block, the row and the time of its last frame.
        missing: triggers, counted within the block, whose expected frame did not come.
        lost, ignored: of the missing ones, exposed but not delivered, and not exposed, where that is known.
        extra: frames that no trigger exposed.
        unconfirmed: of the extra ones, those exposed while the stage braked.
        shift, off: the largest of the passes, see `Ledger`.
        astray: by trigger, of the frames exposed while the stage was not at its angle, the row and where it was, rad.
    """

    frames: int = 0
    rows: dict[int, tuple[int, float]] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    lost: int = 0
    ignored: int = 0
    extra: int = 0
    unconfirmed: int = 0
    shift: int = 0
    off: float = 0.0
    astray: dict[int, list[tuple[int, float]]] = field(default_factory=dict)

    def miss(self, triggers: Iterable[int]) -> None:
        """Record triggers without a frame. A trigger with an earlier frame, perhaps without beam, keeps that frame."""
        self.missing += [trigger for trigger in triggers if trigger not in self.rows]

    def enter(self, settled: Ledger, first: int) -> None:
        """Add a pass whose first trigger is `first`."""
        self.miss(first + i for i in settled.missing)
        self.lost += settled.lost
        self.ignored += settled.ignored
        self.extra += len(settled.extra)
        self.unconfirmed += settled.unconfirmed
        self.shift = max(self.shift, settled.shift)
        self.off = max(self.off, settled.off)


@dataclass
class _Pass:
    """A pulse train under way: its ledger, its counts, its first trigger within the block, the seconds its move takes.

    `told`: time at which the stage was told to stop during the pass. `paused`: for a pause, after which the triggers
    that come after the last frame stored are exposed anew. `braking`: for a stop, once the stage stands. `waiting`:
    frames whose trigger is told by those that follow.
    """

    ledger: Ledger
    train: TriggerTrain
    first: int
    seconds: float
    told: float = math.inf
    paused: bool = False
    braking: Braking = NOT_BRAKING
    waiting: list[CameraFrame] = field(default_factory=list)

    @property
    def so_far(self) -> Ledger:
        """The ledger so far, settled as if no further frame came."""
        return assigned(self.ledger, self.braking, self._exposed, unassigned)

    @property
    def last_due(self) -> float:
        """When the last trigger of the pass is due, in s since the Unix epoch; inf where that is not known."""
        ledger, train = self.so_far, self.ledger.train
        if ledger.last >= 0:
            return ledger.phase + (train.n - 1 - ledger.last) * ledger.period
        return math.inf if train.first is None else train.first + (train.n - 1) * train.period

    def enter(self, *frames: CameraFrame, last: bool = False) -> Iterator[tuple[CameraFrame, int, float]]:
        """Enter frames; yield those whose trigger is now known (or EXTRA), with trigger in the block and angle.

        Args:
            last: no further frame will come, so none waits.
        """
        self.waiting += frames
        brakes = self.braking is not NOT_BRAKING
        if brakes and not last:
            return
        way = placing(self.ledger, self.braking, self._exposed) if brakes else unassigned
        while self.waiting:
            exposed = [way(self.ledger, self.braking, frame) for frame in self._exposed]
            if (entered := enter(self.ledger, exposed, last)) is None:
                return
            self.ledger, entry = entered
            trigger = EXTRA if entry.trigger == EXTRA else self.first + entry.trigger
            yield self.waiting.pop(0), trigger, entry.angle

    @property
    def _exposed(self) -> list[DeliveredFrame]:
        return [DeliveredFrame(frame.framestamp, frame.time) for frame in self.waiting]


class Exposures:
    """Takes blocks of frames with a camera and a stage. Shutter and sample are operated by Acquisition.

    Args:
        camera_settings: roi, binning and readout for all blocks; each block sets its own exposure and trigger.
        settle: s to wait after each move of a step scan.
        sink: where warnings go.
        supervision: says when to pause, and gets the states of a fly scan.
        wait_while_paused: called before each frame of a stage that stands, and before each run-up.
    """

    def __init__(
        self,
        devices: Devices,
        camera_settings: CameraSettings,
        settle: float,
        clock: Clock,
        stop: StopRequest,
        sink: Sink,
        supervision: Supervision,
        wait_while_paused: Callable[[], None],
    ) -> None:
        self._stage, self._camera = devices.stage, devices.camera
        self._settings, self._settle = camera_settings, settle
        self._clock, self._stop, self._sink = clock, stop, sink
        self._supervision, self._wait_while_paused = supervision, wait_while_paused

    def take(self, block: Block, first_row: int, taken: BlockTally) -> Iterator[Frame]:
        """Record the block's frames, numbered from `first_row`; `taken` lists what is missing.

        A stop that comes while they are taken ends them early. A block begun after the stop is taken whole.

        Raises:
            ScanAborted: an abort was requested; the stage may still be moving.
            InstrumentError: the camera is silent.
            DeviceError: a device failed.
        """
        source = TriggerSource.EXTERNAL if block.trains else TriggerSource.SOFTWARE
        accepted = self._camera.configure(
            CameraSettings(block.exposure, source, self._settings.roi, self._settings.binning, self._settings.readout)
        )
        frames: Iterator[tuple[CameraFrame, int, float, bool]]
        if block.trains:
            frames = ((frame, trigger, angle, True) for frame, trigger, angle in self._fly(block, taken))
        else:
            frames = self._one_by_one(block, taken)
        for row, (frame, trigger, angle, in_place) in enumerate(frames, first_row):
            taken.frames += 1
            kind, replaces = block.kind, -1
            if trigger == EXTRA:
                kind = FrameKind.INVALID
            elif not in_place:
                kind = FrameKind.INVALID
                taken.astray.setdefault(trigger, []).append((row, angle))
            else:
                before = taken.astray.get(trigger, [(-1, 0.0)])[-1]
                replaces, _ = taken.rows.get(trigger, before)
                taken.rows[trigger] = row, frame.time
            yield Frame(
                frame.counts, kind, row, trigger, frame.framestamp, angle, frame.time, accepted.exposure, replaces,
                block.aside,
            )  # fmt: skip

    def go(self, angle: float, *, until_stop: bool = True) -> bool:
        """Move to `angle` at full speed and wait; returns False if a stop (or only an abort) interrupted the move."""
        limits = self._stage.limits
        distance = angle - self._stage.position()
        self._stage.start_move(angle, limits.max_speed)
        return self._wait(move_seconds(distance, limits.max_speed, limits.acceleration), until_stop)

    def _fly(self, block: Block, taken: BlockTally) -> Iterator[tuple[CameraFrame, int, float]]:
        ahead, i = passes(block), 0
        # It begins within a pass only after a pause.
        while (i := self._after_pause(i, block, taken)) < block.n and not self._stop.stopping:
            flown = next(flown for flown in ahead if i < flown.first + flown.train.n)
            train, done = flown.train, i - flown.first
            self._supervision.states.enter(State.TAXI)
            begin = flown.start + float(block.angles[i] - block.angles[flown.first])
            if not self.go(begin):
                return
            rest = TriggerTrain(train.start + done * train.interval, train.interval, train.n - done)
            i += yield from self._pass(block, taken, rest, i, (begin, flown.end))

    def _after_pause(self, i: int, block: Block, taken: BlockTally) -> int:
        """Wait while the scan is paused. Returns the next trigger: `i`, or the next one without a stored frame. After a
        lost beam it is the first trigger that may lack beam; it and later ones are repeated."""
        i = next((k for k in range(i, block.n) if k not in block.stored), block.n)
        if i == block.n and taken.rows and block.kind is not FrameKind.DARK:
            self._supervision.wait_for_beam_reading()
        self._wait_while_paused()
        since = self._supervision.pause.take_unlit_since()
        doubtful = [trigger for trigger, (_, time) in taken.rows.items() if time + block.exposure > since]
        if not doubtful or block.kind is FrameKind.DARK:
            return i
        first = min(doubtful)
        taken.missing[:] = [missing for missing in taken.missing if missing < first]
        return first

    def _pass(
        self, block: Block, taken: BlockTally, train: TriggerTrain, first: int, ends: tuple[float, float]
    ) -> Generator[tuple[CameraFrame, int, float], None, int]:
        """Fly once over a train whose first trigger within the block is `first`; the stage stands at the first of the
        ends. Returns how many of its triggers are done with: all, or those up to the last frame before a pause."""
        start, end = ends
        self._camera.arm(train.n)
        self._stage.arm(train)
        before = self._clock.now()
        self._stage.start_move(end, block.speed)
        self._supervision.states.enter(State.ACQUIRING)
        seconds = move_seconds(end - start, block.speed, self._stage.limits.acceleration)
        angles = block.angles[first : first + train.n]
        flight = _Pass(Ledger(self._expected(block, angles, before, self._clock.now())), train, first, seconds)
        cut_short = True
        try:
            try:
                yield from self._until_standing(block, flight)
            except (BeamlineError, DeviceError):
                yield from flight.enter(last=True)
                raise
            if not flight.paused:  # otherwise the triggers of waiting frames come again
                yield from flight.enter(last=True)
            cut_short = self._stop.stopping or flight.paused
        finally:
            taken.enter(settle(flight.ledger, cut_short), first)
        self._stage.disarm()
        self._camera.disarm()
        if flight.ledger.last < 0 and not cut_short and train.n >= SILENT_EXPOSURES:
            raise InstrumentError(
                f"{self._camera.name}: none of {train.n} triggers gave a frame while the stage turned from "
                f"{math.degrees(start):.4g}° to {math.degrees(end):.4g}°. Check the trigger cable, its polarity "
                "and the stage's trigger output. What was taken before is in the file."
            )
        return flight.ledger.last + 1 if flight.paused else train.n

    def _expected(self, block: Block, angles: NDArray[np.float64], before: float, after: float) -> Train:
        """When the pulses should come: taxi at constant acceleration, then constant speed.

        The stage may have begun at any time between `before` and `after`, and its acceleration is only nearly constant.
        """
        ramp = block.speed / (2 * self._stage.limits.acceleration)
        first = (before + after) / 2 + block.taxi / block.speed + ramp
        return Train(angles, block.period, first, tolerance=(after - before) / 2 + RAMP_TOLERANCE * ramp)

    def _until_standing(self, block: Block, flight: _Pass) -> Iterator[tuple[CameraFrame, int, float]]:
        """Frames while the stage turns; after a stop, all frames until the stage stands. After a pause only the frames
        exposed before the stop was sent: they equal those of a scan without a pause.

        Waits for frames, not for the stage, so that a camera without frames is noticed at once.
        """
        tail = block.exposure + self._camera.timing.readout
        patience = max(PATIENCE, PATIENCE_PERIODS * block.period) + tail
        first_pulse = flight.ledger.train.first or 0.0
        wait = patience + max(0.0, first_pulse - self._clock.now())
        silent_at, stands = self._clock.now() + wait, False
        while not flight.so_far.complete:
            if self._interrupted and not stands:
                self._brake(flight)
                stands = True
            frame = self._next_frame(tail if stands else wait, until_stop=not stands)
            if frame is not None:
                wait, silent_at = patience, self._clock.now() + patience
                if not flight.paused or frame.time + tail <= flight.told:
                    yield from flight.enter(frame)
            elif stands:
                break
            elif self._clock.now() >= silent_at:  # the pause was requested earlier, and perhaps withdrawn
                if not self._stage.moving():
                    break
                if self._clock.now() >= flight.last_due + tail:
                    break  # no trigger is still to come: what is missing is named with the rest of the pass
                raise InstrumentError(
                    f"{self._camera.name}: no frame for {wait:.3g} s while the stage turned. Check the trigger "
                    "cable and the camera. What was taken before is in the file."
                )
        if flight.paused:
            return
        if not stands:
            self._wait(flight.seconds)
        while (frame := self._next_frame(0.0, until_stop=False)) is not None:
            yield from flight.enter(frame)  # all triggers have their frames: the ledger counts these as extra

    def _brake(self, flight: _Pass) -> None:
        """Slow down within a train, wait until the stage stands, and ask where."""
        train, limits = flight.train, self._stage.limits
        flight.told, flight.paused = self._clock.now(), not self._stop.stopping
        self.stand()
        if not flight.paused:
            stood = (self._stage.to_counts(self._stage.position()) - train.start) / train.interval
            counts = limits.acceleration * limits.counts_per_turn / (2 * math.pi)
            flight.braking = Braking(flight.told, stood, counts / abs(train.interval))

    def _one_by_one(self, block: Block, taken: BlockTally) -> Iterator[tuple[CameraFrame, int, float, bool]]:
        """Software triggers: at each angle of a step scan, or where the stage stands for darks and flats. With each
        frame its trigger, where the stage was, and whether that was its angle."""
        self._camera.arm(block.n)
        period = max(block.period, self._camera.timing.min_period)
        patience = PATIENCE + block.exposure + self._camera.timing.readout
        position = self._stage.position()
        triggered, silent = -math.inf, 0
        owed, i, tried, stands_at = self._stop.stopping, -1, Counter[int](), math.nan
        while (after := self._after_pause(i + 1, block, taken)) < block.n:
            if after <= i or tried[after]:
                self._arm_anew(block.n - after)
            i, angle = after, float(block.angles[after])
            self._stop.refuse_abort()
            if self._stop.stopping and not owed:
                break
            if math.isfinite(angle):
                if angle != stands_at and not (self.go(angle) and self._rest(self._settle, owed)):
                    break
                stands_at = angle
                position = self._stage.position()
            if not self._rest(triggered + period - self._clock.now(), owed):
                break
            self._camera.software_trigger()
            triggered = self._clock.now()  # after the call: the time of the exposure within it is not known
            frame = self._next_frame(patience, until_stop=False)
            if frame is not None:
                silent, wrong = 0, ""
                if math.isfinite(angle):
                    position, wrong = self._looked_again(angle, position)
                yield frame, i, position, not wrong
                if wrong:
                    tried[i] += 1
                    stands_at = math.nan
                    if len(taken.astray) == tried[i] == 1:
                        self._sink(Warned(f"View {i}: {wrong}"))
                    if tried[i] == TRIES:
                        taken.miss([i])
                        tried[i] = 0
                    else:
                        i -= 1
                    self._until_nobody_moves_it()
                continue
            taken.miss([i])
            silent += 1
            if silent == SILENT_EXPOSURES:
                raise InstrumentError(
                    f"{self._camera.name}: {silent} triggers in a row gave no frame within {patience:.3g} s each. "
                    "Check the camera. What was taken before is in the file."
                )
            self._arm_anew(block.n - i)  # discards a late frame, which must not count as the next one
        self._camera.disarm()

    def _looked_again(self, angle: float, before: float) -> tuple[float, str]:
        """Where the stage was while a frame was exposed that should be at `angle`, and what is wrong with that, if
        anything. The frame is there, and the stage stood at `before` (rad) when its exposure began."""
        moving, after = self._stage.moving(), self._stage.position()
        wanted, most = self._stage.to_counts(angle), self._stage.limits.tolerance
        if not moving and all(abs(self._stage.to_counts(place) - wanted) <= most for place in (before, after)):
            return (before + after) / 2, ""
        return after, (
            f"its frame was exposed while the stage was not at its {math.degrees(angle):.4f}°, where it had arrived: "
            f"it was at {math.degrees(before):.4f}° before and {'is moving ' if moving else ''}at "
            f"{math.degrees(after):.4f}° after. {ASTRAY_ADVICE}"
        )

    def _until_nobody_moves_it(self) -> None:
        deadline = self._clock.now() + STANDS_WITHIN
        while self._stage.moving() and self._clock.now() < deadline and not self._stop.stopping:
            self._clock.sleep(POLL)

    def _rest(self, seconds: float, owed: bool) -> bool:
        """Let so many s pass; False where a stop cut them short, which it does not in a block that is owed."""
        deadline = self._clock.now() + seconds
        while seconds > SLICE:
            self._stop.refuse_abort()
            if self._stop.stopping and not owed:
                return False
            self._clock.sleep(SLICE)
            seconds = deadline - self._clock.now()
        self._clock.sleep(seconds)
        return True

    def _arm_anew(self, n: int) -> None:
        self._camera.disarm()
        self._camera.arm(n)

    def _next_frame(self, timeout: float, until_stop: bool) -> CameraFrame | None:
        """The next frame, or None after `timeout` s (with `until_stop`, also at a request to stop or pause).

        A first error of the camera is a warning (frames lost from its ring buffer become missing ones); a second is
        raised.
        """
        deadline = self._clock.now() + timeout
        failed = False
        while True:
            self._stop.refuse_abort()
            remaining = deadline - self._clock.now()
            try:
                return self._camera.next_frame(max(0.0, min(SLICE, remaining)))
            except DeviceTimeout:
                if remaining <= SLICE or (until_stop and self._interrupted):
                    return None
            except DeviceError as error:
                if failed:
                    raise
                failed = True
                self._sink(Warned(str(error)))

    def _wait(self, seconds: float, until_stop: bool = True) -> bool:
        """Wait for a move that should take `seconds`; False if a stop cut it short."""
        deadline = self._clock.now() + 2 * seconds + 5.0
        while self._stage.moving():
            self._stop.refuse_abort()
            if until_stop and self._stop.stopping:
                self.stand()
                return False
            if self._clock.now() > deadline:
                break
            self._clock.sleep(POLL)
        self._stage.wait(timeout=POLL)  # raises if the stage still moves or stopped short
        return True

    def stand(self) -> None:
        """Decelerate and wait until the stage stands. Raises InstrumentError if it does not."""
        limits = self._stage.limits
        deadline = self._clock.now() + 2 * limits.max_speed / limits.acceleration + 5.0
        self._stage.stop()
        while self._stage.moving():
            self._stop.refuse_abort()
            if self._clock.now() > deadline:
                raise InstrumentError(f"{self._stage.name}: it is still moving after a stop. Use its emergency stop.")
            self._clock.sleep(POLL)

    @property
    def _interrupted(self) -> bool:
        """Whether a stop or a pause is requested."""
        return self._stop.stopping or bool(self._supervision.pause.reason)
