"""Acquisition: the blocks of a timeline become frames in file order, and the instrument is always left safe."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np

from beamline.core.errors import BeamlineError, InstrumentError, ScanStopped
from beamline.core.events import Emit
from beamline.core.stop import ScanAborted, StopRequest
from beamline.core.text import spans
from beamline.plan.plan import Block, Timeline
from beamline.scan.exposures import Exposures, Taken
from beamline.scan.ledger import LedgerError
from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.frame import Frame, FrameKind
from drivers.protocols import CameraSettings, Devices

NOUN = {FrameKind.PROJECTION: "projection", FrameKind.FLAT: "flat", FrameKind.DARK: "dark"}


@dataclass(frozen=True)
class Done:
    """A block and what became of it."""

    block: Block
    taken: Taken


class Acquisition:
    """One scan. `frames()` may be called once; what is missing can be read at any time.

    Args:
        timeline: without violations.
        camera_settings: roi, binning and readout; exposure and trigger are each block's own.
        settle: s to wait after each move of a step scan.
        emit: takes (event, data) for block_started, block_done and warning.
    """

    def __init__(
        self,
        devices: Devices,
        timeline: Timeline,
        camera_settings: CameraSettings,
        settle: float,
        clock: Clock,
        stop: StopRequest,
        emit: Emit = lambda event, data: None,
    ) -> None:
        self._devices, self._timeline, self._stop, self._emit = devices, timeline, stop, emit
        self._exposures = Exposures(devices, camera_settings, settle, clock, stop, emit)
        self._done: list[Done] = []
        self.unsafe = False
        """At the end something did not obey: stage, camera or shutter may be as the scan left them."""

    @property
    def n_frames(self) -> int:
        """Frames delivered so far."""
        return sum(done.taken.frames for done in self._done)

    @property
    def missing(self) -> list[int]:
        """Triggers, counted over the whole plan, that gave no frame so far (those never reached are not among them)."""
        return [done.block.first_row + i for done in self._done for i in done.taken.missing]

    def frames(self) -> Generator[Frame, None, None]:
        """Frames, each with its own memory, its row in the file, its trigger and its angle.

        However it ends (also when the caller closes the iterator): stage stopped, camera and trigger output disarmed,
        shutter closed; the sample and the stage go back to where they were unless the scan was aborted or a device
        failed. A lost frame does not end the scan; the error comes when everything else is taken.

        Raises:
            LedgerError: frames are missing, or some have no trigger; all others were delivered with their angles.
            ScanStopped: a stop was asked for and heeded.
            ScanAborted: an abort, or a stop before the first frame.
            InstrumentError, DeviceError: a device failed.
        """
        home = self._devices.stage.position()
        calm = whole = False
        try:
            yield from self._blocks()
            calm = whole = True
        except ScanAborted as aborted:
            raise ScanAborted(f"{aborted}{self._unbalanced()}") from None
        except GeneratorExit:  # the caller gave up; the devices are well
            calm = True
            raise
        finally:
            failures = self._make_safe(home if calm and not self._stop.aborting else None)
            for error in failures[1:] if whole else failures:
                self._emit("warning", {"message": _in_words(error)})
        if failures:
            raise failures[0]
        self._verdict()

    def _blocks(self) -> Iterator[Frame]:
        for block in self._timeline.blocks:
            if self._stop.aborting:
                raise ScanAborted(f"Aborted: {self._stop.reason}.")
            if self._stop.stopping and not self._owed(block):
                continue
            done = Done(block, Taken())
            self._done.append(done)
            what = {"kind": block.kind.name.lower(), "mode": str(block.mode), "n": block.n, "first_row": self.n_frames}
            self._emit("block_started", {**what, "exposure": block.exposure, "period": block.period})
            self._prepare(block.kind)
            yield from self._exposures.take(block, self.n_frames, done.taken)
            if block.kind is FrameKind.FLAT:
                self._devices.sample.back()
            taken = done.taken
            self._emit(
                "block_done",
                {
                    **what,
                    "frames": taken.frames,
                    "missing": taken.missing,
                    "lost": taken.lost,
                    "ignored": taken.ignored,
                    "extra": taken.extra,
                },
            )

    def _owed(self, block: Block) -> bool:
        """References that a stopped scan still needs: projections were taken, and nothing of this kind was.

        A stop during this very block ends it for good, since a block is asked for only once.
        """
        kinds = {done.block.kind for done in self._done if done.taken.frames}
        return block.kind is not FrameKind.PROJECTION and FrameKind.PROJECTION in kinds and block.kind not in kinds

    def _prepare(self, kind: FrameKind) -> None:
        """Shutter and sample as the kind of frame needs them; a shutter that does not obey ends the scan."""
        shutter, sample = self._devices.shutter, self._devices.sample
        if kind is FrameKind.DARK:
            shutter.close()
        else:
            sample.out() if kind is FrameKind.FLAT else sample.back()
            shutter.open()
        if shutter.is_open() is (kind is FrameKind.DARK):
            wanted, found = ("closed", "open") if kind is FrameKind.DARK else ("open", "closed")
            raise InstrumentError(
                f"{shutter.name}: it is {found}, {NOUN[kind]}s need it {wanted}. Check its interlock. "
                "What was taken before is in the file."
            )

    def _make_safe(self, home: float | None) -> list[Exception]:
        """Every step is tried, whatever became of the one before; the first failure of each that did not work."""
        stage, camera, shutter = self._devices.stage, self._devices.camera, self._devices.shutter
        failed: list[Exception] = []

        def attempt(*ways: Callable[[], object]) -> bool:
            """One way after the other until one works: a line that was disturbed once often works again."""
            failures: list[Exception] = []
            for way in ways:
                try:
                    way()
                except ScanAborted:  # it came while the stage was moving here
                    return attempt(stage.abort, stage.abort)
                except Exception as error:  # a defect in one device must not leave the others unsafe
                    failures.append(error)
                else:
                    for failure in failures:
                        self._emit("warning", {"message": _in_words(failure)})
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
        if not attempt(lambda: self._exposures.go_home(home)):
            self.unsafe = not attempt(*stop)
        return failed

    def _verdict(self) -> None:
        views = sum(done.taken.frames for done in self._done if done.block.kind is FrameKind.PROJECTION)
        planned = sum(block.n for block in self._timeline.blocks if block.kind is FrameKind.PROJECTION)
        if self._stop.aborting:
            raise ScanAborted(f"Aborted: {self._stop.reason}.{self._unbalanced()}")
        if self._stop.stopping:
            if self.n_frames == 0:
                raise ScanAborted(f"Interrupted before anything was acquired: {self._stop.reason}.")
            raise ScanStopped(
                f"Stopped after {views} of {planned} projections: {self._stop.reason}. The file is complete as far as "
                f"it goes.{self._unbalanced()}"
            )
        if unbalanced := self._unbalanced():
            raise LedgerError(
                f"{unbalanced.strip()} Every other frame is in the file with its own angle. Repeat these views, or "
                "reconstruct without them; a longer period_s leaves the camera more time.",
                self.missing,
            )

    def _unbalanced(self) -> str:
        """What is missing, extra or doubtful so far, a sentence after another, each after a space."""
        return "".join(f" {text}" for done in self._done if (text := _account(done)))


def _in_words(error: Exception) -> str:
    """Failures of devices speak for themselves; of a defect its kind matters."""
    return str(error) if isinstance(error, DeviceError | BeamlineError) else f"{type(error).__name__}: {error}"


def _account(done: Done) -> str:
    """What is missing of a block, in sentences."""
    block, taken, noun = done.block, done.taken, NOUN[done.block.kind]
    text = ""
    if taken.missing:
        n = len(taken.missing)
        angles = np.degrees(block.angles[taken.missing])
        at = "" if np.isnan(angles).any() else f" (from {angles[0]:.4g}° to {angles[-1]:.4g}°)"
        text = f"{n} of {block.n} {noun}s are missing: {spans(taken.missing)}{at}."
        if taken.lost:
            text += (
                f" {taken.lost} were exposed but never delivered by the camera: `beamline doctor` looks at its link "
                "and at the disk."
            )
        if taken.ignored:
            text += f" {taken.ignored} triggers were ignored by the camera, which was not ready."
    if taken.extra:
        text += f" {taken.extra} frames came without a trigger and are kept as invalid rows."
    if taken.shift:
        text += (
            f" The angles of a pass may all be wrong by up to {taken.shift} steps: it is not known at which of its "
            "ends frames are missing."
        )
    return text.strip()
