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
from beamline.scan.moves import POLL, go, looked_again
from beamline.scan.supervision import Supervision
from beamline.scan.tally import TRIES, BlockTally, Exposed
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
        frames = self._fly_scan.frames(taken) if block.trains else self._one_by_one(taken)
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
        while (after := self._waits.after_pause(i + 1, taken)) < block.n:
            if after <= i or tried[after]:
                self._arm_anew(block.n - after)
            i, angle = after, float(block.angles[after])
            self._stop.refuse_abort()
            if self._stop.stopping and not owed:
                break
            if math.isfinite(angle):
                if angle != stands_at and not (
                    go(self._stage, angle, self._clock, self._stop) and self._waits.rest(self._settle, owed)
                ):
                    break
                stands_at = angle
                position = self._stage.position()
            if not self._waits.rest(triggered + period - self._clock.now(), owed):
                break
            self._camera.software_trigger()
            # read after the call, because the time of the exposure within the call is not known
            triggered = self._clock.now()
            frame = self._waits.next_frame(patience, until_stop=False)
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

    def _arm_anew(self, n: int) -> None:
        self._camera.disarm()
        self._camera.arm(n)
