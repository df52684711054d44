"""Conformance tests of trigger trains: a train gives each of its pulses once, at its angle, until it is disarmed,
replaced or complete.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext

import pytest

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED, Build, StageBench, StageKind

Step = float | tuple[float, float, int] | None
"""A step of a test: a move to an angle, a train to arm (first, step, n), or None: disarm; in degrees."""
SCRIPTS: Mapping[str, tuple[Sequence[Step], Sequence[int]]] = {
    "a train ends with its last pulse": ([(1.0, 1.0, 3), 30.0], [3]),
    "it fires once": ([(1.0, 1.0, 3), 5.0, 0.0, 5.0], [3]),
    "one after another": ([(1.0, 1.0, 3), 5.0, (4.5, -1.0, 4), 0.0], [3, 4]),
    "no pulse without a train": ([None, None, 10.0], []),
    "disarmed before it begins": ([(1.0, 1.0, 3), None, 10.0], [0]),
    "disarmed in the middle": ([(1.0, 1.0, 9), 3.5, None, 7.5, 0.0, 20.0, (21.0, 1.0, 4), 30.0], [3, 4]),
    "replaced before it begins": ([(1.0, 1.0, 9), (2.0, 3.0, 2), 20.0], [0, 2]),
    "replaced in the middle": ([(1.0, 1.0, 9), 3.5, (2.0, -1.0, 2), 0.0, 20.0], [3, 2]),
    "halts in the middle": ([-4.5, (-3.0, 0.5, 20), -1.75, 0.1, 7.0], [20]),
    "halts in the middle, backwards": ([10.0, (8.0, -0.5, 20), 6.75, 4.9, -2.0], [20]),
    "turned back far before it begins": ([(2.0, 1.0, 5), -2.0, -4.0, 20.0], [5]),
    "turned back before it begins": ([(2.0, 1.0, 5), 0.5, -4.0, 20.0], [5]),
    "turned back within a step before it begins": ([(2.0, 1.0, 5), 1.5, -4.0, 20.0], [5]),
    "turned back just before it begins": ([(2.0, 1.0, 5), 1.9, -4.0, 20.0], [5]),
}
"""For each name, the steps of a test and the number of pulses of each train."""


class Trains:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

    @pytest.mark.parametrize(("first", "step", "n"), [(2.0, 0.5, 37), (-1.0, -0.25, 9), (1.0, 0.1, 1), (-1.0, -0.1, 1)])
    def test_a_train_gives_exactly_its_pulses_at_its_angles(
        self, bench: StageBench, first: float, step: float, n: int
    ) -> None:
        train = bench.train(first, step, n)
        bench.stage.arm(train)
        bench.clock.sleep(1.0)
        assert bench.pulses() == []
        bench.go(first + n * step + math.copysign(1.0, step))
        assert bench.pulse_counts() == [train.start + k * train.interval for k in range(n)]
        for k, pulse in enumerate(bench.pulses()):
            expected_angle = bench.stage.to_angle(train.start + k * train.interval)
            assert pulse.angle == pytest.approx(expected_angle, abs=math.radians(bench.count))
            assert bench.line.angle_at(pulse.time) == pytest.approx(expected_angle, abs=math.radians(bench.count))

    @pytest.mark.parametrize("sign", [1, -1])
    def test_a_single_pulse_may_have_any_interval(self, bench: StageBench, sign: int) -> None:
        bench.stage.arm(TriggerTrain(sign * 100, sign, 1))
        bench.go(sign * 3.0)
        assert bench.pulse_counts() == [sign * 100]

    def test_at_constant_speed_pulses_are_equally_spaced_in_time(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(5.0, 0.5, 21))
        bench.go(20.0)
        times = [pulse.time for pulse in bench.pulses()]
        periods = [later - earlier for earlier, later in itertools.pairwise(times)]
        assert periods == pytest.approx([0.05] * 20, rel=1e-3)

    @pytest.mark.parametrize(("steps", "pulse_counts"), SCRIPTS.values(), ids=SCRIPTS)
    def test_every_train_gives_its_pulses_until_it_is_over(
        self, bench: StageBench, steps: Sequence[Step], pulse_counts: Sequence[int]
    ) -> None:
        trains = []
        for step in steps:
            if step is None:
                bench.stage.disarm()
            elif isinstance(step, tuple):
                trains.append(bench.train(*step))
                bench.stage.arm(trains[-1])
            else:
                bench.go(step)
        expected = [
            train.start + train.interval * k for train, n in zip(trains, pulse_counts, strict=True) for k in range(n)
        ]
        assert bench.pulse_counts() == expected

    def test_a_train_under_which_the_stage_is_stopped_goes_on_with_the_next_move(self, bench: StageBench) -> None:
        train = bench.train(1.0, 1.0, 30)
        bench.stage.arm(train)
        bench.stage.start_move(math.radians(40), SPEED)
        bench.clock.sleep(1.6)
        bench.stage.stop()
        before = len(bench.pulses())
        assert 10 < before < 20
        bench.go(40.0)
        assert bench.pulse_counts() == [train.start + train.interval * k for k in range(30)]

    @pytest.mark.parametrize("stopped", [False, True], ids=["at the end of a move", "after a stop"])
    def test_turning_back_inside_a_train_gives_no_pulse_and_ends_it_where_it_cannot_go_on(
        self, kind: StageKind, bench: StageBench, stopped: bool
    ) -> None:
        train = bench.train(1.0, 1.0, 30)
        bench.stage.arm(train)
        if stopped:
            bench.stage.start_move(math.radians(40), SPEED)
            bench.clock.sleep(1.1)
            bench.stage.stop()
        else:
            bench.go(10.5)
        before = len(bench.pulses())
        assert before == 10 or (stopped and 5 < before < 15)
        bench.go(2.0)
        assert len(bench.pulses()) == before
        bench.go(40.0)
        assert bench.pulse_counts() == [
            train.start + train.interval * k for k in range(before if kind.turning_back_ends else 30)
        ]

    def test_disarming_on_the_way_ends_the_pulses_or_is_refused_and_lets_it_move(
        self, kind: StageKind, bench: StageBench
    ) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 30))
        bench.stage.start_move(math.radians(40), SPEED)
        bench.clock.sleep(1.6)
        with (
            nullcontext()
            if kind.disarms_moving
            else pytest.raises(DeviceRefused, match="disarming is not possible while it moves")
        ):
            bench.stage.disarm()
        before = len(bench.pulses())
        assert 10 < before < 20
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(40.0, abs=bench.count)
        assert len(bench.pulses()) == (before if kind.disarms_moving else 30)

    @pytest.mark.parametrize("sign", [1, -1])
    def test_at_a_speed_that_is_low_enough_pulses_come_at_each_of_the_smallest_intervals(
        self, build: Build, sign: int
    ) -> None:
        """The smallest interval is one count if pulses have a width, and two counts if fires toggle the output."""
        bench = build(max_speed=math.radians(0.2))
        interval = 1
        try:
            bench.stage.arm(TriggerTrain(sign * 20, sign, 50))
        except DeviceRefused as refusal:
            assert "even number" in str(refusal)
            interval = 2
            bench.stage.arm(TriggerTrain(sign * 20, sign * 2, 50))
        bench.stage.start_move(bench.stage.to_angle(sign * 200), math.radians(0.2))
        bench.stage.wait(LONG)
        assert bench.pulse_counts() == [sign * (20 + interval * k) for k in range(50)]
        bench.stage.close()

    @pytest.mark.parametrize(("first", "step"), [(2.0, 0.5), (3.0, 0.5), (3.0, -0.5), (4.0, -0.5)])
    def test_arming_at_or_past_the_first_pulse_is_refused(self, bench: StageBench, first: float, step: float) -> None:
        bench.go(3.0)
        with pytest.raises(DeviceRefused, match="at or past the first pulse"):
            bench.stage.arm(bench.train(first, step, 3))
        bench.go(0.0)
        bench.go(10.0)
        assert bench.pulses() == []

    @pytest.mark.parametrize(
        ("first", "step", "n"), [(99.0, 1.0, 3), (-6.0, 1.0, 3), (1.0, 1.0, 0), (1.0, 0.0, 5), (-1.0, -1.0, 6)]
    )
    def test_a_train_that_cannot_be_emitted_is_refused(
        self, bench: StageBench, first: float, step: float, n: int
    ) -> None:
        with pytest.raises(DeviceRefused, match="cannot be emitted"):
            bench.stage.arm(bench.train(first, step, n))
        bench.go(5.0)
        assert bench.pulses() == []

    def test_arming_while_it_moves_is_refused_and_the_move_goes_on(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(5), SPEED)
        with pytest.raises(DeviceRefused, match="moves"):
            bench.stage.arm(bench.train(8.0, 1.0, 3))
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(5.0, abs=bench.count)

    def test_a_pulse_width_is_kept_or_refused_and_trains_that_would_run_together_are_refused(
        self, kind: StageKind, build: Build
    ) -> None:
        with pytest.raises((DeviceRefused, ValueError)):
            build(pulse_width=kind.no_width)
        if kind.width is None:  # the width is fixed, as the error shows
            return
        bench = build(pulse_width=kind.width)
        described = bench.stage.describe()["pulse_width_s"]
        assert described == pytest.approx(kind.width)
        per_count = 2 * math.pi / bench.stage.limits.counts_per_turn / bench.stage.limits.max_speed
        touching, apart = math.floor(kind.width / per_count), math.ceil(2.5 * kind.width / per_count)
        if touching > 0:
            with pytest.raises(DeviceRefused, match="cannot be emitted"):
                bench.stage.arm(TriggerTrain(bench.counts(2.0), touching, 5))
        bench.stage.arm(TriggerTrain(bench.counts(2.0), apart, 50))
        bench.stage.start_move(math.radians(90), bench.stage.limits.max_speed)
        bench.stage.wait(LONG)
        assert bench.pulse_counts() == [bench.counts(2.0) + k * apart for k in range(50)]
        bench.stage.close()

    def test_inverted_pulses_are_as_many_and_at_the_same_angles_or_refused(self, kind: StageKind, build: Build) -> None:
        if not kind.inverts:
            with pytest.raises((DeviceRefused, ValueError)):
                build(active_high=False)
            return
        bench = build(active_high=False)
        bench.stage.arm(bench.train(1.0, 0.5, 10))
        bench.go(10.0)
        assert bench.pulse_counts() == [bench.counts(1.0) + k * bench.counts(0.5) for k in range(10)]
        bench.stage.close()


class NoTrains:
    """The test for a stage without a trigger output."""

    def test_a_train_is_refused_and_the_stage_moves_all_the_same(self, bench: StageBench) -> None:
        with pytest.raises(DeviceRefused, match="Nothing has moved"):
            bench.stage.arm(bench.train(1.0, 1.0, 3))
        bench.stage.disarm()
        assert bench.go(5.0) == pytest.approx(5.0, abs=bench.count)
        assert bench.pulses() == []
