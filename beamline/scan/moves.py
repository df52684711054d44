"""Moves: brings stage, shutter and sample to the positions that a block needs, checks the positions afterwards, and
makes the instrument safe.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from beamline.core.errors import BeamlineError, InstrumentError
from beamline.core.events import Sink, Warned
from beamline.core.stop import ScanAborted, StopRequest
from beamline.core.text import count, spans
from beamline.plan.plan import Block
from beamline.plan.timeline import move_seconds
from beamline.scan.tally import OFF_TARGET_ADVICE
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from drivers.base.protocols import Devices, Rechecked, RotationStage

WRITTEN = "Writing the last frames"  # Message of the state `finishing`
SAFE = "Stage stopped, shutter closed; writing the last frames"  # the same, if this program operates the devices
UNSAFE = (
    "DANGER: stage, camera or shutter did not respond at the end of the scan. Check the instrument "
    "before anybody goes near the beam; writing the last frames"
)
"""The same if a device failed while the instrument was made safe. Warnings name the device."""
POLL = 0.02  # s between status queries of a moving stage


def move_and_wait(
    stage: RotationStage, angle: float, clock: Clock, stop: StopRequest, *, until_stop: bool = True
) -> bool:
    """Move to `angle` at full speed and wait. Returns False if a stop (or, on request, only an abort) interrupted the
    move."""
    limits = stage.limits
    distance = angle - stage.position()
    stage.start_move(angle, limits.max_speed)
    return wait_for_move(stage, move_seconds(distance, limits.max_speed, limits.acceleration), clock, stop, until_stop)


def wait_for_move(
    stage: RotationStage, seconds: float, clock: Clock, stop: StopRequest, until_stop: bool = True
) -> bool:
    """Wait for a move that should take `seconds`. Returns False if a stop ended it early."""
    deadline = clock.now() + 2 * seconds + 5.0
    while stage.moving():
        stop.refuse_abort()
        if until_stop and stop.stopping:
            stop_and_wait(stage, clock, stop)
            return False
        if clock.now() > deadline:
            break
        clock.sleep(POLL)
    stage.wait(timeout=POLL)  # raises an error if the stage still moves, or stopped before reaching the angle
    return True


def stop_and_wait(stage: RotationStage, clock: Clock, stop: StopRequest) -> None:
    """Decelerate and wait until the stage is at rest. Raises InstrumentError if it keeps moving."""
    limits = stage.limits
    deadline = clock.now() + 2 * limits.max_speed / limits.acceleration + 5.0
    stage.stop()
    while stage.moving():
        stop.refuse_abort()
        if clock.now() > deadline:
            raise InstrumentError(
                f"Use the emergency stop of {stage.name}: the stage is still moving after a stop command."
            )
        clock.sleep(POLL)


def position_during_exposure(stage: RotationStage, angle: float, before: float) -> tuple[float, str]:
    """Position of the stage during the exposure of a frame that was planned at `angle`, and a sentence if the position
    is wrong.

    The frame exists, and the stage was at `before` (rad) when its exposure began.
    """
    moving, after = stage.moving(), stage.position()
    target_counts, tolerance = stage.to_counts(angle), stage.limits.tolerance
    if not moving and all(abs(stage.to_counts(position) - target_counts) <= tolerance for position in (before, after)):
        return (before + after) / 2, ""
    motion = "is moving " if moving else ""
    return after, (
        f"the frame was exposed while the stage was not at the planned angle of {math.degrees(angle):.4f}°, although "
        f"the stage had reported its arrival there. The stage was at {math.degrees(before):.4f}° before the exposure "
        f"and {motion}at {math.degrees(after):.4f}° after it. {OFF_TARGET_ADVICE}"
    )


def set_shutter_and_sample(devices: Devices, block: Block, warm_up: Callable[[], None]) -> None:
    """Move shutter and sample to the positions that the block needs. If the shutter does not move, the scan ends.

    Args:
        warm_up: function that is called after a closed shutter has opened.
    """
    shutter, sample, kind = devices.shutter, devices.sample, block.kind
    if kind is FrameKind.DARK:
        shutter.close()
    else:
        sample.out() if kind is FrameKind.FLAT else sample.back(block.aside)
        cold = not shutter.is_open()
        shutter.open()
        if cold:
            warm_up()
    if wrong := _wrong_shutter(kind, shutter.is_open()):
        raise InstrumentError(
            f"{shutter.name}: {wrong}. Check the interlock of the shutter. Earlier frames are in the file."
        )


def position_checks_of(devices: Devices, kind: FrameKind, stop: StopRequest) -> dict[str, Callable[[], str]]:
    """For each device, by name, a function that tests whether the device is still in the position that this kind of
    frame needs."""
    shutter, remembered = devices.shutter, dict[str, Callable[[], str]]()
    if not shutter.by_hand:
        # A scan that is stopped during a pause ends with a closed shutter.
        remembered[shutter.name] = lambda: "" if stop.stopping else _wrong_shutter(kind, shutter.is_open())
    for device in (devices.sample, devices.filter, devices.monochromator):
        if isinstance(device, Rechecked) and kind is not FrameKind.DARK:
            remembered[device.name] = device.remember_place()
    return remembered


def require_in_place(
    position_checks: dict[str, Callable[[], str]], kind: FrameKind, rows: range, stop: StopRequest
) -> None:
    """Raise InstrumentError if a device has left the position that it had before a block."""
    moved = {name: problem for name, check in position_checks.items() if (problem := check())}
    if moved and rows and not stop.aborting:
        how_many = count(len(rows), kind.name.lower())
        row_numbers = spans(list(rows))
        raise InstrumentError(
            f"{'; '.join(f'{name}: {problem}' for name, problem in moved.items())}. The device was moved while "
            f"{how_many} (frames {row_numbers} of the file) were taken. Do not use these frames, because it is not "
            "known which frames are affected. Find out who or what moved the device, move it back, and repeat the "
            "scan. Frames taken before are good."
        )


def _wrong_shutter(kind: FrameKind, is_open: bool) -> str:
    """A sentence if the state of a shutter is wrong for this kind of frame; "" if it is right."""
    if is_open is not (kind is FrameKind.DARK):
        return ""
    wanted, actual = ("closed", "open") if kind is FrameKind.DARK else ("open", "closed")
    return f"the device is {actual}, but for {kind.name.lower()}s it must be {wanted}"


def make_safe(
    devices: Devices, home: float | None, clock: Clock, stop: StopRequest, sink: Sink
) -> tuple[list[BaseException], bool]:
    """Stop the stage, disarm camera and trigger output, and close the shutter. If a step fails, the others are still
    tried.

    Args:
        home: angle in rad to which the stage moves after the sample was brought back. None: neither stage nor sample
            moves.

    Returns:
        The first error of each step; and True if stage, camera or shutter may still be as during the scan.
    """
    stage, camera, shutter = devices.stage, devices.camera, devices.shutter
    failed: list[BaseException] = []

    def attempt(*actions: Callable[[], object]) -> bool:
        """Try the actions one after the other until one works. (A serial line that failed once often works again.)"""
        failures: list[BaseException] = []
        for action in actions:
            try:
                action()
            except ScanAborted:  # the stop was requested while the stage was moving here
                return attempt(stage.abort, stage.abort)
            except BaseException as error:  # a failure of one device must not leave the others unsafe
                failures.append(error)
            else:
                for failure in failures:
                    sink(Warned(in_words(failure)))
                return True
        failed.append(failures[0])
        return False

    stop_actions = (*[lambda: stop_and_wait(stage, clock, stop)] * 2, stage.abort)
    attempt(*((stage.abort, stage.abort) if stop.aborting else stop_actions))
    attempt(camera.disarm, camera.disarm)
    attempt(shutter.close, shutter.close)
    attempt(stage.disarm, stage.disarm)
    if home is None or failed or stop.aborting:
        return failed, bool(failed)
    attempt(devices.sample.back)
    went_home = attempt(lambda: move_and_wait(stage, home, clock, stop, until_stop=False))
    return failed, not (went_home or attempt(*stop_actions))


def in_words(error: BaseException) -> str:
    """The message of an error. If it is not an error of this program, the message includes its type."""
    return str(error) if isinstance(error, DeviceError | BeamlineError) else f"{type(error).__name__}: {error}"
