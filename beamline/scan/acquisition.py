"""Acquisition: takes the frames of a timeline in file order, and always leaves the instrument in a safe state."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace

import numpy as np

from beamline.core.errors import BeamlineError, DataError, ReferencesError, ScanStopped
from beamline.core.events import BlockDone, BlockStarted, Sink, StateEntered, Warned
from beamline.core.stop import ScanAborted, StopRequest
from beamline.core.text import spans
from beamline.plan.passes import Choice, Passes, passes_at_start, triggers_to_take
from beamline.plan.plan import Block, Timeline, middle_of_exposure, retake_block
from beamline.scan.control import State
from beamline.scan.exposures import Exposures
from beamline.scan.ledger import LedgerError
from beamline.scan.moves import in_words, make_safe, position_checks_of, require_in_place, set_shutter_and_sample
from beamline.scan.references import REFERENCES, copied
from beamline.scan.supervision import Supervision
from beamline.scan.tally import (
    BlockTally,
    discrepancies,
    missing_views,
    off_target_sentence,
    projection_tallies,
    recover,
)
from beamline.scan.waits import SLICE
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, Devices


class Acquisition:
    """Takes the frames of one scan. `frames()` may be called once; `missing` can be read at any time.

    Args:
        timeline: timeline of the scan; it must have no violations. camera_settings: roi, binning and readout; each
            block sets its own exposure and trigger. settle: waiting time in s after each move of a step scan. sink:
            gets the events `BlockStarted` and `BlockDone`, and warnings. supervision: callbacks that may pause the
            scan, or end it before its first projection. They also get the states of the scan.
    """

    def __init__(
        self,
        devices: Devices,
        timeline: Timeline,
        camera_settings: CameraSettings,
        settle: float,
        clock: Clock,
        stop: StopRequest,
        sink: Sink = lambda event: None,
        supervision: Supervision | None = None,
    ) -> None:
        self._devices, self._timeline, self._stop, self._sink, self._clock = devices, timeline, stop, sink, clock
        self._supervision, self._refused = supervision or Supervision(), ""
        self._exposures = Exposures(
            devices, camera_settings, settle, clock, stop, sink, self._supervision, self.wait_while_paused
        )
        self._done: list[BlockTally] = []
        self.recovered = 0
        """Number of projections that gave no frame at first, but gave one when they were taken again."""
        self.unsafe = False
        """True if a device failed while the instrument was made safe. Stage, camera or shutter may still be as during
        the scan."""

    @property
    def n_frames(self) -> int:
        """Number of frames delivered so far."""
        return sum(tally.frames for tally in self._done)

    @property
    def missing(self) -> list[int]:
        """Triggers (counted over the whole plan) that gave no frame so far. Triggers that were not reached yet do not
        count."""
        return [tally.block.first_trigger + i for tally in self._done if not tally.is_retake for i in tally.missing]

    def frames(self) -> Generator[Frame, None, None]:
        """Yields the frames, each with its own memory, its row in the file, its trigger and its angle.

        At the end, or when the caller closes the iterator, the stage is stopped, camera and trigger output are
        disarmed, and the shutter is closed. Sample and stage return to their first positions, unless the scan was
        aborted or a device failed. A lost frame does not end the scan; the error is raised after the last frame.

        Raises:
            LedgerError: frames are missing, or some frames have no trigger. All other frames were delivered with their
                angles. ScanStopped: a stop was requested, and the scan has ended cleanly.
            ReferencesError: no projection was taken, because supervision found that darks or flats cannot be used.
            ScanAborted: an abort was requested, or a stop before the first frame.
            InstrumentError, DeviceError: a device failed.
        """
        home = self._devices.stage.position()
        devices_work = all_taken = False
        try:
            yield from self._blocks()
            devices_work = all_taken = True
        except ScanAborted as aborted:
            raise ScanAborted(f"{aborted}{discrepancies(self._done)}") from None
        except GeneratorExit:  # the caller closed the iterator; no device has failed
            devices_work = True
            raise
        except (BeamlineError, DeviceError) as ended_by:
            devices_work = isinstance(ended_by, DataError)  # in this case the disk failed, not a device
            self._warn_discrepancies()
            raise
        finally:
            failures, self.unsafe = make_safe(
                self._devices, home if devices_work else None, self._clock, self._stop, self._sink
            )
            for error in failures[1:] if all_taken else failures:
                self._sink(Warned(in_words(error)))
        if failures:
            self._warn_discrepancies()
            raise failures[0]
        self._raise_outcome()

    def _blocks(self) -> Iterator[Frame]:
        self._supervision.turn()
        place, filter_ = self._timeline.plan.filter, self._devices.filter
        if filter_ is not None and place is not None and not self._stop.stopping:
            self._sink(StateEntered(self._supervision.states.state, f"Moving the filter to {place}"))
            filter_.put(place)
        energy, monochromator = self._timeline.plan.energy, self._devices.monochromator
        if monochromator is not None and energy is not None and not self._stop.stopping:
            self._sink(StateEntered(self._supervision.states.state, f"Moving the monochromator to {energy:.7g} keV"))
            monochromator.move_to(energy)
        enough = False  # the projections
        for block in self._timeline.blocks:
            self._stop.refuse_abort()
            if not block.n_to_take:
                self._done.append(BlockTally(block))
                continue
            views = block.kind is FrameKind.PROJECTION and not self._stop.stopping
            if views and (refusal := self._supervision.refusal()):
                self._refused = refusal
                return
            # Laterally offset projections may have been taken already, if they were chosen after a pass.
            if any(t.block is block for t in self._done) or (self._stop.stopping and not self._still_needed(block)):
                continue
            if block.kind is FrameKind.OFFSET_VIEW:
                yield from self._offset(block)
            elif block.kind is FrameKind.PROJECTION and self._supervision.next_pass is not None:
                enough = yield from self._pass_by_pass(block, self._supervision.next_pass)
            else:
                yield from self._block(BlockTally(block))
            if block.kind is FrameKind.PROJECTION and not (enough or self._stop.stopping):
                yield from self._retake(block)

    def _pass_by_pass(self, views: Block, next_pass: Callable[[Passes], Choice]) -> Generator[Frame, None, bool]:
        """Take the projections in passes, with a decision after each pass. Returns True if the projections are enough.
        If nobody decides, the scan follows its plan.

        A resumed scan begins with the rest of the pass in which it was interrupted, and with projections that are
        missing from earlier passes. If that pass had ended, its end is not reported again, and the decision comes
        first.
        """
        plan, blocks = self._timeline.plan, [block for block in self._timeline.blocks if block.n_to_take]
        offset_blocks = [block for block in blocks if block.kind is FrameKind.OFFSET_VIEW]
        passes = passes_at_start(views, plan.pass_views * plan.frames_per_view, plan.choices, offset_blocks)
        choice, ended_before = Choice((Choice.NEXT, *plan.choices)[-1]), plan.choice_due
        unfinished = replace(views, stored=frozenset(range(views.n)) - triggers_to_take(*passes.done) | views.stored)
        blocks = [*([unfinished] if unfinished.n_to_take else []), *(offset_blocks if choice is Choice.OFFSET else [])]
        if not self._done:  # no darks or flats were taken before, and the decision may come first
            self._done.append(BlockTally(replace(views, stored=frozenset(range(views.n)))))
            self._supervision.states.enter(_state_of(views))
        while True:
            is_repeated = passes.done[-1] in passes.done[:-1]
            for block in blocks:
                if self._stop.stopping:
                    return False
                tally = BlockTally(block, is_repeated)
                yield from self._offset(block) if block.kind is FrameKind.OFFSET_VIEW else self._block(tally)
                self.recovered += recover(self._done, tally.rows)
            if choice is Choice.RETAKE:
                yield from self._retake(views)
            if self._stop.stopping:
                return False
            if not ended_before:
                self._supervision.pass_ended()
            ended_before = False
            passes = replace(passes, retakes=self._supervision.n_retakable(missing_views(self._done)))
            if not (passes.to_come or passes.retakes):
                return False
            choice = next_pass(passes)
            if choice is Choice.ENOUGH:
                return True
            if self._stop.stopping or (choice is Choice.NEXT and not passes.to_come):
                return False
            passes_before, passes = passes, passes.after(choice)
            blocks = [*passes.done[len(passes_before.done) :], *passes_before.offset[len(passes.offset) :]]

    def _block(self, tally: BlockTally) -> Iterator[Frame]:
        block = tally.block
        self._done.append(tally)
        block_values = block.kind.name.lower(), str(block.mode), block.n_to_take, self.n_frames
        self._sink(BlockStarted(*block_values, block.exposure, block.period))
        self._supervision.states.enter(_state_of(block))
        if recorded_frames := self._supervision.recorded(block):
            yield from copied(tally, recorded_frames, self.n_frames)
        else:
            yield from self._exposed(tally)
        self._sink(BlockDone(*block_values, tally.frames, tally.missing, tally.lost, tally.ignored, tally.extra))

    def _exposed(self, tally: BlockTally) -> Iterator[Frame]:
        block = tally.block
        set_shutter_and_sample(self._devices, block, self._warm_up)
        first_row, position_checks = self.n_frames, position_checks_of(self._devices, block.kind, self._stop)
        yield from self._exposures.take(tally, first_row)
        require_in_place(position_checks, block.kind, range(first_row, self.n_frames), self._stop)
        if len(tally.off_target) > 1:
            self._sink(Warned(off_target_sentence(tally)))
        if block.kind is FrameKind.FLAT:
            self._devices.sample.back()

    def _retake(self, views: Block) -> Iterator[Frame]:
        """Take again the projections that the supervision requests.

        Each of them either names the frame that it replaces, or has a missing trigger, which then no longer counts as
        missing. If a repeated projection gives no frame, this is not an additional failure.
        """
        retakes = self._supervision.retakes(missing_views(self._done))
        if not retakes:
            return
        triggers = np.array([retake.trigger for retake in retakes], np.int64)
        angle_to_middle = middle_of_exposure(views)[triggers]
        n_repeated = sum(earlier_tally.block.n_to_take for earlier_tally in self._done if earlier_tally.is_retake)
        tally = BlockTally(retake_block(views, triggers), is_retake=True)
        for frame in self._block(tally):
            i = frame.trigger
            angle, row, trigger = frame.angle - float(angle_to_middle[i]), retakes[i].row, views.n + n_repeated + i
            if frame.kind is FrameKind.INVALID:
                yield replace(frame, trigger=trigger)
                continue
            if row < 0:
                trigger = retakes[i].trigger
                self.recovered += recover(self._done, [trigger])
            rows_astray = [astray_row for astray_row, _ in tally.off_target.get(i, [])]
            replaces = -1 if frame.replaces in rows_astray else frame.replaces
            yield replace(frame, angle=angle, trigger=trigger, replaces=max(row, replaces))
        if rows := [retakes[i].row for i in tally.missing if retakes[i].row >= 0]:
            self._sink(
                Warned(f"Frames {spans(rows)}: the exposure was repeated, but the camera again delivered no frame.")
            )

    def _offset(self, block: Block) -> Iterator[Frame]:
        """Take laterally offset projections, at angles of the first projections. They do not replace other
        projections."""
        views = self._timeline.views
        # every pass has the same direction; a single pulse has no direction
        angle_to_middle = float(max(middle_of_exposure(views), key=abs))
        # in files, laterally offset projections also have the kind projection
        first_trigger = block.first_trigger - views.first_trigger
        for frame in self._block(BlockTally(block)):
            angle, trigger = frame.angle - angle_to_middle, first_trigger + frame.trigger
            yield frame if frame.kind is FrameKind.INVALID else replace(frame, angle=angle, trigger=trigger)

    def _still_needed(self, block: Block) -> bool:
        """True if a stopped scan still needs this block: the scan has projections, and the block has darks or flats of
        a kind that is missing.

        A stop during the block itself ends it, because each block is considered once.
        """
        kinds = {tally.block.kind for tally in self._done if tally.frames}
        return block.kind in REFERENCES and FrameKind.PROJECTION in kinds and block.kind not in kinds

    def _warm_up(self) -> None:
        """Wait with open shutter until the scintillator is warm. A stop ends the wait."""
        if not (seconds := self._timeline.plan.warm_up):
            return
        self._sink(StateEntered(self._supervision.states.state, f"Warming up the scintillator for {seconds:g} s"))
        deadline = self._clock.now() + seconds
        while (remaining := deadline - self._clock.now()) > 0 and not self._stop.stopping:
            self._clock.sleep(min(SLICE, remaining))

    def wait_while_paused(self, reopen: bool = True) -> None:
        """Wait with closed shutter as long as a pause is requested. A stop ends the wait.

        If the shutter is manual, the operator is asked to move it after the state was reported. In a pause that ends
        automatically the shutter stays open.

        Args:
            reopen: open the shutter afterwards, because frames follow at once.
        """
        pause, states, block = self._supervision.pause, self._supervision.states, self._done[-1].block
        reason = pause.reason
        if not reason or self._stop.stopping:
            return
        shutter = self._devices.shutter
        if not shutter.by_hand:
            shutter.close()
        self._supervision.wait_in_pause()  # ignore earlier input
        states.enter(State.PAUSED, f"Paused{'' if shutter.by_hand else ' with a closed shutter'}: {reason}")
        while pause.reason and not self._stop.stopping:
            if shutter.by_hand and not pause.ends_by_itself:
                shutter.close()  # asks once
            if self._supervision.wait_in_pause():
                pause.resume()
        if not self._stop.stopping:
            if reopen:
                set_shutter_and_sample(self._devices, block, self._warm_up)
            states.enter(_state_of(block), "The scan continues")

    def _raise_outcome(self) -> None:
        blocks = [block for block in self._timeline.blocks if block.kind is FrameKind.PROJECTION]
        planned = sum(block.n for block in blocks)
        views = sum(len(tally.rows) for tally in projection_tallies(self._done)) + sum(
            len(block.stored) for block in blocks
        )
        if self._stop.aborting:
            raise ScanAborted(f"Aborted: {self._stop.reason}.{discrepancies(self._done)}")
        if self._refused:
            raise ReferencesError(self._refused)
        if self._stop.stopping:
            if self.n_frames == 0:
                raise ScanAborted(f"Interrupted before the first frame: {self._stop.reason}.")
            raise ScanStopped(
                f"Stopped after {views} of {planned} projections: {self._stop.reason}. The file contains "
                f"everything that was taken until then.{discrepancies(self._done)}"
            )
        if text := discrepancies(self._done):
            raise LedgerError(
                f"{text.strip()} All other frames are in the file with the angle of their trigger. Repeat the "
                "missing projections, or reconstruct without these projections. A longer period_s gives the camera "
                "more time.",
                self.missing,
            )

    def _warn_discrepancies(self) -> None:
        """Report missing frames if the scan ends with another error, which would otherwise hide them."""
        if text := discrepancies(self._done):
            self._sink(Warned(text.strip()))


def _state_of(block: Block) -> State:
    """The state of the scan when a block begins, and when it continues after a pause."""
    if block.kind not in REFERENCES:
        return State.TAXI if block.trains else State.ACQUIRING
    return State.DARKS if block.kind is FrameKind.DARK else State.FLATS
