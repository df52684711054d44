"""Fly scan: takes a block of frames while the stage turns, each with the angle of its trigger."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, InstrumentError
from beamline.core.stop import StopRequest
from beamline.plan.plan import Block
from beamline.plan.timeline import move_seconds, passes
from beamline.scan.braking import Braking, FlownTrain
from beamline.scan.control import State, StateMachine
from beamline.scan.ledger import Ledger, Train, settle
from beamline.scan.moves import move_and_wait, stop_and_wait, wait_for_move
from beamline.scan.tally import BlockTally, ExposedFrame
from beamline.scan.waits import Waits
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.protocols import Devices, TriggerTrain

# s without a frame, in addition to exposure and readout, after which a camera counts as silent; lower limit
PATIENCE = 2.0
PATIENCE_PERIODS = 10  # the same in trigger periods
RAMP_TOLERANCE = 0.1  # share of the time that acceleration adds before the first pulse
SILENT_EXPOSURES = 3  # triggers in a row without a frame, after which the camera counts as silent


class FlyScan:
    """Takes blocks of frames with a turning stage.

    Args:
        states: gets the states of the scan.
    """

    def __init__(self, devices: Devices, clock: Clock, stop: StopRequest, states: StateMachine, waits: Waits) -> None:
        self._stage, self._camera = devices.stage, devices.camera
        self._clock, self._stop, self._states, self._waits = clock, stop, states, waits

    def frames(self, tally: BlockTally) -> Iterator[ExposedFrame]:
        """Take the frames of a block, pass by pass, each with its trigger, its angle, and True."""
        block, passes_of_block, trigger = tally.block, passes(tally.block), 0
        # A block begins within a pass only after a pause.
        while (trigger := self._waits.after_pause(trigger, tally)) < block.n and not self._stop.stopping:
            next_pass = next(
                next_pass for next_pass in passes_of_block if trigger < next_pass.first + next_pass.train.n
            )
            train, n_done = next_pass.train, trigger - next_pass.first
            self._states.enter(State.TAXI)
            begin = next_pass.start + float(block.angles[trigger] - block.angles[next_pass.first])
            if not move_and_wait(self._stage, begin, self._clock, self._stop):
                return
            remaining = TriggerTrain(train.start + n_done * train.interval, train.interval, train.n - n_done)
            trigger += yield from self._pass(tally, remaining, trigger, (begin, next_pass.end))

    def _pass(
        self, tally: BlockTally, train: TriggerTrain, first: int, ends: tuple[float, float]
    ) -> Generator[ExposedFrame, None, int]:
        """Make one pass over a train whose first trigger within the block is `first`. The stage is at the first of the
        ends.

        Returns the number of its triggers that are done: all, or those up to the last frame before a pause.
        """
        block, (start, end) = tally.block, ends
        self._camera.arm(train.n)
        self._stage.arm(train)
        before = self._clock.now()
        self._stage.start_move(end, block.speed)
        self._states.enter(State.ACQUIRING)
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
            tally.enter(settle(flight.ledger, cut_short), first)
        self._stage.disarm()
        self._camera.disarm()
        if flight.ledger.last_trigger < 0 and not cut_short and train.n >= SILENT_EXPOSURES:
            raise InstrumentError(
                "Check the trigger cable, its polarity and the stage's trigger output. "
                f"{self._camera.name}: none of {train.n} triggers gave a frame while the stage turned "
                f"from {math.degrees(start):.4g}° to {math.degrees(end):.4g}°. Earlier frames are in the "
                "file."
            )
        return flight.ledger.last_trigger + 1 if flight.paused else train.n

    def _expected(self, block: Block, angles: NDArray[np.float64], before: float, after: float) -> Train:
        """Expected times of the pulses, for a run-up with constant acceleration and then constant speed.

        The stage may have started at any time between `before` and `after`, and its acceleration is only nearly
        constant.
        """
        ramp = block.speed / (2 * self._stage.limits.acceleration)
        first = (before + after) / 2 + block.taxi / block.speed + ramp
        return Train(angles, block.period, first, tolerance=(after - before) / 2 + RAMP_TOLERANCE * ramp)

    def _until_standing(self, block: Block, flight: FlownTrain) -> Iterator[ExposedFrame]:
        """Yields frames while the stage turns. After a stop, it yields all frames until the stage has stopped.

        After a pause, it yields only the frames that were exposed before the stop was sent. These frames are the same
        as in a scan without a pause. The method waits for frames and not for the stage, so that a camera that sends no
        frames is noticed at once.
        """
        frame_delay = block.exposure + self._camera.timing.readout
        patience = max(PATIENCE, PATIENCE_PERIODS * block.period) + frame_delay
        first_pulse = flight.ledger.train.first_time or 0.0
        timeout = patience + max(0.0, first_pulse - self._clock.now())
        silent_at, at_rest = self._clock.now() + timeout, False
        while not flight.so_far.complete:
            if self._waits.interrupted and not at_rest:
                self._brake(flight)
                at_rest = True
            frame = self._waits.next_frame(frame_delay if at_rest else timeout, until_stop=not at_rest)
            if frame is not None:
                timeout, silent_at = patience, self._clock.now() + patience
                if not flight.paused or frame.time + frame_delay <= flight.stop_sent:
                    yield from flight.enter(frame)
            elif at_rest:
                break
            elif self._clock.now() >= silent_at:  # the pause was requested earlier, and may have been withdrawn
                if not self._stage.moving():
                    break
                if self._clock.now() >= flight.last_due + frame_delay:
                    break  # all triggers have come, and missing frames are reported with the rest of the pass
                raise InstrumentError(
                    f"Check the trigger cable and the camera. {self._camera.name}: no frame for "
                    f"{timeout:.3g} s while the stage turned. Earlier frames are in the file."
                )
        if flight.paused:
            return
        if not at_rest:
            wait_for_move(self._stage, flight.seconds, self._clock, self._stop)
        while (frame := self._waits.next_frame(0.0, until_stop=False)) is not None:
            # all triggers have their frames, so the ledger counts further frames as extra
            yield from flight.enter(frame)

    def _brake(self, flight: FlownTrain) -> None:
        """Stop the stage within a train, wait until it is at rest, and read its position."""
        train, limits = flight.train, self._stage.limits
        flight.stop_sent, flight.paused = self._clock.now(), not self._stop.stopping
        stop_and_wait(self._stage, self._clock, self._stop)
        if not flight.paused:
            position = (self._stage.to_counts(self._stage.position()) - train.start) / train.interval
            counts = limits.acceleration * limits.counts_per_turn / (2 * math.pi)
            flight.braking = Braking(flight.stop_sent, position, counts / abs(train.interval))
