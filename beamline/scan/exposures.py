"""Exposures: takes a block of frames with camera and stage (fly scan, step scan, or stage at rest), each with its
true angle.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator

from beamline.core.errors import InstrumentError
from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.scan.fly import PATIENCE, SILENT_EXPOSURES, FlyScan
from beamline.scan.ledger import EXTRA
from beamline.scan.moves import POLL, move_and_wait, position_during_exposure
from beamline.scan.supervision import Supervision
from beamline.scan.tally import TRIES, BlockTally, ExposedFrame
from beamline.scan.waits import Waits
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, Devices, TriggerSource

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
        self._waits = Waits(devices.camera, clock, stop, sink, supervision, wait_while_paused)
        self._fly_scan = FlyScan(devices, clock, stop, supervision.states, self._waits)

    def take(self, tally: BlockTally, first_row: int) -> Iterator[Frame]:
        """Take the frames of a block, numbered from `first_row`. `tally` collects the missing frames.

        A stop during the block ends it early. A block that begins after the stop is taken as a whole.

        Raises:
            ScanAborted: an abort was requested; the stage may still be moving.
            InstrumentError: the camera is silent.
            DeviceError: a device failed.
        """
        block = tally.block
        source = TriggerSource.EXTERNAL if block.trains else TriggerSource.SOFTWARE
        accepted = self._camera.configure(
            CameraSettings(block.exposure, source, self._settings.roi, self._settings.binning, self._settings.readout)
        )
        frames = self._fly_scan.frames(tally) if block.trains else self._one_by_one(tally)
        for row, (frame, trigger, angle, on_target) in enumerate(frames, first_row):
            tally.frames += 1
            valid = on_target and trigger != EXTRA
            kind, replaces = block.kind if valid else FrameKind.INVALID, -1
            if valid:
                earlier = tally.off_target.get(trigger, [(-1, 0.0)])[-1]
                replaces, _ = tally.rows.get(trigger, earlier)
                tally.rows[trigger] = row, frame.time
            elif trigger != EXTRA:
                tally.off_target.setdefault(trigger, []).append((row, angle))
            yield Frame(
                frame.counts, kind, row, trigger, frame.framestamp, angle, frame.time, accepted.exposure, replaces,
                block.aside,
            )  # fmt: skip

    def _one_by_one(self, tally: BlockTally) -> Iterator[ExposedFrame]:
        """Take frames with software triggers: at each angle of a step scan, or at rest for darks and flats.

        Yields each frame with its trigger, the position of the stage, and True if the position was the right angle.
        """
        block = tally.block
        self._camera.arm(block.n)
        period = max(block.period, self._camera.timing.min_period)
        patience = PATIENCE + block.exposure + self._camera.timing.readout
        position = self._stage.position()
        trigger_time, n_silent = -math.inf, 0
        still_needed, i, attempts, reached_angle = self._stop.stopping, -1, Counter[int](), math.nan
        while (next_trigger := self._waits.after_pause(i + 1, tally)) < block.n:
            if next_trigger <= i or attempts[next_trigger]:
                self._arm_again(block.n - next_trigger)
            i, angle = next_trigger, float(block.angles[next_trigger])
            self._stop.refuse_abort()
            if self._stop.stopping and not still_needed:
                break
            if math.isfinite(angle):
                if angle != reached_angle and not (
                    move_and_wait(self._stage, angle, self._clock, self._stop)
                    and self._waits.rest(self._settle, still_needed)
                ):
                    break
                reached_angle = angle
                position = self._stage.position()
            if not self._waits.rest(trigger_time + period - self._clock.now(), still_needed):
                break
            self._camera.software_trigger()
            # read after the call, because the time of the exposure within the call is not known
            trigger_time = self._clock.now()
            frame = self._waits.next_frame(patience, until_stop=False)
            if frame is not None:
                n_silent, position_fault = 0, ""
                if math.isfinite(angle):
                    position, position_fault = position_during_exposure(self._stage, angle, position)
                yield frame, i, position, not position_fault
                if position_fault:
                    attempts[i] += 1
                    reached_angle = math.nan
                    if len(tally.off_target) == attempts[i] == 1:
                        self._sink(Warned(f"Projection {i}: {position_fault}"))
                    if attempts[i] == TRIES:
                        tally.miss([i])
                        attempts[i] = 0
                    else:
                        i -= 1
                    self._wait_until_at_rest()
                continue
            tally.miss([i])
            n_silent += 1
            if n_silent == SILENT_EXPOSURES:
                raise InstrumentError(
                    f"Check the camera. {self._camera.name}: {n_silent} triggers in a row gave no frame "
                    f"within {patience:.3g} s each. Earlier frames are in the file."
                )
            self._arm_again(block.n - i)  # discards a late frame, which must not count as the next frame
        self._camera.disarm()

    def _wait_until_at_rest(self) -> None:
        deadline = self._clock.now() + STANDS_WITHIN
        while self._stage.moving() and self._clock.now() < deadline and not self._stop.stopping:
            self._clock.sleep(POLL)

    def _arm_again(self, n: int) -> None:
        self._camera.disarm()
        self._camera.arm(n)
