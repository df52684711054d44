"""Exposures: takes a block of frames with camera and stage (fly scan, step scan, or stage at rest), each with its
true angle.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, InstrumentError
from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.plan.plan import Block
from beamline.plan.timeline import move_seconds, passes
from beamline.scan.braking import Braking, FlownTrain
from beamline.scan.control import State
from beamline.scan.ledger import EXTRA, Ledger, Train, settle
from beamline.scan.moves import POLL, arrive, go, looked_again, stand
from beamline.scan.supervision import Supervision
from beamline.scan.tally import TRIES, BlockTally, Exposed
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraFrame, CameraSettings, Devices, TriggerSource, TriggerTrain

SLICE = 0.5  # s: longest wait for a frame between two checks of the stop request
# s without a frame, in addition to exposure and readout, after which a camera counts as silent; lower limit
PATIENCE = 2.0
PATIENCE_PERIODS = 10  # the same in trigger periods
RAMP_TOLERANCE = 0.1  # share of the time that acceleration adds before the first pulse
SILENT_EXPOSURES = 3  # triggers in a row without a frame, after which the camera counts as silent
# s within which a stage that somebody else moves must stop before it is moved to a projection again
STANDS_WITHIN = 10.0


class Exposures:
    """Takes blocks of frames with a camera and a stage. `Acquisition` moves shutter and sample.

    Args:
        camera_settings: roi, binning and readout for all blocks; each block sets its own exposure and trigger.
        settle: waiting time in s after each move of a step scan. sink: receives the warnings. supervision: requests
            pauses, and gets the states of a fly scan.
        wait_while_paused: called before each frame with the stage at rest, and before each run-up.
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

    def take(self, taken: BlockTally, first_row: int) -> Iterator[Frame]:
        """Take the frames of a block, numbered from `first_row`. `taken` collects the missing frames.

        A stop during the block ends it early. A block that begins after the stop is taken as a whole.

        Raises:
            ScanAborted: an abort was requested; the stage may still be moving.
            InstrumentError: the camera is silent.
            DeviceError: a device failed.
        """
        block = taken.block
        source = TriggerSource.EXTERNAL if block.trains else TriggerSource.SOFTWARE
        accepted = self._camera.configure(
            CameraSettings(block.exposure, source, self._settings.roi, self._settings.binning, self._settings.readout)
        )
        frames = self._fly(taken) if block.trains else self._one_by_one(taken)
        for row, (frame, trigger, angle, in_place) in enumerate(frames, first_row):
            taken.frames += 1
            good = in_place and trigger != EXTRA
            kind, replaces = block.kind if good else FrameKind.INVALID, -1
            if good:
                before = taken.astray.get(trigger, [(-1, 0.0)])[-1]
                replaces, _ = taken.rows.get(trigger, before)
                taken.rows[trigger] = row, frame.time
            elif trigger != EXTRA:
                taken.astray.setdefault(trigger, []).append((row, angle))
            yield Frame(
                frame.counts, kind, row, trigger, frame.framestamp, angle, frame.time, accepted.exposure, replaces,
                block.aside,
            )  # fmt: skip

    def _fly(self, taken: BlockTally) -> Iterator[Exposed]:
        block, ahead, i = taken.block, passes(taken.block), 0
        # A block begins within a pass only after a pause.
        while (i := self._after_pause(i, taken)) < block.n and not self._stop.stopping:
            flown = next(flown for flown in ahead if i < flown.first + flown.train.n)
            train, done = flown.train, i - flown.first
            self._supervision.states.enter(State.TAXI)
            begin = flown.start + float(block.angles[i] - block.angles[flown.first])
            if not go(self._stage, begin, self._clock, self._stop):
                return
            rest = TriggerTrain(train.start + done * train.interval, train.interval, train.n - done)
            i += yield from self._pass(taken, rest, i, (begin, flown.end))

    def _after_pause(self, i: int, taken: BlockTally) -> int:
        """Wait as long as the scan is paused. Returns the next trigger: `i`, or the next trigger without a stored
        frame.

        After a loss of the beam, the next trigger is the first one that may be without beam. This and later triggers
        are repeated.
        """
        block = taken.block
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
        self, taken: BlockTally, train: TriggerTrain, first: int, ends: tuple[float, float]
    ) -> Generator[Exposed, None, int]:
        """Make one pass over a train whose first trigger within the block is `first`. The stage is at the first of the
        ends.

        Returns the number of its triggers that are done: all, or those up to the last frame before a pause.
        """
        block, (start, end) = taken.block, ends
        self._camera.arm(train.n)
        self._stage.arm(train)
        before = self._clock.now()
        self._stage.start_move(end, block.speed)
        self._supervision.states.enter(State.ACQUIRING)
        seconds = move_seconds(end - start, block.speed, self._stage.limits.acceleration)
        angles = block.angles[first : first + train.n]
        flight = FlownTrain(Ledger(self._expected(block, angles, before, self._clock.now())), train, first, seconds)
        cut_short = True
        try:
            try:
                yield from self._until_standing(block, flight)
            except (BeamlineError, DeviceError):
                yield from flight.enter(last=True)
                raise
            if not flight.paused:  # if not, the triggers of waiting frames are repeated
                yield from flight.enter(last=True)
            cut_short = self._stop.stopping or flight.paused
        finally:
            taken.enter(settle(flight.ledger, cut_short), first)
        self._stage.disarm()
        self._camera.disarm()
        if flight.ledger.last < 0 and not cut_short and train.n >= SILENT_EXPOSURES:
            raise InstrumentError(
                "Check the trigger cable, its polarity and the stage's trigger output. "
                f"{self._camera.name}: none of {train.n} triggers gave a frame while the stage turned "
                f"from {math.degrees(start):.4g}° to {math.degrees(end):.4g}°. Earlier frames are in the "
                "file."
            )
        return flight.ledger.last + 1 if flight.paused else train.n

    def _expected(self, block: Block, angles: NDArray[np.float64], before: float, after: float) -> Train:
        """Expected times of the pulses, for a run-up with constant acceleration and then constant speed.

        The stage may have started at any time between `before` and `after`, and its acceleration is only nearly
        constant.
        """
        ramp = block.speed / (2 * self._stage.limits.acceleration)
        first = (before + after) / 2 + block.taxi / block.speed + ramp
        return Train(angles, block.period, first, tolerance=(after - before) / 2 + RAMP_TOLERANCE * ramp)

    def _until_standing(self, block: Block, flight: FlownTrain) -> Iterator[Exposed]:
        """Yields frames while the stage turns. After a stop, it yields all frames until the stage has stopped.

        After a pause, it yields only the frames that were exposed before the stop was sent. These frames are the same
        as in a scan without a pause. The method waits for frames and not for the stage, so that a camera that sends no
        frames is noticed at once.
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
                if not flight.paused or frame.time + tail <= flight.stop_sent:
                    yield from flight.enter(frame)
            elif stands:
                break
            elif self._clock.now() >= silent_at:  # the pause was requested earlier, and may have been withdrawn
                if not self._stage.moving():
                    break
                if self._clock.now() >= flight.last_due + tail:
                    break  # all triggers have come, and missing frames are reported with the rest of the pass
                raise InstrumentError(
                    f"Check the trigger cable and the camera. {self._camera.name}: no frame for "
                    f"{wait:.3g} s while the stage turned. Earlier frames are in the file."
                )
        if flight.paused:
            return
        if not stands:
            arrive(self._stage, flight.seconds, self._clock, self._stop)
        while (frame := self._next_frame(0.0, until_stop=False)) is not None:
            # all triggers have their frames, so the ledger counts further frames as extra
            yield from flight.enter(frame)

    def _brake(self, flight: FlownTrain) -> None:
        """Stop the stage within a train, wait until it is at rest, and read its position."""
        train, limits = flight.train, self._stage.limits
        flight.stop_sent, flight.paused = self._clock.now(), not self._stop.stopping
        stand(self._stage, self._clock, self._stop)
        if not flight.paused:
            position = (self._stage.to_counts(self._stage.position()) - train.start) / train.interval
            counts = limits.acceleration * limits.counts_per_turn / (2 * math.pi)
            flight.braking = Braking(flight.stop_sent, position, counts / abs(train.interval))

    def _one_by_one(self, taken: BlockTally) -> Iterator[Exposed]:
        """Take frames with software triggers: at each angle of a step scan, or at rest for darks and flats.

        Yields each frame with its trigger, the position of the stage, and True if the position was the right angle.
        """
        block = taken.block
        self._camera.arm(block.n)
        period = max(block.period, self._camera.timing.min_period)
        patience = PATIENCE + block.exposure + self._camera.timing.readout
        position = self._stage.position()
        triggered, silent = -math.inf, 0
        owed, i, tried, stands_at = self._stop.stopping, -1, Counter[int](), math.nan
        while (after := self._after_pause(i + 1, taken)) < block.n:
            if after <= i or tried[after]:
                self._arm_anew(block.n - after)
            i, angle = after, float(block.angles[after])
            self._stop.refuse_abort()
            if self._stop.stopping and not owed:
                break
            if math.isfinite(angle):
                if angle != stands_at and not (
                    go(self._stage, angle, self._clock, self._stop) and self._rest(self._settle, owed)
                ):
                    break
                stands_at = angle
                position = self._stage.position()
            if not self._rest(triggered + period - self._clock.now(), owed):
                break
            self._camera.software_trigger()
            # read after the call, because the time of the exposure within the call is not known
            triggered = self._clock.now()
            frame = self._next_frame(patience, until_stop=False)
            if frame is not None:
                silent, wrong = 0, ""
                if math.isfinite(angle):
                    position, wrong = looked_again(self._stage, angle, position)
                yield frame, i, position, not wrong
                if wrong:
                    tried[i] += 1
                    stands_at = math.nan
                    if len(taken.astray) == tried[i] == 1:
                        self._sink(Warned(f"Projection {i}: {wrong}"))
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
                    f"Check the camera. {self._camera.name}: {silent} triggers in a row gave no frame "
                    f"within {patience:.3g} s each. Earlier frames are in the file."
                )
            self._arm_anew(block.n - i)  # discards a late frame, which must not count as the next frame
        self._camera.disarm()

    def _until_nobody_moves_it(self) -> None:
        deadline = self._clock.now() + STANDS_WITHIN
        while self._stage.moving() and self._clock.now() < deadline and not self._stop.stopping:
            self._clock.sleep(POLL)

    def _rest(self, seconds: float, owed: bool) -> bool:
        """Wait for some seconds. Returns False if a stop ended the wait early. In a block that is still needed, a stop
        does not end the wait.
        """
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
        """The next frame; None if no frame comes within `timeout` s. With `until_stop`, a request to stop or pause also
        ends the wait.

        The first error of the camera becomes a warning, and frames lost from its ring buffer count as missing. A second
        error is raised.
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

    @property
    def _interrupted(self) -> bool:
        """True if a stop or a pause is requested."""
        return self._stop.stopping or bool(self._supervision.pause.reason)
