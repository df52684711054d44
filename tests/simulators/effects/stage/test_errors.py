"""Errors of the stage: encoder, backlash, wobble, runout, slips."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from simulators.devices.clock import VirtualClock
from simulators.devices.motion import TrapezoidMove
from simulators.devices.motor import PulseMotor
from simulators.effects.chain import AnomalyLabel, PoseEffect
from simulators.effects.stage.errors import EncoderError, Jump, Runout, StageWobble, came_forwards, series
from simulators.frame.shot import Detector, Pose, Shot
from tests.simulators import shots


def seen(pose: Pose, point: ArrayLike) -> NDArray[np.float64]:
    """(u, b, v) in mm of a point of the sample in each row, [row, 3]."""
    axes, origin = pose.frames()
    return np.einsum("rij,ri->rj", axes, np.asarray(point, dtype=np.float64) - origin)


def posed(effect: PoseEffect, angle: float | NDArray[np.float64], rows: int = 3, **changes: Any) -> Pose:
    """The pose that an effect makes of a sample that is turned by `angle` radians; `changes` are the shot's."""
    return effect.pose(Pose.turned(angle, rows), np.zeros(rows), shots.shot(**changes))


ANGLES = np.linspace(-4.0, 9.0, 27)


@given(st.lists(st.tuples(st.integers(-9, 9), st.floats(0, 50), st.floats(-180, 180)), unique_by=lambda h: h[0]))
def test_a_series_is_its_waves_one_by_one_and_comes_back_every_turn(harmonics: list[tuple[int, float, float]]) -> None:
    total = series(ANGLES, harmonics)
    cosines = sum((a * np.cos(k * ANGLES + np.deg2rad(p)) for k, a, p in harmonics), np.zeros(27))
    sines = sum((a * np.sin(k * ANGLES + np.deg2rad(p)) for k, a, p in harmonics), np.zeros(27))
    np.testing.assert_allclose(total.real, cosines, atol=1e-9)
    np.testing.assert_allclose(total.imag, sines, atol=1e-9)
    np.testing.assert_allclose(series(ANGLES + 2 * np.pi, harmonics), total, atol=1e-9)


def test_the_sample_stands_at_the_angle_of_its_waves() -> None:
    angles = np.linspace(-1.0, 6.0, 11)
    turned = posed(EncoderError(((1, 8.0, 30.0), (180, 2.0, 0.0))), angles, rows=11).angle
    error = 8.0 * np.cos(angles + math.radians(30.0)) + 2.0 * np.cos(180 * angles)
    np.testing.assert_allclose(1e3 * np.degrees(turned - angles), error, atol=1e-9)


def test_a_frame_equals_the_frame_at_the_true_angle() -> None:
    scene = shots.scene({"kind": "encoder_error", "harmonics": [[2, 500.0, 0.0]]})
    angle = 0.4 + math.radians(0.5 * math.cos(0.8))
    np.testing.assert_array_equal(shots.frame(scene), shots.frame(shots.scene(), shots.shot(angle=angle)))
    assert (shots.frame(scene) != shots.frame(shots.scene())).any()


@pytest.mark.parametrize(
    ("effect", "of", "spreads"),
    [
        (EncoderError((), 3.0), lambda pose: 1e3 * np.degrees(pose.angle - 0.3)[:, None], [3.0]),
        (StageWobble(random_urad=7.0), lambda pose: 1e6 * pose.tilt, [7.0, 7.0]),
        (Runout(radial_random_um=2.0, axial_random_um=0.5), lambda pose: 1e3 * pose.shift, [2.0, 2.0, 0.5]),
    ],
    ids=["encoder", "wobble", "runout"],
)
def test_the_rest_is_drawn_for_each_frame_and_the_same_at_every_moment_of_it(
    effect: PoseEffect, of: Callable[[Pose], Any], spreads: list[float]
) -> None:
    drawn = np.array([of(posed(effect, 0.3, frame=k)) for k in range(500)])
    assert (drawn == drawn[:, :1]).all()
    # Mean and variance of 500 Gaussian draws; 5 standard errors fail once in 1.7 million.
    np.testing.assert_allclose(drawn[:, 0].mean(axis=0) / spreads, 0, atol=5 / math.sqrt(500))
    np.testing.assert_allclose(drawn[:, 0].var(axis=0), np.square(spreads), rtol=5 * math.sqrt(2 / 500))
    others = np.corrcoef(drawn[:, 0].T).reshape(len(spreads), -1) - np.eye(len(spreads))
    assert np.abs(others).max() < 5 / math.sqrt(500)


class TrapezoidStage:
    """Moves from angle to angle (radians) and stands `wait` s after each move."""

    def __init__(self, *angles: float, wait: float) -> None:
        self.moves: list[TrapezoidMove] = []
        self.end = 1000.0
        for here, there in pairwise(angles):
            self.moves.append(TrapezoidMove.between(here, there, 0.5, 1.0, begin=self.end))
            self.end = self.moves[-1].end + wait

    def __call__(self, time: float) -> float:
        begun = [move for move in self.moves if move.begin <= time] or self.moves[:1]
        return begun[-1].position(time)


def test_backwards_the_sample_stands_further_than_the_stage() -> None:
    scene = shots.scene({"kind": "backlash", "lost_motion_deg": 0.5})
    lagging = shots.frame(shots.scene(), shots.shot(angle=0.4 + math.radians(0.5)))

    def turned(speed: float, time: NDArray[np.float64] | float) -> Any:
        return 0.4 + speed * (time - 1000.0)

    for speed, expected in ((0.2, shots.frame(shots.scene())), (-0.2, lagging)):
        seen = shots.frame(scene, angle_at=partial(turned, speed))
        np.testing.assert_array_equal(seen, expected)


@given(
    turn=st.floats(0.002, 3.0).flatmap(lambda size: st.sampled_from((size, -size))),
    before=st.floats(-1.0, 1.0),
    wait=st.floats(0.01, 100.0),
)
def test_a_standing_stage_lags_by_its_last_move(turn: float, before: float, wait: float) -> None:
    """Whatever it did before, and however long it has stood."""
    stage = TrapezoidStage(0.0, before, before + turn, wait=wait)
    assert came_forwards(stage, stage.end) is (turn > 0)


def test_going_beyond_and_back_to_the_target_is_a_move_backwards() -> None:
    stage = TrapezoidStage(0.0, 1.05, 1.0, wait=0.1)
    now = stage.end + 3.0
    assert stage(now - 2.048) == stage(now) > stage(now - 4.096)  # two looks: it stood, and it came from below
    assert not came_forwards(stage, now)


def test_a_stage_that_never_moved_came_forwards() -> None:
    assert came_forwards(lambda time: 0.4, 1000.0)


def test_a_stage_that_goes_by_counts_is_understood() -> None:
    """The simulated motor's own memory, at the size of times of day."""
    clock = VirtualClock()
    motor = PulseMotor(clock, lambda: None, counts_per_turn=360_000)
    for target in (5000, 2000):
        motor.start(target, 10_000.0, 50_000.0)
        clock.sleep(motor.move.end - clock.now() + 5.0)
        assert came_forwards(motor.angle_at, clock.now()) is (target == 5000)


POINT = (0.2, -0.1, 0.3)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, -1.9])
def test_one_wave_a_turn_is_a_sample_that_stands_askew(angle: float) -> None:
    """An askew sample, turned by ε about its own axis at angle -φ in the xy-plane, is rigid: p + ε axis x p (ε² is
    left out)."""
    tilt, phase = 1e-4, 30.0
    own_axis = np.array([math.cos(math.radians(phase)), -math.sin(math.radians(phase)), 0.0])
    askew = np.array(POINT) + tilt * np.cross(own_axis, POINT)
    wobbling = posed(StageWobble(((1, 1e6 * tilt, phase),)), angle)
    turned = [
        askew[0] * math.cos(angle) + askew[1] * math.sin(angle),
        askew[1] * math.cos(angle) - askew[0] * math.sin(angle),
        askew[2],
    ]
    np.testing.assert_allclose(seen(wobbling, POINT)[0], turned, atol=2 * tilt**2)


def test_no_wave_is_an_axis_that_leans_always_to_the_same_side() -> None:
    high = (0.0, 0.0, 0.4)  # on the axis: it stays where it is, whatever the angle
    about_u = seen(posed(StageWobble(((0, 1000.0, 0.0),)), np.array([0.0, 1.0, 2.0])), high)
    np.testing.assert_allclose(about_u, [[0.0, -0.4e-3, 0.4]] * 3, atol=1e-6)
    about_b = seen(posed(StageWobble(((0, 1000.0, -90.0),)), np.array([0.0, 1.0, 2.0])), high)
    np.testing.assert_allclose(about_b, [[0.4e-3, 0.0, 0.4]] * 3, atol=1e-6)


RUNOUT_ANGLES = np.linspace(-2.0, 5.0, 9)


def test_one_wave_a_turn_is_a_sample_that_stands_beside_the_axis() -> None:
    """At phase φ it stands at (cos φ, -sin φ) beside it: exactly, at every angle."""
    wandering = seen(posed(Runout(radial=((1, 12.0, 25.0),)), RUNOUT_ANGLES, rows=9), POINT)
    beside = np.array(POINT) + 0.012 * np.array([math.cos(math.radians(25.0)), -math.sin(math.radians(25.0)), 0.0])
    np.testing.assert_allclose(wandering, seen(Pose.turned(RUNOUT_ANGLES, 9), beside), atol=1e-14)


def test_zero_waves_shift_the_axis_and_others_are_cosines() -> None:
    there, here = (
        seen(
            posed(Runout(((0, 3.0, 0.0), (3, 2.0, 10.0)), ((2, 5.0, -40.0),)), RUNOUT_ANGLES, rows=9), np.array(POINT)
        ),
        seen(Pose.turned(RUNOUT_ANGLES, 9), POINT),
    )
    at = 3 * RUNOUT_ANGLES + math.radians(10.0)
    across, along = 3.0 + 2.0 * np.cos(at), -2.0 * np.sin(at)
    up = 5.0 * np.cos(2 * RUNOUT_ANGLES - math.radians(40.0))
    np.testing.assert_allclose(1e3 * (there - here), np.stack([across, along, up], axis=1), atol=1e-10)


def test_a_frame_is_seen_shifted_by_whole_pixels() -> None:
    plain = shots.frame(shots.scene())
    moved = shots.frame(shots.scene({"kind": "runout", "radial": [[0, 20.0, 0.0]], "axial": [[0, 30.0, 0.0]]}))
    np.testing.assert_array_equal(moved[3:, 2:], plain[:-3, :-2])  # 20 and 30 um, pixels of 10 um
    assert (moved != plain).any()


JUMP = {"kind": "jump", "view": 3, "shift_um": [30.0, -20.0, 40.0], "turn_deg": 5.0}


def _pair(shot: Shot) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    return shots.frame(shots.scene(JUMP), shot), shots.frame(shots.scene(), shot)


def test_a_point_is_turned_then_shifted_on_the_stage() -> None:
    point = np.array([0.2, -0.1, 0.3])
    turn, angle = math.radians(5.0), 0.7
    # Angles grow: where the stage is at θ + δ a point is seen as it is seen at θ when it is turned by -δ about z.
    c, s = math.cos(turn), math.sin(turn)
    x, y, z = point[0] * c + point[1] * s + 0.03, point[1] * c - point[0] * s - 0.02, point[2] + 0.04
    expected = [x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle), z]
    jump = Jump(3, (30.0, -20.0, 40.0), 5.0)
    np.testing.assert_allclose(seen(posed(jump, angle, view=3), point), [expected] * 3, atol=1e-14)
    np.testing.assert_allclose(seen(posed(jump, angle, view=2), point)[0, 2], 0.3)


def test_views_before_it_are_untouched_and_all_after_it_are_labelled() -> None:
    chain = shots.scene(JUMP).chain
    for view in range(6):
        shot = shots.shot(view=view)
        jumped, plain = _pair(shot)
        assert (jumped != plain).any() == (view >= 3) == bool(chain.labels(shot))
    for state in ({"sample": False}, {"beam": False}):
        assert not chain.labels(shots.shot(view=4, **state))


@pytest.mark.parametrize("axis_col", [39.5, 60.0, -20.0, 105.0])
def test_the_region_holds_all_that_changes_and_is_no_wider_than_the_sample_and_its_way(axis_col: float) -> None:
    shot = shots.shot(view=3, detector=Detector((60, 80), 0.01, axis_col, 29.5))
    jumped, plain = _pair(shot)
    changed = np.flatnonzero((jumped != plain).any(axis=0))
    (label,) = shots.scene(JUMP).chain.labels(shot)
    top, below, left, right = label.region
    assert (label.kind, top, below) == ("jump", 0, 60)
    assert left <= changed.min() <= changed.max() < right
    # The sample fills its radius of 30 px; the shift of 3.6 px may go to either side.
    assert changed.min() - left <= 8
    assert right - 1 - changed.max() <= 8


def test_a_slip_along_the_beam_shows_in_a_cone_only() -> None:
    jump = Jump(0, (0.0, 50.0, 0.0))
    assert not jump.labels(shots.shot(angle=0.0))
    assert jump.labels(shots.shot(angle=0.1))
    cone = Detector.centred((60, 80), 0.01, sod=2.0)
    # A point at 0.35 mm from the axis is seen up to 0.35 / (1 - 0.35 / 2) = 0.4242 mm from it.
    assert Jump(0, (0.0, 50.0, 0.0)).labels(shots.shot(angle=0.0, detector=cone)) == [
        AnomalyLabel("jump", (0, 60, 0, 80))
    ]
    narrow = Detector.centred((60, 120), 0.01, sod=2.0)
    assert jump.labels(shots.shot(angle=0.0, detector=narrow)) == [AnomalyLabel("jump", (0, 60, 18, 102))]
