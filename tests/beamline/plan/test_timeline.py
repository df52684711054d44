"""Timeline: rows, pulses, times and limits compared with values worked out by hand and by brute force."""

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from beamline.plan import plan as angles
from beamline.plan.plan import FieldPlan, Mode, Place, ScanPlan, Timeline
from beamline.plan.timeline import block_seconds, move_seconds, passes, taxi_angle, work_out
from drivers.base.errors import DeviceRefused
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraTiming, StageLimits
from drivers.stages.travel import Travel

DEG = math.pi / 180
STAGE = StageLimits(360_000, 30 * DEG, 60 * DEG, -5 * DEG, 365 * DEG, True)
CAMERA = CameraTiming(shape=(144, 252), min_period=0.051, readout=0.0006, row_period=3.6e-6, bits=16)
PLAN = ScanPlan(
    angles=angles.fixed(360),
    mode=Mode.FLY,
    exposure=0.05,
    period=0.1,
    settle=0.1,
    darks=FieldPlan(10, Place.START, 0.05),
    flats=FieldPlan(20, Place.BOTH, 0.05),
    scheme="fixed",
)


def to_counts(angle: float) -> int:
    return round(angle / (2 * math.pi) * 360_000)


def worked(
    plan: ScanPlan = PLAN, stage: StageLimits = STAGE, camera: CameraTiming = CAMERA, **more: object
) -> Timeline:
    return work_out(plan, stage, to_counts, camera, **more)  # type: ignore[arg-type]


def test_a_fly_scan_worked_by_hand() -> None:
    timeline = worked(axis_col=125.5)
    assert [(b.kind.name, b.mode, b.first_trigger, b.n) for b in timeline.blocks] == [
        ("DARK", Mode.STATIC, 0, 10),
        ("FLAT", Mode.STATIC, 10, 20),
        ("PROJECTION", Mode.FLY, 30, 360),
        ("FLAT", Mode.STATIC, 390, 20),
    ]
    views = timeline.blocks[2]
    # 180 deg / 360 = 0.5 deg = 500 counts; 0.5 deg in 0.1 s = 5 deg/s; 5**2 / (2 * 60) = 0.208 deg to accelerate,
    # that is 0.417 steps, and ceil(0.417 + 0.5) = 1 step of taxi.
    assert timeline.step_counts == 500
    assert timeline.step == pytest.approx(0.5 * DEG)
    assert views.speed == pytest.approx(5 * DEG)
    assert views.taxi == pytest.approx(0.5 * DEG)
    np.testing.assert_allclose(views.angles, np.arange(360) * 0.5 * DEG, atol=1e-12)
    (flown,) = passes(views)
    assert (flown.start, flown.end) == (pytest.approx(-0.5 * DEG), pytest.approx(180.0 * DEG))
    # Half the detector is 126 px: 5 deg/s * 0.05 s = 0.00436 rad.
    assert timeline.blur_px == pytest.approx(126 * 0.25 * DEG)
    assert timeline.skew_px == pytest.approx(126 * 5 * DEG * 3.6e-6 * 143)
    assert (timeline.frame_bytes, timeline.total_bytes) == (72_576, (72_576 + 36 * 63 * 4) * 410)
    assert timeline.n_frames == 410
    # To -0.5 deg: 2 sqrt(0.5/60); the pass: 180.5 deg at 5 deg/s and one ramp's 1/12 s; back to zero: 180/30 + 1/2 s.
    pass_and_moves = 2 * math.sqrt(0.5 / 60) + 180.5 / 5 + 5 / 60 + (180 / 30 + 0.5)
    references = (10 + 20 + 20 - 3) * 0.051  # one period less than frames in each block, and ...
    tails = 4 * 0.0506  # ... the last exposure and readout of every block
    assert timeline.duration == pytest.approx(pass_and_moves + references + tails)
    assert timeline.parts["dark"] == pytest.approx(9 * 0.051 + 0.0506)
    assert timeline.parts["flat"] == pytest.approx(2 * (19 * 0.051 + 0.0506))
    assert timeline.parts["return"] == pytest.approx(180 / 30 + 0.5)
    assert timeline.in_beam == timeline.parts["projection"] and sum(timeline.parts.values()) == timeline.duration
    assert timeline.violations == ()


def test_a_step_scan_worked_by_hand() -> None:
    plan = replace(PLAN, angles=angles.from_text("0\n10\n10.0004\n-1"), mode=Mode.STEP, scheme="file")
    timeline = worked(plan)
    views = timeline.blocks[2]
    assert (views.mode, views.trains, views.speed, views.taxi) == (Mode.STEP, (), 0.0, 0.0)
    # Each view at its nearest whole count, in the order asked for.
    np.testing.assert_allclose(views.angles / DEG, [0, 10, 10, -1], atol=1e-12)
    assert (timeline.step_counts, timeline.blur_px, timeline.skew_px) == (0, 0.0, 0.0)
    # Moves of 0, 10 and 11 deg (triangles: below 30**2 / 60 = 15 deg), 0.1 s to settle, 0.0506 s to expose and read.
    # The second frame at 10 deg needs neither move nor settling, only the period of 0.1 s.
    times = [0.1506, 2 * math.sqrt(10 / 60) + 0.1506, 0.1, 2 * math.sqrt(11 / 60) + 0.1506]
    assert block_seconds(views, STAGE, CAMERA, plan.settle) == pytest.approx(sum(times))
    slow = replace(plan, period=5.0)
    assert block_seconds(worked(slow).blocks[2], STAGE, CAMERA, plan.settle) == pytest.approx(0.1 + 3 * 5.0 + 0.0506)
    assert timeline.violations == ()


@given(
    views=st.integers(2, 200),
    passes=st.sampled_from([1, 2, 3, 4, 8]),
    start=st.floats(0, 180),
    backwards=st.booleans(),
    darks=st.integers(0, 5),
    flats=st.integers(0, 5),
    at=st.tuples(st.sampled_from(Place), st.sampled_from(Place)),
    period=st.floats(0.06, 10),
)
def test_rows_are_contiguous_and_every_view_has_its_pulse(
    views: int,
    passes: int,
    start: float,
    backwards: bool,
    darks: int,
    flats: int,
    at: tuple[Place, Place],
    period: float,
) -> None:
    views = max(2, views // passes) * passes
    theta = angles.interlaced(views, passes, start * DEG, -math.pi if backwards else math.pi)
    plan = replace(
        PLAN, angles=theta, period=period, darks=FieldPlan(darks, at[0], 0.05), flats=FieldPlan(flats, at[1], 0.1)
    )
    timeline = worked(plan)
    row = 0
    for block in timeline.blocks:
        assert block.first_trigger == row
        assert block.n > 0
        row += block.n
    assert row == timeline.n_frames
    taken = {kind: sum(b.n for b in timeline.blocks if b.kind is kind) for kind in FrameKind}
    times = {Place.NONE: 0, Place.START: 1, Place.END: 1, Place.BOTH: 2}
    assert taken[FrameKind.DARK] == darks * times[at[0]]
    assert taken[FrameKind.FLAT] == flats * times[at[1]]
    (block,) = (b for b in timeline.blocks if b.kind is FrameKind.PROJECTION)
    pulses = [train.start + i * train.interval for train in block.trains for i in range(train.n)]
    assert len(pulses) == views == block.n
    np.testing.assert_allclose(block.angles, np.array(pulses) * math.pi / 180_000, atol=1e-9)
    assert np.abs(block.angles - theta).max() <= (views + 1) * math.pi / 360_000 + 1e-9
    assert [train.end for train in block.trains][-1] == pulses[-1]
    # Between pulses of a pass exactly one period goes by, and the speed is a whole number of counts a second, the
    # nearest one; the run-up suffices to reach that speed before the first pulse.
    assert block.speed * block.period == pytest.approx(timeline.step)
    rate = block.speed / (math.pi / 180_000)
    assert rate == pytest.approx(round(rate))
    assert abs(rate - timeline.step_counts / period) <= 0.5 + 1e-6
    lattice = timeline.step / len(block.trains)
    assert block.taxi >= block.speed**2 / (2 * STAGE.acceleration) + lattice / 2 - 1e-12
    assert timeline.step == pytest.approx(timeline.step_counts * math.pi / 180_000)


@pytest.mark.parametrize("passes", [1, 4])
def test_a_stage_that_needs_room_before_a_train_gets_it(passes: int) -> None:
    plan = replace(PLAN, angles=angles.interlaced(180, passes), period=2.0)
    slow = worked(plan).views
    roomy = worked(plan, replace(STAGE, run_up=1)).views
    (train, *_), lattice = roomy.trains, math.pi / 180
    interval = train.interval * math.pi / 180_000
    assert slow.taxi == pytest.approx(lattice)  # the run-up of a slow scan
    assert roomy.taxi == pytest.approx(interval + lattice)  # more than an interval, and still whole steps


@given(distance=st.floats(0, 400), speed=st.floats(0.5, 60), acceleration=st.floats(1, 200))
def test_move_time_against_integration(distance: float, speed: float, acceleration: float) -> None:
    """Distance run in the computed time, by integrating the trapezoid, is the distance."""
    total = move_seconds(-distance, speed, acceleration)
    t = np.linspace(0, total, 4001)
    v = np.minimum(np.minimum(acceleration * t, acceleration * (total - t)), speed)
    assert np.trapezoid(v, t) == pytest.approx(distance, rel=1e-3, abs=1e-9)


@given(speed=st.floats(1e-4, 2), acceleration=st.floats(1e-3, 5), interval=st.floats(1e-5, 0.2))
def test_taxi_is_the_fewest_whole_intervals(speed: float, acceleration: float, interval: float) -> None:
    taxi = taxi_angle(speed, acceleration, interval)
    ramp = speed**2 / (2 * acceleration)
    assert taxi / interval == pytest.approx(round(taxi / interval))
    assert taxi >= (ramp + interval / 2) * (1 - 1e-9)
    assert taxi - interval < (ramp + interval / 2) * (1 + 1e-9)


@given(
    period=st.floats(0.001, 2),
    exposure=st.floats(0.0005, 0.5),
    views=st.integers(2, 720),
    start=st.floats(-20, 200),
    free=st.integers(0, 10**8),
)
def test_no_violation_means_that_nothing_is_broken(
    period: float, exposure: float, views: int, start: float, free: int
) -> None:
    """Each limit checked again from the blocks; a violation is there exactly where one of them is broken."""
    camera = replace(CAMERA, min_period=exposure + 0.001)
    plan = replace(PLAN, angles=angles.fixed(views, start * DEG), period=period, exposure=exposure)
    timeline = worked(plan, camera=camera, free_bytes=free)
    block = timeline.blocks[2]
    first, last = block.angles[0], block.angles[-1]
    half_count = math.pi / 360_000
    broken = [
        exposure > block.period,
        block.period < camera.min_period,
        timeline.step_counts / period < 0.5,
        block.speed > STAGE.max_speed,
        first - block.taxi < STAGE.low - half_count or last + block.taxi > STAGE.high + half_count,
        timeline.total_bytes * 1.1 > free,
    ]
    assert len(timeline.violations) == sum(broken)


VIOLATIONS = {
    "period below the camera's": ({"period": 0.0505}, "period_s 0.0505 is below the camera's minimum of 0.051 s"),
    "exposure over period": ({"exposure": 0.2}, "scan.exposure_s 0.2 is longer than scan.period_s 0.1"),
    "speed": (
        {"angles": angles.fixed(40, 90 * DEG)},
        "needs 45°/s, but the stage turns at most 30°/s; set scan.period_s >= 0.15",
    ),
    "start": ({"angles": angles.fixed(360, -5 * DEG)}, "go from -5.5° to 175° (with 0.5° of run-up at each end)"),
    "end": ({"angles": angles.fixed(360, 186 * DEG)}, "limits are -5° ... 365°"),
    "slow": ({"period": 2000.0}, "less than one count per second; set scan.period_s <= 500"),
    "step beyond": ({"angles": np.array([0.0, 7.0]), "mode": Mode.STEP}, "go from 0° to 401.07°, but its limits"),
    "unequal": ({"angles": angles.golden(100)}, "not equally spaced"),
    "one view": ({"angles": np.zeros(1)}, "at least 2 projections"),
    "no flats": ({"flats": FieldPlan(0, Place.START, 0.05)}, "no flats: scan.flats.count is 0"),
    "no darks": ({"darks": FieldPlan(0, Place.BOTH, 0.05)}, "no darks: scan.darks.count is 0"),
    "passes": (
        {"mode": Mode.STEP, "pass_views": 3},
        "scan.pass_views 3 divides 360 projections into more than 100 passes; set scan.pass_views to at least 4",
    ),
}


@pytest.mark.parametrize(("changes", "sentence"), VIOLATIONS.values(), ids=VIOLATIONS.keys())
def test_violations_have_values_and_advice(changes: dict[str, Any], sentence: str) -> None:
    timeline = worked(replace(PLAN, **changes))
    (violation,) = timeline.violations
    assert sentence in violation
    assert ";" in violation or ". " in violation  # what to do follows
    assert re.search(
        r"\b(scan|devices|optics|storage)\.\w+", violation
    )  # by the first key, the plan of a queue finds the line
    # Broken plans are still worked out, so that the operator sees all of it at once.
    assert timeline.n_frames > 0
    assert timeline.duration > 0


def test_advice_works_when_followed() -> None:
    for changes in ({"period": 0.0505}, {"angles": angles.fixed(40, 90 * DEG)}):
        (violation,) = worked(replace(PLAN, **changes)).violations
        period = float(re.search(r"scan\.period_s >= ([\d.]+)", violation)[1])  # type: ignore[index]
        assert worked(replace(PLAN, **changes | {"period": period})).violations == ()


@pytest.mark.parametrize("start", [-5.0, 186.0])
def test_a_start_within_the_limits_works_when_followed(start: float) -> None:
    (violation,) = worked(replace(PLAN, angles=angles.fixed(360, start * DEG))).violations
    advised = float(re.search(r"begin at (\S+) degrees", violation)[1])  # type: ignore[index]
    assert worked(replace(PLAN, angles=angles.fixed(360, advised * DEG))).violations == ()
    assert abs(advised - start) < 2


def test_a_period_with_less_taxi_works_when_followed() -> None:
    """Where no start is left: the range between the limits is 190 degrees, of which the views take 180."""
    slow = replace(STAGE, low=-5 * DEG, high=185 * DEG, acceleration=20 * DEG)
    plan = replace(PLAN, angles=angles.fixed(180, 0.0), period=0.05, exposure=0.01)
    camera = replace(CAMERA, min_period=0.02)
    (violation,) = worked(plan, slow, camera).violations
    assert "begin at" not in violation
    period = float(re.search(r"scan\.period_s >= ([\d.]+)", violation)[1])  # type: ignore[index]
    assert worked(replace(plan, period=period), slow, camera).violations == () and period < 0.2


@given(
    views=st.integers(2, 5000),
    passes=st.sampled_from([1, 2, 3]),
    spacing=st.floats(1e-6, 0.1),
    unit=st.sampled_from([1, 2]),
)
def test_a_plan_is_refused_where_its_pulses_would_run_together(
    views: int, passes: int, spacing: float, unit: int
) -> None:
    """A turn has 360 000 counts and takes 12 s at full speed: from the time between two pulses then. A least interval
    that is all but whole is left out."""
    assume(abs(spacing * 30_000 - round(spacing * 30_000)) > 1e-3)
    views = max(2, views // passes) * passes
    plan = replace(PLAN, angles=angles.interlaced(views, passes, 0.0, math.pi), period=40.0)
    stage = replace(STAGE, pulse_spacing=spacing, interval_unit=unit)
    timeline = worked(plan, stage)
    close, uneven = timeline.step_counts / 30_000 < spacing, timeline.step_counts % unit > 0
    assert any("trigger output" in sentence for sentence in timeline.violations) == (close or uneven)
    taken = replace(timeline.views.trains[0], start=0)
    try:  # a stage with room for the train takes it where the plan breaks nothing, and only there
        Travel("stage", replace(stage, high=9.0)).refuse_train(taken)
    except DeviceRefused:
        assert close or uneven
    else:
        assert not (close or uneven)


def test_no_trigger_output_and_no_room() -> None:
    (violation,) = worked(stage=replace(STAGE, trigger_output=False)).violations
    assert "a stage with a trigger output" in violation
    # 410 frames of 144 x 252 px, 2 bytes a pixel and 4 a block of 4 x 4 pixels, or for each pixel.
    (violation,) = worked(free_bytes=56_000_000).violations
    assert (
        "needs 33.5 MB plus a reserve of a tenth, and 20 MB more when the file is closed, but 56 MB is free"
        in violation
    )
    assert worked(free_bytes=57_000_000).violations == ()
    (violation,) = worked(free_bytes=110_000_000, preview_bin=1).violations
    assert "needs 89.3 MB plus a reserve of a tenth" in violation


@pytest.mark.parametrize(("axis_col", "legal"), [(-0.5, True), (-0.6, False), (251.5, True), (251.6, False)])
def test_an_axis_outside_the_frame_is_refused(axis_col: float, legal: bool) -> None:
    violations = worked(axis_col=axis_col).violations
    assert (violations == ()) is legal
    assert legal or "is outside the columns of the frame, 0 ... 251" in violations[0]


REMARKS = {
    "rounding": (
        {"angles": angles.fixed(181), "period": 0.2},
        "the step of 0.994475° is 994.475 counts; the stage can trigger only on whole counts, so the step becomes "
        "994 counts = 0.994°, "
        "and the angles of projections change by up to 0.0855",
    ),
    "whole counts a second": (
        {"angles": angles.fixed(36_000), "period": 0.6},
        "period_s becomes 0.625 instead of 0.6, because the stage can turn at 8 counts/s, but not at 8.33333 counts/s",
    ),
    "margin": ({"period": 0.0512}, "less than 1 % above the camera's minimum of 0.051 s"),
    "few views": (
        {"angles": angles.fixed(180)},
        "the scan has 180 projections; expected at least 396 (pi/2 x 252 columns)",
    ),
    "no flats": ({"flats": FieldPlan(0, Place.NONE, 0.05)}, "no flats will be taken"),
    "no darks": ({"darks": FieldPlan(5, Place.NONE, 0.05)}, "no darks will be taken"),
    "exposure": (
        {"flats": FieldPlan(5, Place.END, 0.1)},
        "flats are exposed for 0.1 s and projections for 0.05 s; the intensity of the flats",
    ),
    "darks' exposure": (
        {"darks": FieldPlan(5, Place.END, 0.1)},
        "darks are exposed for 0.1 s and projections for 0.05 s; these darks have other hot pixels",
    ),
    "blur": ({"exposure": 0.09, "angles": angles.fixed(360, 0, 2 * math.pi)}, "motion blur is 1.98 px"),
}


@pytest.mark.parametrize(("changes", "sentence"), REMARKS.values(), ids=REMARKS.keys())
def test_remarks_break_nothing(changes: dict[str, Any], sentence: str) -> None:
    timeline = worked(replace(PLAN, **changes), camera=replace(CAMERA, min_period=0.051))
    assert timeline.violations == ()
    assert any(sentence in remark for remark in timeline.remarks), timeline.remarks


def test_skew_is_remarked_and_a_quiet_plan_has_no_remark() -> None:
    slow = replace(CAMERA, row_period=86.4e-6, shape=(2304, 252))
    assert any("rolling shutter skews" in remark for remark in worked(camera=slow).remarks)
    assert worked(replace(PLAN, angles=angles.fixed(400))).remarks == ()
