"""Timeline: speeds, times and sizes of a plan with one stage and one camera, as values and as lines for the operator.

Before the projections, the scan takes darks and then flats. After the projections, it takes laterally offset
projections, flats and then darks. In a fly scan the stage rotates at step / period, rounded to whole counts per second
(the block of projections has this period). The stage starts far enough before the first pulse to reach this speed
(`taxi_angle`), and stops at the same distance after the last pulse. All passes have the same direction, and the stage
returns at full speed between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import degrees, size
from beamline.monitor.digest import preview_shape
from beamline.plan.limits import Flight, PlanFacts, Scale, plan_flight, remarks, violations
from beamline.plan.plan import (
    Block,
    FieldPlan,
    Mode,
    Place,
    Retake,
    ScanPlan,
    Timeline,
    offset_block,
    retake_block,
    spread_retakes,
    summed,
)
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraTiming, StageLimits, TriggerTrain

BYTES_PER_PIXEL, BYTES_PER_BLOCK = 2, 4  # uint16 frames, float32 previews


def work_out(
    plan: ScanPlan,
    stage: StageLimits,
    to_counts: Callable[[float], int],
    camera: CameraTiming,
    *,
    axis_col: float | None = None,
    preview_bin: int = 4,
    free_bytes: int | None = None,
) -> Timeline:
    """Compute blocks, times, bytes and all violated limits. No device is used, so a dry run calls the same function.

    The duration assumes that the stage starts at its zero and returns there, and does not include moves of shutter and
    sample.

    Args:
        to_counts: conversion of the stage from radians to whole counts.
        camera: timing of the camera with the exposure of the projections.
        axis_col: column of the rotation axis (None: the middle). Blur and skew are computed at the edge that is farther
            from the axis. preview_bin: side in pixels of the blocks of the previews that the file also has. free_bytes:
            free bytes of the disk; None: the disk space is not checked.
    """
    scale = Scale.of(to_counts)
    flight, broken = _flight(plan, to_counts)
    blocks = tuple(_blocks(plan, flight, scale, stage, camera))
    views = next(block for block in blocks if block.kind is FrameKind.PROJECTION)
    speed = views.speed * _half_width(camera, axis_col)
    frame_bytes = math.prod(camera.shape) * BYTES_PER_PIXEL
    bytes_per_row = row_bytes(camera.shape, preview_bin)
    facts = PlanFacts(
        plan=plan,
        views=views,
        flight=flight,
        stage=stage,
        camera=camera,
        axis_col=axis_col,
        reach=_reach(views),
        blur_px=speed * plan.exposure,
        skew_px=speed * camera.row_period * (camera.shape[0] - 1),
        total_bytes=bytes_per_row * sum(block.n_to_take for block in blocks),
        retake_bytes=bytes_per_row * plan.retakes,
        retake_seconds=_retake_seconds(plan, views, stage, camera),
        free_bytes=free_bytes,
    )
    parts = _parts(plan, blocks, stage, camera)
    return Timeline(
        blocks=blocks,
        duration=sum(parts.values()),
        frame_bytes=frame_bytes,
        total_bytes=facts.total_bytes,
        step_counts=flight.interval if flight else 0,
        step=flight.interval * abs(scale.per_count) if flight else 0.0,
        blur_px=facts.blur_px,
        skew_px=facts.skew_px,
        violations=(*broken, *violations(facts)),
        remarks=tuple(remarks(facts)),
        plan=plan,
        retake_seconds=facts.retake_seconds,
        parts=parts,
    )


def row_bytes(shape: tuple[int, int], preview_bin: int) -> int:
    """Number of bytes in the file for a frame of this shape, with its preview."""
    return math.prod(shape) * BYTES_PER_PIXEL + math.prod(preview_shape(shape, preview_bin)) * BYTES_PER_BLOCK


def _flight(plan: ScanPlan, to_counts: Callable[[float], int]) -> tuple[Flight | None, list[str]]:
    """The pulse trains of a fly scan, or the reason why the plan is not possible as a fly scan. For a step scan, None
    and no reason."""
    if plan.mode is not Mode.FLY:
        return None, []
    try:
        return plan_flight(plan.angles, to_counts), []
    except ValueError as error:
        return None, [str(error)]


def _parts(plan: ScanPlan, blocks: Sequence[Block], stage: StageLimits, camera: CameraTiming) -> Mapping[str, float]:
    """Seconds for the blocks by kind, for the way back to zero, and for the warm-up at each opening of the shutter.
    Parts of 0 s are left out."""
    *starts, end = _stands(blocks)
    placed = zip(blocks, starts, strict=True)
    return summed(
        *(
            (block.kind.name.lower(), block_seconds(block, stage, camera, plan.settle, angle))
            for block, angle in placed
        ),
        ("return", move_seconds(end, stage.max_speed, stage.acceleration)),
        ("warm_up", plan.warm_up * _openings(blocks)),
    )


def _openings(blocks: Iterable[Block]) -> int:
    """Number of times that the shutter opens. It is closed at first."""
    lit = [False, *(block.kind is not FrameKind.DARK for block in blocks if block.n_to_take)]
    return sum(after and not before for before, after in pairwise(lit))


def taxi_angle(speed: float, acceleration: float, step: float) -> float:
    """Run-up in radians. It is a whole number of angular steps, and at least half a step longer than the distance
    needed to reach `speed`.

    The number of steps is ceil(acceleration distance / step + 0.5), as in tomoscan. So the speed is constant at the
    first pulse.
    """
    return math.ceil(speed**2 / (2 * acceleration) / step + 0.5) * step


def move_seconds(distance: float, speed: float, acceleration: float) -> float:
    """Duration of a move with a trapezoidal velocity profile (triangular if the top speed is not reached)."""
    distance = abs(distance)
    if distance < speed**2 / acceleration:
        return 2 * math.sqrt(distance / acceleration)
    return distance / speed + speed / acceleration


@dataclass(frozen=True)
class FlyPass:
    """A pass of a block of a fly scan: its first trigger within the block, its pulses, and the angles at which the
    stage starts and stops."""

    first: int
    train: TriggerTrain
    start: float
    end: float


def passes(block: Block) -> list[FlyPass]:
    """The passes of a block of a fly scan. Each train is a pass; it is divided if some of its frames are already
    stored.

    The stage starts `taxi` before the first angle and stops `taxi` after the last one.
    """
    return [flown for first, train in _firsts(block.trains) for flown in _pieces(block, first, train)]


def _firsts(trains: Iterable[TriggerTrain]) -> Iterator[tuple[int, TriggerTrain]]:
    first = 0
    for train in trains:
        yield first, train
        first += train.n


def _pieces(block: Block, first: int, train: TriggerTrain) -> Iterator[FlyPass]:
    end = first + train.n
    out = math.copysign(block.taxi, float(block.angles[end - 1] - block.angles[first]))
    stored = sorted(i for i in block.stored if first <= i < end)
    for before, after in pairwise((first - 1, *stored, end)):
        if (n := after - before - 1) > 0:
            pulses = TriggerTrain(train.start + (before + 1 - first) * train.interval, train.interval, n)
            angles = block.angles[before + 1 : after]
            yield FlyPass(before + 1, pulses, float(angles[0]) - out, float(angles[-1]) + out)


def block_seconds(block: Block, stage: StageLimits, camera: CameraTiming, settle: float, start: float = 0.0) -> float:
    """Duration of a block with its moves. `start` is the angle of the stage before the block."""
    if not block.n_to_take:
        return 0.0
    tail = block.exposure + camera.readout
    if block.mode is Mode.STATIC or (block.mode is Mode.FLY and not block.trains):
        return (block.n - 1) * block.period + tail
    seconds, position = 0.0, start
    if block.mode is Mode.FLY:
        for flown in passes(block):
            seconds += move_seconds(flown.start - position, stage.max_speed, stage.acceleration)
            seconds += move_seconds(flown.end - flown.start, block.speed, stage.acceleration)
            position = flown.end
        return seconds + tail
    for i, angle in enumerate(np.delete(block.angles, list(block.stored)).tolist()):
        stands = bool(i) and angle == position
        ready = 0.0 if stands else move_seconds(angle - position, stage.max_speed, stage.acceleration) + settle
        seconds += max(block.period, camera.min_period, tail + ready) if i else ready
        position = angle
    return seconds + tail


def _blocks(
    plan: ScanPlan, flight: Flight | None, scale: Scale, stage: StageLimits, camera: CameraTiming
) -> Iterable[Block]:
    row = 0
    missing = plan.end_references
    before = [(FrameKind.DARK, plan.darks), (FrameKind.FLAT, plan.flats)]
    for kind, field in before:
        if field.count and field.at in (Place.START, Place.BOTH):
            yield _static(kind, field, row, plan, camera, stored=missing is not None)
            row += field.count
    views = _views(plan, flight, row, scale, stage)
    yield views
    row += views.n
    for mm in plan.offset_places:
        stored = frozenset(i for i in range(plan.offset_views) if row - views.first_trigger + i in plan.stored)
        yield replace(offset_block(views, plan.offset_views, mm), first_trigger=row, stored=stored)
        row += plan.offset_views
    for kind, field in reversed(before):
        if field.count and field.at in (Place.END, Place.BOTH):
            yield _static(kind, field, row, plan, camera, stored=missing is not None and kind not in missing)
            row += field.count


def _static(
    kind: FrameKind, field: FieldPlan, row: int, plan: ScanPlan, camera: CameraTiming, *, stored: bool
) -> Block:
    """Shortest period of darks or flats: their exposure plus the overhead of the camera per frame."""
    period = field.exposure + max(camera.min_period - plan.exposure, camera.readout)
    kept = frozenset(range(field.count)) if stored else frozenset[int]()
    return Block(kind, Mode.STATIC, row, np.full(field.count, np.nan), field.exposure, period, stored=kept)


def _views(plan: ScanPlan, flight: Flight | None, row: int, scale: Scale, stage: StageLimits) -> Block:
    counts = flight.counts() if flight else np.rint((plan.angles - scale.origin) / scale.per_count).astype(np.int64)
    angles, stored = scale.angles(counts), plan.stored & {*range(counts.size)}
    if flight is None:
        return Block(FrameKind.PROJECTION, plan.mode, row, angles, plan.exposure, plan.period, stored=stored)
    # The speed of the pulse generator is a whole number of counts per second, so only certain periods are possible.
    rate = max(1, round(flight.interval / plan.period))
    speed, period = rate * abs(scale.per_count), flight.interval / rate
    step, before = (n * abs(scale.per_count) for n in (flight.step, stage.run_up * flight.interval + flight.step))
    taxi = max(taxi_angle(speed, stage.acceleration, step), before)
    return Block(FrameKind.PROJECTION, Mode.FLY, row, angles, plan.exposure, period, flight.trains, speed, taxi, stored)


def _half_width(camera: CameraTiming, axis_col: float | None) -> float:
    cols = camera.shape[1]
    return cols / 2 if axis_col is None else max(axis_col + 0.5, cols - 0.5 - axis_col)


def _reach(views: Block) -> tuple[float, float]:
    """The smallest and the largest angle of the stage's moves."""
    ends = np.array([(flown.start, flown.end) for flown in passes(views)]) if views.trains else views.angles
    ends = ends if ends.size else views.angles  # all frames are stored
    return float(ends.min()), float(ends.max())


def _retake_seconds(plan: ScanPlan, views: Block, stage: StageLimits, camera: CameraTiming) -> float:
    """Time for the largest number of projections that may be taken again, evenly spread, after the last projection."""
    if not plan.retakes:
        return 0.0
    triggers = [retake.trigger for retake in spread_retakes([Retake(i, i) for i in range(views.n)], plan.retakes)]
    block = retake_block(views, np.array(triggers, np.int64))
    return block_seconds(block, stage, camera, plan.settle) + move_seconds(
        _end(views), stage.max_speed, stage.acceleration
    )


def _end(block: Block) -> float:
    """Angle of the stage after a block of projections; its zero if the block takes no frame."""
    if not block.n_to_take:
        return 0.0
    return passes(block)[-1].end if block.trains else float(block.angles[-1])


def _stands(blocks: Iterable[Block]) -> list[float]:
    """Angles of the stage before each block, and after the last block."""
    moving = (block if block.n_to_take and block.mode is not Mode.STATIC else None for block in blocks)
    return [*accumulate(moving, lambda angle, block: angle if block is None else _end(block), initial=0.0)]


def describe(
    plan: ScanPlan, timeline: Timeline, stage: StageLimits, camera: CameraTiming, *, free_bytes: int | None = None
) -> list[str]:
    """The timeline as text, for `check` and `scan --dry-run`."""
    lines = [
        f"{'rows':>13}  {'what':<10}  {'frames':>6}  {'how':<6}  {'exposure':>9}  {'period':>9}  {'time':>9}  angles"
    ]
    for block, row, angle in zip(timeline.blocks, timeline.first_rows, _stands(timeline.blocks), strict=False):
        if not block.n_to_take:
            continue
        seconds = block_seconds(block, stage, camera, plan.settle, angle)
        lines.append(
            f"{row:>6}-{row + block.n_to_take - 1:<6}  {block.kind.name.lower():<10}  {block.n_to_take:>6}  "
            f"{block.mode:<6}  {block.exposure:>7.4g} s  {block.period:>7.4g} s  {seconds:>7.1f} s  "
            f"{_angles(block.angles)}"
        )
    views = timeline.views
    rows, cols = camera.shape
    stored = f" ({len(views.stored)} of them already taken)" if views.stored else ""
    several = f" of {plan.frames_per_view} frames each" if plan.frames_per_view > 1 else ""
    facts = [("views", f"{plan.n_views}{several}{stored}, {plan.scheme} angles, {plan.mode} scan")]
    if views.trains:
        passes = f" in each of {len(views.trains)} passes" if len(views.trains) > 1 else ""
        count = 2 * math.pi / stage.counts_per_turn
        facts += [
            ("step", f"{degrees(timeline.step)} = {timeline.step_counts} counts of {degrees(count)}{passes}"),
            ("speed", f"{degrees(views.speed)}/s (the stage's maximum is {degrees(stage.max_speed)}/s)"),
            ("taxi", f"{degrees(views.taxi)} of run-up before the first trigger and after the last one"),
            ("blur", f"{timeline.blur_px:.3g} px at the detector's edge during an exposure"),
            (
                "skew",
                (
                    f"{timeline.skew_px:.3g} px at the detector's edge between the first and the last row (rolling "
                    "shutter)"
                ),
            ),
        ]
    else:
        facts.append(("moves", f"at {degrees(stage.max_speed)}/s, then {plan.settle:g} s to settle"))
    if plan.offset_places:
        facts.append(
            ("offset", f"the sample {', '.join(f'{mm:+.4g}' for mm in plan.offset_places)} mm across the beam")
        )
    total = size(timeline.total_bytes)
    free = "" if free_bytes is None else f"; {size(free_bytes)} free"
    facts += [
        (
            "camera",
            f"{rows} x {cols} px of {camera.bits} bits, shortest time between triggers {camera.min_period:.6g} s",
        ),
        ("duration", f"{hms_text(timeline.duration)} (without shutter and sample moves)"),
        ("size", f"{timeline.n_frames} frames of {size(timeline.frame_bytes)} and previews = {total}{free}"),
    ]
    lines += ["", *(f"{name:<10}{text}" for name, text in facts)]
    lines += [f"{'remark':<10}{text}" for text in timeline.remarks]
    return lines


def _angles(angles: NDArray[np.float64]) -> str:
    if np.isnan(angles).any():
        return "-"
    return f"{degrees(float(angles[0]))} ... {degrees(float(angles[-1]))}"


def hms_text(seconds: float) -> str:
    """`1:02:03 = 3723.0 s`."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02} = {seconds:.1f} s"
