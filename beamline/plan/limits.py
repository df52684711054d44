"""Checks of a plan: positions of the triggers in counts, violated limits, and remarks for the operator."""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import degrees, rounded, size
from beamline.plan.plan import Block, FieldPlan, Mode, Place, ScanPlan
from drivers.base.protocols import CameraTiming, StageLimits, TriggerTrain
from drivers.stages.travel import least_interval


@dataclass(frozen=True)
class Scale:
    """Angle at count 0, and radians per count, of a stage whose counts are linear in the angle."""

    origin: float
    per_count: float

    @classmethod
    def of(cls, to_counts: Callable[[float], int]) -> Scale:
        """The scale of a stage, computed from its own conversion. It contains direction and zero."""
        zero = to_counts(0.0)
        per_count = 2 * math.pi / (to_counts(2 * math.pi) - zero)
        return cls(-zero * per_count, per_count)

    def angles(self, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(self.origin + counts * self.per_count, dtype=np.float64)


@dataclass(frozen=True)
class Flight:
    """Pulse trains of a fly scan."""

    trains: tuple[TriggerTrain, ...]  # one train per pass, in the order of the projections
    interval: int  # whole counts between neighbouring pulses of a pass (positive)
    step: int  # whole counts between neighbouring angles of all passes together
    exact: float  # the step without rounding
    drift: float  # largest shift of a projection by the rounding, in radians

    def counts(self) -> NDArray[np.int64]:
        """The count of every pulse, in the order of the projections."""
        return np.concatenate([train.start + train.interval * np.arange(train.n) for train in self.trains])


_OTHER_SPAN = 0.05  # accepted relative change of the range by rounding to counts: 9 degrees of 180


def plan_flight(angles: NDArray[np.float64], to_counts: Callable[[float], int]) -> Flight:
    """Pulse trains for `angles` (float64 [view], radians, in order), their spacing rounded to whole counts.

    The angles must lie on one equally spaced lattice and fall into passes of equal steps, as fixed, sector and
    interlaced plans do. The lattice step, not each angle, is rounded: a trigger output counts a fixed distance.

    Raises:
        ValueError: the plan is not possible as a fly scan; one sentence states why.
    """
    if angles.size < 2:
        raise ValueError(
            f"a fly scan needs at least 2 projections, but scan.angles has {angles.size}. Use scan.mode: step"
        )
    scale = Scale.of(to_counts)
    index, step = _lattice(angles, abs(scale.per_count))
    exact = step / abs(scale.per_count)
    whole = round(exact)
    if abs(whole / exact - 1) > _OTHER_SPAN:
        degrees_per_count = math.degrees(abs(scale.per_count))
        range_factor = whole / exact
        raise ValueError(
            f"the angular step of {math.degrees(step):.3g}° is {exact:.3g} counts of the stage "
            f"({degrees_per_count:.3g}° each), but the stage can trigger only on whole counts: the scan would cover "
            f"{range_factor:.3g} times the planned range. Take fewer projections, or a wider range in scan.angles "
            "(in degrees), or a stage with finer counts"
        )
    direction = 1 if scale.per_count > 0 else -1
    first = to_counts(float(angles[0])) - direction * whole * int(index[0])
    counts = first + direction * whole * index
    runs = _runs(counts)
    spacing = {abs(train.interval) for train in runs}
    if len(spacing) > 1 or min(train.n for train in runs) < 2:
        raise ValueError(
            "a rotating stage cannot trigger the projections in this order, because they are not in passes of equal "
            "steps. Use scan.mode: step, or a fixed, sector or interlaced plan"
        )
    drift = float(np.abs(scale.angles(counts) - angles).max())
    return Flight(tuple(runs), spacing.pop(), whole, exact, drift)


def _lattice(angles: NDArray[np.float64], count: float) -> tuple[NDArray[np.int64], float]:
    """Index of each angle on the lattice, counted from the smallest angle, and the step of the lattice in radians."""
    low, high = float(angles.min()), float(angles.max())
    step = (high - low) / (angles.size - 1)
    if step > 0:
        index = np.rint((angles - low) / step).astype(np.int64)
        deviation = float(np.abs(low + index * step - angles).max())
        # Half a count is lost to rounding anyway; a text file with few digits loses less than a hundredth of a step.
        if np.unique(index).size == angles.size and deviation <= max(count / 2, step / 100):
            return index, step
    raise ValueError(
        "a rotating stage cannot trigger at these angles, because they are not equally spaced. Use scan.mode: step, or "
        "a fixed, sector or interlaced plan"
    )


def _runs(counts: NDArray[np.int64]) -> list[TriggerTrain]:
    """The longest runs of equal differences, one after the other. A single count is a run of length one."""
    steps = np.diff(counts)
    ends = [*(1 + np.flatnonzero(np.diff(steps))).tolist(), steps.size]  # last count of each stretch of equal steps
    runs, first = list[TriggerTrain](), 0
    while first < counts.size - 1:
        end = ends[bisect(ends, first)]
        runs.append(TriggerTrain(int(counts[first]), int(steps[first]), end - first + 1))
        first = end + 1
    return [*runs, TriggerTrain(int(counts[first]), 0, 1)] if first < counts.size else runs


MOST_PASSES = 100
"""Largest number of passes of a step scan, because each pass stores the numbers of all projections that it does not
take."""
ROOM = 1.1
"""Required free disk space, as a multiple of the size of pixels and previews. The rest is for metadata of frames and
for other files."""
CLOSING = 20_000_000
"""Bytes that may be needed to close a file, with its group /exchange. A scan pauses if its frames and these bytes do
not fit on the disk."""
MARGIN = 1.01
"""Factor on the shortest trigger period of the camera. With a shorter period, jitter may lose frames (smallest camera
margin of tomoscan)."""


@dataclass(frozen=True, eq=False)
class PlanFacts:
    """A plan with its computed speeds, times and sizes, which the limits are checked against."""

    plan: ScanPlan
    views: Block
    flight: Flight | None
    stage: StageLimits
    camera: CameraTiming
    axis_col: float | None
    reach: tuple[float, float]
    blur_px: float
    skew_px: float
    total_bytes: int
    retake_bytes: int
    retake_seconds: float
    free_bytes: int | None


def violations(facts: PlanFacts) -> Iterator[str]:
    """One sentence for each violated limit."""
    plan = facts.plan
    if plan.mode is Mode.FLY:
        yield from _timing(facts)
        yield from _speed(facts)
        if not facts.stage.trigger_output:
            yield "a fly scan needs a stage with a trigger output, but this stage has none. Use scan.mode: step"
        elif facts.flight:
            yield from _spacing(facts.flight.interval, facts.stage)
    yield from _limits(facts)
    cols = facts.camera.shape[1]
    if facts.axis_col is not None and not -0.5 <= facts.axis_col <= cols - 0.5:
        last_col = cols - 1
        yield (
            f"optics.axis_col {facts.axis_col:g} is outside the columns of the frame, 0 ... {last_col}. Columns are "
            "counted in the region that is read out, after binning"
        )
    for name, field in (("flats", plan.flats), ("darks", plan.darks)):
        if field.at is not Place.NONE and field.count == 0:
            yield (
                f"no {name}: scan.{name}.count is 0; set a count of at least 1, or set scan.{name}.at to none for "
                f"a scan without {name}"
            )
    if plan.pass_views and plan.n_views > MOST_PASSES * plan.pass_views:
        smallest = math.ceil(plan.n_views / MOST_PASSES)
        yield (
            f"scan.pass_views {plan.pass_views} divides {plan.n_views} projections into more than {MOST_PASSES} "
            f"passes; set scan.pass_views to at least {smallest}, or to 0"
        )
    needed = facts.total_bytes + facts.retake_bytes
    if facts.free_bytes is not None and needed * ROOM + CLOSING > facts.free_bytes:
        yield (
            f"not enough disk space: the file needs {size(needed)} plus a reserve of a tenth, and "
            f"{size(CLOSING)} more when the file is closed, but {size(facts.free_bytes)} is free. Free some "
            "space, choose another storage.folder, or reduce the number of projections, the region or the "
            "binning"
        )


def remarks(facts: PlanFacts) -> Iterator[str]:
    """One sentence for each remark on the plan."""
    plan, camera = facts.plan, facts.camera
    yield from _rounding(facts)
    period = facts.views.period
    if facts.flight and abs(period - plan.period) > 1e-3 * plan.period:
        possible_speed = facts.flight.interval / period
        planned_speed = facts.flight.interval / plan.period
        yield (
            f"period_s becomes {period:.6g} instead of {plan.period:g}, because the stage can turn at "
            f"{possible_speed:.6g} counts/s, but not at {planned_speed:.6g} counts/s"
        )
    if plan.mode is Mode.FLY and camera.min_period <= period < MARGIN * camera.min_period:
        yield (
            f"a trigger every {period:.6g} s is less than 1 % above the camera's minimum of {camera.min_period:.6g} s. "
            "If a trigger comes slightly early, the camera ignores it and reports no error"
        )
    if facts.blur_px > 1:
        exposure = plan.exposure / facts.blur_px
        yield (
            f"motion blur is {facts.blur_px:.2f} px at the detector's edge; exposure_s <= {exposure:.3g} or a longer "
            f"period_s (now {plan.period:g}) keeps the blur under 1 px"
        )
    if facts.skew_px > 1:
        yield (
            f"the rolling shutter skews a point at the edge by {facts.skew_px:.2f} px between the first and the last "
            "row; turn slower, or read fewer rows"
        )
    criterion = math.ceil(math.pi / 2 * camera.shape[1])
    if plan.n_views < criterion:
        n_cols = camera.shape[1]
        yield (
            f"filtered back-projection will show streaks towards the edge, because the scan has {plan.n_views} "
            f"projections; expected at least {criterion} (pi/2 x {n_cols} columns)"
        )
    if plan.retakes:
        yield (
            f"after the last projection the scan takes up to {plan.retakes} projections again "
            "(monitor.retake_share), if the monitor flags them (monitor.retake). These projections add at most "
            f"{facts.retake_seconds:.0f} s and {size(facts.retake_bytes)}"
        )
    yield from _reference("flats", plan.flats, plan.exposure, "the intensity of the flats will be scaled")
    yield from _reference(
        "darks",
        plan.darks,
        plan.exposure,
        "these darks have other hot pixels and another dark current than the projections",
    )


def _timing(facts: PlanFacts) -> Iterator[str]:
    plan, camera, period = facts.plan, facts.camera, facts.views.period
    if plan.exposure > period:
        yield (
            f"scan.exposure_s {plan.exposure:g} is longer than scan.period_s {period:.4g}; "
            "shorten the exposure or lengthen the period"
        )
    if period < camera.min_period:
        rows, cols = camera.shape
        advised_period = rounded(camera.min_period * MARGIN, up=True)
        yield (
            f"scan.period_s {period:.4g} is below the camera's minimum of {camera.min_period:.6g} s between triggers "
            f"({rows} x {cols} px, {plan.exposure:g} s exposure); set scan.period_s >= {advised_period:g}, expose "
            "shorter or read fewer pixels"
        )


def _speed(facts: PlanFacts) -> Iterator[str]:
    if facts.flight and facts.flight.interval / facts.plan.period < 0.5:
        slowest = facts.flight.interval
        yield (
            f"with a projection every {facts.plan.period:g} s the stage would turn at less than one count per "
            f"second; set scan.period_s <= {slowest:g}, take fewer projections, or use scan.mode: step"
        )
    if facts.views.speed > facts.stage.max_speed * (1 + 1e-9):
        period = facts.plan.period * facts.views.speed / facts.stage.max_speed
        yield (
            f"the scan needs {degrees(facts.views.speed)}/s, but the stage turns at most "
            f"{degrees(facts.stage.max_speed)}/s; set scan.period_s >= {rounded(period, up=True):g} or take more "
            "projections"
        )


def _spacing(interval: int, stage: StageLimits) -> Iterator[str]:
    """Faults of the pulse spacing: the trigger output must separate the pulses at every speed up to the full speed."""
    least, unit = least_interval(stage), stage.interval_unit
    if interval % unit:
        yield (
            f"projections are {interval} counts of the stage apart, but a trigger output that is toggled needs a "
            f"multiple of {unit} counts. Take another number of projections, use devices.stage.toggle: false if "
            "the firmware supports it, or use scan.mode: step"
        )
    elif interval < least:
        fastest = interval / stage.pulse_spacing * 360 / stage.counts_per_turn
        yield (
            f"projections are {interval} counts of the stage apart, but the trigger output of the stage needs at "
            f"least {least} counts: {stage.pulse_spacing:g} s at its full speed of {degrees(stage.max_speed)}/s. "
            "Take fewer projections, a shorter devices.stage.pulse_width_s if the stage has this setting, or "
            f"devices.stage.max_speed_deg_s <= {rounded(fastest):g}"
        )


def _limits(facts: PlanFacts) -> Iterator[str]:
    low, high = facts.reach
    slack = math.pi / facts.stage.counts_per_turn
    if low < facts.stage.low - slack or high > facts.stage.high + slack:
        taxi = f" (with {degrees(facts.views.taxi)} of run-up at each end)" if facts.views.taxi else ""
        what_to_change = " or ".join(_ways_within(facts))
        yield (
            f"the stage would go from {degrees(low)} to {degrees(high)}{taxi}, but its limits are "
            f"{degrees(facts.stage.low)} ... {degrees(facts.stage.high)}; {what_to_change}"
        )


def _ways_within(facts: PlanFacts) -> Iterator[str]:
    """Ways to keep the stage within its limits: another start, a smaller range, or a shorter run-up with a longer
    period."""
    (low, high), stage, views = facts.reach, facts.stage, facts.views
    down, up = stage.low - low, stage.high - high  # the shift of all angles
    if down <= up:
        start = math.degrees(float(facts.plan.angles[0]) + (down if down > 0 else up))
        yield f"begin at {start:.6g} degrees (scan.angles.start_deg)"
    step, room = views.speed * views.period, views.taxi + min(-down, up)  # space for the run-up
    if views.taxi and room > 2 * step:
        yield f"set scan.period_s >= {rounded(step / math.sqrt(2 * stage.acceleration * (room - 2 * step)), up=True):g}"
    yield "use a smaller range in scan.angles"


def _rounding(facts: PlanFacts) -> Iterator[str]:
    flight, stage = facts.flight, facts.stage
    if flight is None or flight.drift <= 1.01 * math.pi / stage.counts_per_turn:
        return
    count = 2 * math.pi / stage.counts_per_turn
    exact_step = degrees(flight.exact * count)
    whole_step = degrees(flight.step * count)
    largest_change = degrees(flight.drift)
    yield (
        f"the step of {exact_step} is {flight.exact:.6g} counts; the stage can trigger only on whole counts, so the "
        f"step becomes {flight.step} counts = {whole_step}, and the angles of projections change by up to "
        f"{largest_change}. The file contains the angles at which the stage triggered"
    )


def _reference(name: str, field: FieldPlan, exposure: float, consequence: str) -> Iterator[str]:
    if field.at is Place.NONE:
        yield f"no {name} will be taken (scan.{name}.at: none)"
    elif field.exposure != exposure:
        yield f"{name} are exposed for {field.exposure:g} s and projections for {exposure:g} s; {consequence}"
