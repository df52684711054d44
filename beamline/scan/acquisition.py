"""Acquisition: the blocks of a timeline become frames in file order, and the instrument is always left safe."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np

from beamline.core.errors import BeamlineError, DataError, InstrumentError, ReferencesError, ScanStopped
from beamline.core.events import BlockDone, BlockStarted, Sink, StateEntered, Warned
from beamline.core.stop import ScanAborted, StopRequest
from beamline.core.text import count, spans
from beamline.plan.passes import Choice, Passes, passes_at_start, triggers_to_take
from beamline.plan.plan import Block, Timeline, middle_of_exposure, retake_block
from beamline.scan.control import State
from beamline.scan.exposures import ASTRAY_ADVICE, SLICE, TRIES, BlockTally, Exposures
from beamline.scan.ledger import LedgerError
from beamline.scan.references import REFERENCES
from beamline.scan.supervision import Supervision
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import CameraSettings, Devices, Rechecked

NAMED = 5  # views that a sentence names
DOUBTFUL = 0.2  # steps: larger possible errors of an angle are reported


@dataclass(frozen=True)
class RecordedBlock:
    """A block with its frames and missing triggers. again: it repeats views, so losing them is no failure."""

    block: Block
    taken: BlockTally
    again: bool = False


class Acquisition:
    """The frames of one scan. `frames()` may be called once; `missing` can be read at any time.

    Args:
        timeline: without violations.
        camera_settings: roi, binning and readout; each block sets its own exposure and trigger.
        settle: s to wait after each move of a step scan.
        sink: takes `BlockStarted`, `BlockDone` and warnings.
        supervision: what may pause the scan, or end it before its first projection, and gets its states.
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
        self._done: list[RecordedBlock] = []
        self.recovered = 0
        """Views that gave no frame at first, but when they were repeated."""
        self.unsafe = False
        """A device failed while the instrument was made safe: stage, camera or shutter may be as during the scan."""

    @property
    def n_frames(self) -> int:
        """Frames delivered so far."""
        return sum(done.taken.frames for done in self._done)

    @property
    def missing(self) -> list[int]:
        """Triggers, counted over the whole plan, that gave no frame so far; triggers not yet reached do not count."""
        return [done.block.first_trigger + i for done in self._done if not done.again for i in done.taken.missing]

    def frames(self) -> Generator[Frame, None, None]:
        """Frames, each with its own memory, its row in the file, its trigger and its angle.

        At the end, also when the caller closes the iterator, the stage is stopped, camera and trigger
        output are disarmed and the shutter is closed. Sample and stage return to where they were unless the scan was
        aborted or a device failed. A lost frame does not end the scan; the error is raised after the last frame.

        Raises:
            LedgerError: frames are missing, or some have no trigger; all others were delivered with their angles.
            ScanStopped: a stop was requested, and the scan has ended in order.
            ReferencesError: no projection was taken, because supervision refused them.
            ScanAborted: an abort, or a stop before the first frame.
            InstrumentError, DeviceError: a device failed.
        """
        home = self._devices.stage.position()
        devices_work = all_taken = False
        try:
            yield from self._blocks()
            devices_work = all_taken = True
        except ScanAborted as aborted:
            raise ScanAborted(f"{aborted}{self._discrepancies()}") from None
        except GeneratorExit:  # closed by the caller; no device has failed
            devices_work = True
            raise
        except (BeamlineError, DeviceError) as ended_by:
            devices_work = isinstance(ended_by, DataError)  # the disk failed
            self._warn_discrepancies()
            raise
        finally:
            failures = self._make_safe(home if devices_work and not self._stop.aborting else None)
            for error in failures[1:] if all_taken else failures:
                self._sink(Warned(_in_words(error)))
        if failures:
            self._warn_discrepancies()
            raise failures[0]
        self._raise_outcome()

    def _blocks(self) -> Iterator[Frame]:
        place, filter_ = self._timeline.plan.filter, self._devices.filter
        if filter_ is not None and place is not None and not self._stop.stopping:
            self._sink(StateEntered(self._supervision.states.state, f"The filter goes to {place}"))
            filter_.put(place)
        energy, monochromator = self._timeline.plan.energy, self._devices.monochromator
        if monochromator is not None and energy is not None and not self._stop.stopping:
            self._sink(StateEntered(self._supervision.states.state, f"The monochromator goes to {energy:.7g} keV"))
            monochromator.move_to(energy)
        for block in self._timeline.blocks:
            self._stop.refuse_abort()
            if not block.left:
                self._done.append(RecordedBlock(block, BlockTally()))
                continue
            views = block.kind is FrameKind.PROJECTION and not self._stop.stopping
            if views and (refused := self._supervision.refusal()):
                self._refused = refused
                return
            taken = any(done.block is block for done in self._done)  # wide views that were chosen
            if taken or (self._stop.stopping and not self._still_needed(block)):
                continue
            if block.kind is FrameKind.WIDE_VIEW:
                yield from self._wide(block)
            elif block.kind is FrameKind.PROJECTION and self._supervision.next_pass is not None:
                yield from self._pass_by_pass(block, self._supervision.next_pass)
            else:
                yield from self._block(RecordedBlock(block, BlockTally()))
            if block.kind is FrameKind.PROJECTION and not self._stop.stopping:
                yield from self._retake(block)

    def _pass_by_pass(self, views: Block, next_pass: Callable[[Passes], Choice]) -> Iterator[Frame]:
        """The views in passes, and what is chosen after each. What nobody chose is left to the plan.

        A scan that goes on begins with what is left of the pass that it was in, and with views that earlier ones lack.
        Where that pass had ended, it does not end anew, and the choice comes next.
        """
        plan, wide = self._timeline.plan, [b for b in self._timeline.blocks if b.kind is FrameKind.WIDE_VIEW and b.left]
        passes = passes_at_start(views, plan.pass_views * plan.frames_per_view, plan.choices, wide)
        choice, ended = Choice((Choice.NEXT, *plan.choices)[-1]), plan.choice_due
        rest = replace(views, stored=frozenset(range(views.n)) - triggers_to_take(*passes.done) | views.stored)
        due = [*([rest] if rest.left else []), *(wide if choice is Choice.WIDE else [])]
        while True:
            again = passes.done[-1] in passes.done[:-1]
            for block in due:
                if self._stop.stopping:
                    return
                done = RecordedBlock(block, BlockTally(), again)
                yield from self._wide(block) if block.kind is FrameKind.WIDE_VIEW else self._block(done)
                self._recover(done.taken.rows)
            if choice is Choice.RETAKE:
                yield from self._retake(views)
            if self._stop.stopping:
                return
            if not ended:
                self._supervision.pass_ended()
            ended = False
            passes = replace(passes, retakes=self._supervision.n_retakable(self._missing_views))
            if not (passes.to_come or passes.wide or passes.retakes):
                return
            choice = next_pass(passes)
            if choice is Choice.ENOUGH and not self._stop.stopping:
                self._stop.stop_as_enough("the views suffice")
            if self._stop.stopping or (choice is Choice.NEXT and not passes.to_come):
                return
            before, passes = passes, passes.after(choice)
            due = [*passes.done[len(before.done) :], *before.wide[len(passes.wide) :]]

    def _block(self, done: RecordedBlock) -> Iterator[Frame]:
        block, taken = done.block, done.taken
        self._done.append(done)
        what = block.kind.name.lower(), str(block.mode), block.left, self.n_frames
        self._sink(BlockStarted(*what, block.exposure, block.period))
        self._supervision.states.enter(_state_of(block))
        self._set_shutter_and_sample(block)
        first, looks = self.n_frames, self._remembered_places(block.kind)
        yield from self._exposures.take(block, first, taken)
        self._require_in_place(looks, block.kind, range(first, self.n_frames))
        if len(taken.astray) > 1:
            self._sink(Warned(_astray(block, taken)))
        if block.kind is FrameKind.FLAT:
            self._devices.sample.back()
        self._sink(BlockDone(*what, taken.frames, taken.missing, taken.lost, taken.ignored, taken.extra))

    def _retake(self, views: Block) -> Iterator[Frame]:
        """The views that supervision wants repeated. Each names the frame that it replaces, or has a missing trigger,
        which is then not missing. A repeated view without a frame is not a further failure."""
        retakes = self._supervision.retakes(self._missing_views)
        if not retakes:
            return
        triggers = np.array([retake.trigger for retake in retakes], np.int64)
        beyond = middle_of_exposure(views)[triggers]
        earlier = sum(done.block.left for done in self._done if done.again)
        done = RecordedBlock(retake_block(views, triggers), BlockTally(), again=True)
        for frame in self._block(done):
            i = frame.trigger
            angle, row, trigger = frame.angle - float(beyond[i]), retakes[i].row, views.n + earlier + i
            if frame.kind is FrameKind.INVALID:
                yield replace(frame, trigger=trigger)
                continue
            if row < 0:
                trigger = retakes[i].trigger
                self._recover([trigger])
            rows_astray = [astray_row for astray_row, _ in done.taken.astray.get(i, [])]
            tried = -1 if frame.replaces in rows_astray else frame.replaces
            yield replace(frame, angle=angle, trigger=trigger, replaces=max(row, tried))
        if rows := [retakes[i].row for i in done.taken.missing if retakes[i].row >= 0]:
            self._sink(Warned(f"Frames {spans(rows)} gave no frame when they were repeated."))

    @property
    def _missing_views(self) -> tuple[int, ...]:
        """Triggers of the views that gave no frame, in ascending order."""
        return tuple(sorted(i for taken in self._first_taken for i in taken.missing))

    @property
    def _first_taken(self) -> list[BlockTally]:
        """Tallies of the views, without those that repeat views."""
        kind = FrameKind.PROJECTION
        return [done.taken for done in self._done if done.block.kind is kind and not done.again]

    def _recover(self, triggers: Collection[int]) -> None:
        """These views have a frame: they are not missing, if they were."""
        for taken in self._first_taken:
            for trigger in {*taken.missing}.intersection(triggers):
                taken.missing.remove(trigger)
                self.recovered += 1

    def _wide(self, block: Block) -> Iterator[Frame]:
        """Wide views, at angles of the first views. Nothing replaces anything."""
        views = self._timeline.views
        beyond = float(max(middle_of_exposure(views), key=abs))  # every pass goes the same way; one pulse has none
        first = block.first_trigger - views.first_trigger  # in files wide views are views, too
        for frame in self._block(RecordedBlock(block, BlockTally())):
            invalid = frame.kind is FrameKind.INVALID
            yield frame if invalid else replace(frame, angle=frame.angle - beyond, trigger=first + frame.trigger)

    def _still_needed(self, block: Block) -> bool:
        """A stopped scan still needs this block: projections were taken, but no darks or flats of this block's kind, or
        these at the start alone, and only that its views are enough stops it.

        A stop during the block itself ends it, because each block is considered once.
        """
        kinds = {done.block.kind for done in self._done if done.taken.frames}
        needed = self._stop.enough or block.kind not in kinds
        return block.kind in REFERENCES and FrameKind.PROJECTION in kinds and needed

    def _set_shutter_and_sample(self, block: Block) -> None:
        """Bring shutter and sample where the block needs them; a shutter that does not move ends the scan."""
        shutter, sample, kind = self._devices.shutter, self._devices.sample, block.kind
        if kind is FrameKind.DARK:
            shutter.close()
        else:
            sample.out() if kind is FrameKind.FLAT else sample.back(block.aside)
            cold = not shutter.is_open()
            shutter.open()
            if cold:
                self._warm_up()
        if wrong := _wrong_shutter(kind, shutter.is_open()):
            raise InstrumentError(f"{shutter.name}: {wrong}. Check its interlock. Earlier frames are in the file.")

    def _remembered_places(self, kind: FrameKind) -> dict[str, Callable[[], str]]:
        """What stands in the beam for this kind of frame, by name, with what says whether it still does."""
        shutter, remembered = self._devices.shutter, dict[str, Callable[[], str]]()
        if not shutter.by_hand:
            # A scan that is stopped in a pause ends with a closed one.
            remembered[shutter.name] = lambda: "" if self._stop.stopping else _wrong_shutter(kind, shutter.is_open())
        for device in (self._devices.sample, self._devices.filter, self._devices.monochromator):
            if isinstance(device, Rechecked) and kind is not FrameKind.DARK:
                remembered[device.name] = device.remember_place()
        return remembered

    def _require_in_place(self, looks: dict[str, Callable[[], str]], kind: FrameKind, rows: range) -> None:
        """InstrumentError if a device that was moved and then believed is no longer where it stood before a block."""
        moved = {name: problem for name, look in looks.items() if (problem := look())}
        if moved and rows and not self._stop.aborting:
            raise InstrumentError(
                f"{'; '.join(f'{name}: {problem}' for name, problem in moved.items())}. It was moved while "
                f"{count(len(rows), kind.name.lower())} (frames {spans(list(rows))} of the file) were taken: which of "
                "them show it elsewhere is not known, so none should be used. Look who or what moved it, bring it "
                "back, and take the scan again. What was taken before is good."
            )

    def _warm_up(self) -> None:
        """Wait with an open shutter until the scintillator is warm; a stop ends the wait."""
        if not (seconds := self._timeline.plan.warm_up):
            return
        self._sink(StateEntered(self._supervision.states.state, f"The scintillator warms up for {seconds:g} s"))
        deadline = self._clock.now() + seconds
        while (left := deadline - self._clock.now()) > 0 and not self._stop.stopping:
            self._clock.sleep(min(SLICE, left))

    def wait_while_paused(self, reopen: bool = True) -> None:
        """Wait with a closed shutter while a pause is requested; a stop ends it.

        A manual shutter is asked for after the state is reported. In a pause that ends by itself it stays open.

        Args:
            reopen: frames follow at once.
        """
        pause, states, block = self._supervision.pause, self._supervision.states, self._done[-1].block
        reason = pause.reason
        if not reason or self._stop.stopping:
            return
        shutter = self._devices.shutter
        if not shutter.by_hand:
            shutter.close()
        self._supervision.wait_in_pause()  # earlier input does not count
        states.enter(State.PAUSED, f"Paused{'' if shutter.by_hand else ' with a closed shutter'}: {reason}")
        while pause.reason and not self._stop.stopping:
            if shutter.by_hand and not pause.ends_by_itself:
                shutter.close()  # asks once
            if self._supervision.wait_in_pause():
                pause.resume()
        if not self._stop.stopping:
            if reopen:
                self._set_shutter_and_sample(block)
            states.enter(_state_of(block), "The scan goes on")

    def _make_safe(self, home: float | None) -> list[BaseException]:
        """Stop the stage, disarm, close the shutter; all steps are tried. Returns the first error of each one."""
        stage, camera, shutter = self._devices.stage, self._devices.camera, self._devices.shutter
        failed: list[BaseException] = []

        def attempt(*ways: Callable[[], object]) -> bool:
            """Try the actions in turn until one works: a serial line that failed once often works again."""
            failures: list[BaseException] = []
            for way in ways:
                try:
                    way()
                except ScanAborted:  # requested while the stage was moving here
                    return attempt(stage.abort, stage.abort)
                except BaseException as error:  # a failure of one device must not leave the others unsafe
                    failures.append(error)
                else:
                    for failure in failures:
                        self._sink(Warned(_in_words(failure)))
                    return True
            failed.append(failures[0])
            return False

        stop = (self._exposures.stand, self._exposures.stand, stage.abort)
        attempt(*((stage.abort, stage.abort) if self._stop.aborting else stop))
        attempt(camera.disarm, camera.disarm)
        attempt(shutter.close, shutter.close)
        attempt(stage.disarm, stage.disarm)
        self.unsafe = bool(failed)
        if home is None or failed or self._stop.aborting:
            return failed
        attempt(self._devices.sample.back)
        if not attempt(lambda: self._exposures.go(home, until_stop=False)):
            self.unsafe = not attempt(*stop)
        return failed

    def _raise_outcome(self) -> None:
        blocks = [block for block in self._timeline.blocks if block.kind is FrameKind.PROJECTION]
        planned = sum(block.n for block in blocks)
        views = sum(len(taken.rows) for taken in self._first_taken) + sum(len(block.stored) for block in blocks)
        if self._stop.aborting:
            raise ScanAborted(f"Aborted: {self._stop.reason}.{self._discrepancies()}")
        if self._refused:
            raise ReferencesError(self._refused)
        if self._stop.stopping and not self._stop.enough:
            if self.n_frames == 0:
                raise ScanAborted(f"Interrupted before the first frame: {self._stop.reason}.")
            raise ScanStopped(
                f"Stopped after {views} of {planned} projections: {self._stop.reason}. The file is complete as far as "
                f"it goes.{self._discrepancies()}"
            )
        if text := self._discrepancies():
            raise LedgerError(
                f"{text.strip()} Every other frame is in the file with the angle of its trigger. Repeat these views, "
                "or reconstruct without them; a longer period_s leaves the camera more time.",
                self.missing,
            )

    def _warn_discrepancies(self) -> None:
        """Report missing frames if the scan ends with another error, which would hide them."""
        if text := self._discrepancies():
            self._sink(Warned(text.strip()))

    def _discrepancies(self) -> str:
        """Sentences on missing, extra and doubtful frames so far, each after a space."""
        return "".join(f" {text}" for done in self._done if (text := _describe(done)))


def _wrong_shutter(kind: FrameKind, is_open: bool) -> str:
    """What is wrong with a shutter for this kind of frame; "" if it is as it must be."""
    if is_open is not (kind is FrameKind.DARK):
        return ""
    wanted, actual = ("closed", "open") if kind is FrameKind.DARK else ("open", "closed")
    return f"it is {actual}, {kind.name.lower()}s need it {wanted}"


def _state_of(block: Block) -> State:
    """The state in which a block begins, and goes on after a pause."""
    if block.kind not in REFERENCES:
        return State.TAXI if block.trains else State.ACQUIRING
    return State.DARKS if block.kind is FrameKind.DARK else State.FLATS


def _in_words(error: BaseException) -> str:
    """The message of an error; with its type if it is not ours."""
    return str(error) if isinstance(error, DeviceError | BeamlineError) else f"{type(error).__name__}: {error}"


def _astray(block: Block, taken: BlockTally) -> str:
    """A sentence on frames exposed while the stage was not at its angle, and where it was."""
    where = [
        f"view {trigger} at {math.degrees(float(block.angles[trigger])):.4g}°: {math.degrees(places[-1][1]):.4f}°"
        for trigger, places in list(taken.astray.items())[:NAMED]
    ]
    more = f", and {len(taken.astray) - NAMED} more" if len(taken.astray) > NAMED else ""
    return (
        f"The stage was not at its angle in {sum(map(len, taken.astray.values()))} exposures of {len(taken.astray)} "
        f"views ({', '.join(where)}{more}). {ASTRAY_ADVICE}."
    )


def _describe(done: RecordedBlock) -> str:
    """Sentences on missing, extra and doubtful frames of a block; a view that was repeated misses none."""
    block, taken, noun = done.block, done.taken, done.block.kind.name.lower()
    text = ""
    if taken.missing and not done.again:
        n = len(taken.missing)
        angles = np.degrees(block.angles[taken.missing])
        at = "" if np.isnan(angles).any() else f" (from {angles[0]:.4g}° to {angles[-1]:.4g}°)"
        text = f"{n} of {block.n} {noun}s are missing: {spans(taken.missing)}{at}."
        if taken.lost:
            text += (
                f" {taken.lost} were exposed but never delivered by the camera: `beamline doctor` looks at its link "
                "and at the disk."
            )
        if astray := sum(trigger in taken.astray for trigger in taken.missing):
            text += f" In {astray} of them the stage was not at its angle in any of {TRIES} exposures (invalid rows)."
        if taken.ignored:
            text += f" {taken.ignored} triggers were ignored by the camera, which was not ready."
    if untriggered := taken.extra - taken.unconfirmed:
        text += f" {untriggered} frames came without a trigger and are kept as invalid rows."
    if taken.unconfirmed:
        text += (
            f" {taken.unconfirmed} frames came while the stage braked, whose angles neither their times nor the place "
            "where it stands confirm. The cause is noise on the trigger line, or another deceleration than the "
            "stage's. They are kept as invalid rows."
        )
    if taken.shift:
        text += (
            f" The angles of a pass may all be wrong by up to {taken.shift} steps: it is not known at which of its "
            "ends frames are missing or too many."
        )
    if text and taken.off > DOUBTFUL:
        text += (
            f" A frame came {taken.off:.2f} periods off its trigger: its angle may be wrong by as much of a step "
            "(warnings of `timing` name such frames)."
        )
    return text.strip()
