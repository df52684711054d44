"""Waits: what a scan waits for while it takes a block, and what ends the wait: a stop, an abort or a pause."""

from __future__ import annotations

from collections.abc import Callable

from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.scan.supervision import Supervision
from beamline.scan.tally import BlockTally
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.frame import FrameKind
from drivers.base.protocols import Camera, CameraFrame

SLICE = 0.5  # s: longest wait for a frame between two checks of the stop request


class Waits:
    """Waits for a frame, for some seconds, or for the end of a pause.

    Args:
        wait_while_paused: called before each frame with the stage at rest, and before each run-up.
    """

    def __init__(
        self, camera: Camera, clock: Clock, stop: StopRequest, sink: Sink, supervision: Supervision,
        wait_while_paused: Callable[[], None],
    ) -> None:  # fmt: skip
        self._camera, self._clock, self._stop, self._sink = camera, clock, stop, sink
        self._supervision, self._wait_while_paused = supervision, wait_while_paused

    def after_pause(self, next_trigger: int, tally: BlockTally) -> int:
        """Wait as long as the scan is paused. Returns the next trigger: `next_trigger`, or the next trigger without
        a stored frame.

        After a loss of the beam, the next trigger is the first one that may be without beam. This and later triggers
        are repeated.
        """
        block = tally.block
        next_trigger = next(
            (candidate for candidate in range(next_trigger, block.n) if candidate not in block.stored), block.n
        )
        if next_trigger == block.n and tally.rows and block.kind is not FrameKind.DARK:
            self._supervision.wait_for_beam_reading()
        self._wait_while_paused()
        since = self._supervision.pause.take_unlit_since()
        doubtful = [trigger for trigger, (_, time) in tally.rows.items() if time + block.exposure > since]
        if not doubtful or block.kind is FrameKind.DARK:
            return next_trigger
        first_doubtful = min(doubtful)
        tally.missing[:] = [missing for missing in tally.missing if missing < first_doubtful]
        return first_doubtful

    def rest(self, seconds: float, still_needed: bool) -> bool:
        """Wait for some seconds. Returns False if a stop ended the wait early. In a block that is still needed, a stop
        does not end the wait.
        """
        deadline = self._clock.now() + seconds
        while seconds > SLICE:
            self._stop.refuse_abort()
            if self._stop.stopping and not still_needed:
                return False
            self._clock.sleep(SLICE)
            seconds = deadline - self._clock.now()
        self._clock.sleep(seconds)
        return True

    def next_frame(self, timeout: float, until_stop: bool) -> CameraFrame | None:
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
                if remaining <= SLICE or (until_stop and self.interrupted):
                    return None
            except DeviceError as error:
                if failed:
                    raise
                failed = True
                self._sink(Warned(str(error)))

    @property
    def interrupted(self) -> bool:
        """True if a stop or a pause is requested."""
        return self._stop.stopping or bool(self._supervision.pause.reason)
