"""What every rotation stage must do, real driver over a simulated wire or simulator: subclass it and give a `build`.

All angles are asked for in whole counts, so that every stage can reach them exactly. Nothing here knows the protocol.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.motion import start_move_by
from drivers.protocols import RotationStage, TriggerTrain
from simulators.trigger_line import Pulse, TriggerLine

SPEED = math.radians(10)
LONG = 60.0


@dataclass
class StageBench:
    """A stage at angle 0 that can go from -5 to 100 degrees at 10 degrees/s or faster, and its trigger cable."""

    stage: RotationStage
    clock: Clock
    line: TriggerLine

    def pulses(self) -> list[Pulse]:
        """Those that have been emitted by now."""
        found: list[Pulse] = []
        after = -math.inf
        while (pulse := self.line.next_after(after)) is not None and pulse.time <= self.clock.now():
            found.append(pulse)
            after = pulse.time
        return found

    def go(self, degrees: float) -> float:
        """Move and wait; where it stands, in degrees."""
        self.stage.start_move(math.radians(degrees), SPEED)
        return math.degrees(self.stage.wait(LONG))

    def counts(self, degrees: float) -> int:
        return self.stage.to_counts(math.radians(degrees))

    def train(self, first: float, step: float, n: int) -> TriggerTrain:
        """A train in degrees."""
        return TriggerTrain(self.counts(first), self.counts(step), n)

    @property
    def count(self) -> float:
        """One count in degrees."""
        return 360.0 / self.stage.limits.counts_per_turn


Build = Callable[..., StageBench]


class StageConformance:
    """The shared suite. A subclass has a fixture `build` that gives a function: called with settings of the stage's
    constructor that differ from the usual ones it opens the stage, on a fresh wire, and returns its bench.

    Attributes:
        WIDTH: a pulse width (s) that the output has, at most 1 ms; None where it has no choice.
        NO_WIDTH: one that it has not, or has not beside others.
        INVERTS: its pulses may be active low.
        HOMES: the stage of the bench has a reference, within its limits.
        STOPS_ARE_TOLD: `status` tells that the last move was stopped.
        RELATIVE_MOVES: how many of them make the long way; fewer where bytes cost time and the law is tested elsewhere.
    """

    WIDTH: float | None = 100e-6
    NO_WIDTH: float = 0.0
    INVERTS = False
    HOMES = True
    STOPS_ARE_TOLD = True
    RELATIVE_MOVES = 1000

    @pytest.fixture
    def build(self) -> Build:
        raise NotImplementedError("the subclass gives the benches")

    @pytest.fixture
    def bench(self, build: Build) -> Iterator[StageBench]:
        bench = build()
        yield bench
        bench.stage.close()

    # identity

    def test_it_says_who_it_is(self, bench: StageBench) -> None:
        assert bench.stage.name
        described = bench.stage.describe()
        assert described["model"]
        assert described["counts_per_turn"] == bench.stage.limits.counts_per_turn
        assert all(isinstance(value, str | int | float) for value in described.values())

    def test_its_limits_make_sense(self, bench: StageBench) -> None:
        limits = bench.stage.limits
        assert limits.counts_per_turn > 0
        assert limits.max_speed > 0
        assert limits.acceleration > 0
        assert limits.low < limits.high
        assert limits.trigger_output

    def test_counts_and_angles_are_inverse_and_nearest(self, bench: StageBench) -> None:
        stage = bench.stage
        for counts in (-7, 0, 1, 999, 12_345):
            assert stage.to_counts(stage.to_angle(counts)) == counts
            assert stage.to_counts(stage.to_angle(counts) + 0.4 * math.radians(bench.count)) == counts
        assert stage.to_counts(2 * math.pi) == stage.limits.counts_per_turn

    # moves

    def test_it_stands_where_it_says(self, bench: StageBench) -> None:
        assert not bench.stage.moving()
        assert bench.stage.position() == pytest.approx(0.0, abs=math.radians(bench.count))
        assert bench.stage.wait(1.0) == pytest.approx(bench.stage.position())

    @pytest.mark.parametrize("degrees", [20.0, -4.0, 0.01])
    def test_a_move_arrives_within_a_count(self, bench: StageBench, degrees: float) -> None:
        assert bench.go(degrees) == pytest.approx(degrees, abs=bench.count)
        assert math.degrees(bench.stage.position()) == pytest.approx(degrees, abs=bench.count)
        assert math.degrees(bench.line.angle_at(bench.clock.now())) == pytest.approx(degrees, abs=bench.count)
        assert not bench.stage.moving()

    def test_a_move_starts_at_once_and_takes_distance_over_speed_plus_speed_over_acceleration(
        self, bench: StageBench
    ) -> None:
        before = bench.clock.now()
        bench.stage.start_move(math.radians(30), SPEED)
        assert bench.clock.now() - before < 0.5
        assert bench.stage.moving()
        bench.stage.wait(LONG)
        expected = math.radians(30) / SPEED + SPEED / bench.stage.limits.acceleration
        assert bench.clock.now() - before == pytest.approx(expected, abs=0.2)

    def test_it_comes_back(self, bench: StageBench) -> None:
        bench.go(15.0)
        assert bench.go(-3.0) == pytest.approx(-3.0, abs=bench.count)

    def test_a_move_to_where_it_stands_is_over_at_once(self, bench: StageBench) -> None:
        bench.go(3.0)
        assert bench.go(3.0) == pytest.approx(3.0, abs=bench.count)

    @pytest.mark.parametrize("degrees", [-5.1, 100.1, 4000.0, math.nan, math.inf])
    def test_a_target_beyond_the_limits_is_refused_and_nothing_moves(self, bench: StageBench, degrees: float) -> None:
        bench.go(7.0)
        with pytest.raises(DeviceRefused, match="Nothing has moved"):
            bench.stage.start_move(math.radians(degrees), SPEED)
        assert not bench.stage.moving()
        assert math.degrees(bench.stage.position()) == pytest.approx(7.0, abs=bench.count)

    def test_the_limits_themselves_can_be_reached(self, bench: StageBench) -> None:
        assert bench.go(math.degrees(bench.stage.limits.low)) == pytest.approx(-5.0, abs=bench.count)

    @pytest.mark.parametrize("times_max", [1.01, 0.0, -1.0, math.nan])
    def test_a_speed_it_cannot_do_is_refused_and_nothing_moves(self, bench: StageBench, times_max: float) -> None:
        with pytest.raises(DeviceRefused, match="Nothing has moved"):
            bench.stage.start_move(0.1, times_max * bench.stage.limits.max_speed)
        assert not bench.stage.moving()
        assert bench.stage.position() == 0.0

    def test_a_second_move_is_refused_while_the_first_goes_on(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(20), SPEED)
        bench.clock.sleep(0.5)
        with pytest.raises(DeviceRefused, match="moves"):
            bench.stage.start_move(0.0, SPEED)
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(20.0, abs=bench.count)

    def test_a_wait_that_is_too_short_says_so_and_leaves_it_moving(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(20), SPEED)
        with pytest.raises(DeviceTimeout, match="left moving"):
            bench.stage.wait(0.5)
        assert bench.stage.moving()
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(20.0, abs=bench.count)

    # relative moves

    def test_a_thousand_relative_moves_of_a_third_of_a_degree_land_on_exact_counts(self, bench: StageBench) -> None:
        """A third of a degree is no whole count; no move may add another rounding, up, down, or at the turns."""
        stage = bench.stage
        third = math.radians(1 / 3)
        counts = stage.to_counts(third)
        assert third != stage.to_angle(counts)
        speed = stage.limits.max_speed
        expected = 0
        for sign, share in ((1, 0.29), (-1, 0.3), (1, 0.295), (-1, 0.115)):
            moves = round(share * self.RELATIVE_MOVES)
            for _ in range(moves):
                start_move_by(stage, sign * third, speed)
                stage.wait(LONG)
            expected += sign * moves * counts
            assert stage.status().counts == expected
            assert stage.to_counts(stage.position()) == expected
        assert bench.line.angle_at(bench.clock.now()) == pytest.approx(stage.to_angle(expected), rel=1e-9)

    @pytest.mark.parametrize("degrees", [-5.5, 101.0, math.nan, math.inf])
    def test_a_relative_move_beyond_the_limits_is_refused(self, bench: StageBench, degrees: float) -> None:
        bench.go(1.0)
        with pytest.raises(DeviceRefused, match="Nothing has moved"):
            start_move_by(bench.stage, math.radians(degrees) - math.radians(1.0), SPEED)
        assert math.degrees(bench.stage.position()) == pytest.approx(1.0, abs=bench.count)

    def test_a_relative_move_is_refused_while_it_moves(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(20), SPEED)
        bench.clock.sleep(0.5)
        with pytest.raises(DeviceRefused, match="moves"):
            start_move_by(bench.stage, 0.1, SPEED)
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(20.0, abs=bench.count)

    # status

    def test_its_status_is_where_it_is_and_what_it_does(self, bench: StageBench) -> None:
        stage = bench.stage
        status = stage.status()
        assert (status.counts, status.moving, status.fault) == (0, False, "")
        stage.start_move(math.radians(30), SPEED)
        bench.clock.sleep(1.5)
        status = stage.status()
        assert status.moving
        assert 0 < status.counts < bench.counts(30)
        assert status.counts == pytest.approx(bench.counts(math.degrees(bench.line.angle_at(bench.clock.now()))), abs=2)
        stage.wait(LONG)
        status = stage.status()
        assert (status.counts, status.moving, status.fault) == (bench.counts(30), False, "")

    def test_its_status_tells_a_stop_until_the_next_move(self, bench: StageBench) -> None:
        if not self.STOPS_ARE_TOLD:
            pytest.skip("this controller does not remember stops")
        bench.stage.start_move(math.radians(30), SPEED)
        bench.clock.sleep(1.0)
        bench.stage.stop()
        assert bench.stage.status().fault != ""
        bench.go(2.0)
        assert bench.stage.status().fault == ""

    # the reference

    def test_a_search_ends_at_the_same_place_from_either_side(self, bench: StageBench) -> None:
        if not self.HOMES:
            pytest.skip("the stage of this bench has no reference; that it refuses a search is tested below")
        places, counts = [], []
        for degrees in (20.0, -4.0, 0.0):
            bench.go(degrees)
            before = bench.clock.now()
            bench.stage.start_home()
            assert bench.clock.now() - before < 0.5
            where = bench.stage.wait(LONG)
            status = bench.stage.status()
            assert bench.stage.to_counts(where) == status.counts
            assert (status.moving, status.homed in {True, None}, status.fault) == (False, True, "")
            places.append(bench.line.angle_at(bench.clock.now()))
            counts.append(status.counts)
        assert places == pytest.approx([places[0]] * 3, abs=math.radians(bench.count))
        assert counts == [counts[0]] * 3
        assert bench.go(5.0) == pytest.approx(5.0, abs=bench.count)
        assert bench.pulses() == []

    def test_a_search_may_need_more_than_one_wait(self, bench: StageBench) -> None:
        if not self.HOMES:
            pytest.skip("the stage of this bench has no reference")
        bench.go(30.0)
        bench.stage.start_home()
        with pytest.raises(DeviceTimeout, match="left moving"):
            bench.stage.wait(0.1)
        bench.stage.wait(LONG)
        assert bench.stage.status().homed in {True, None}

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_a_search_that_is_stopped_is_not_taken_for_done(self, bench: StageBench, hard: bool) -> None:
        if not self.HOMES:
            pytest.skip("the stage of this bench has no reference")
        bench.go(90.0)
        bench.stage.start_home()
        bench.clock.sleep(0.3)
        (bench.stage.abort if hard else bench.stage.stop)()
        with pytest.raises(DeviceError, match="stopped short"):
            bench.stage.wait(LONG)
        where = bench.stage.position()
        bench.clock.sleep(30.0)
        assert bench.stage.position() == where
        bench.stage.start_home()
        bench.stage.wait(LONG)
        assert bench.stage.status().homed in {True, None}

    def test_a_search_is_refused_while_it_moves_or_without_a_reference(self, bench: StageBench) -> None:
        if self.HOMES:
            bench.stage.start_move(math.radians(20), SPEED)
            bench.clock.sleep(0.5)
            with pytest.raises(DeviceRefused, match="moves"):
                bench.stage.start_home()
            assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(20.0, abs=bench.count)
        else:
            with pytest.raises(DeviceRefused, match="Nothing has moved"):
                bench.stage.start_home()
            assert bench.stage.position() == 0.0

    # triggers

    @pytest.mark.parametrize(("first", "step", "n"), [(2.0, 0.5, 37), (-1.0, -0.25, 9), (1.0, 0.1, 1), (-1.0, -0.1, 1)])
    def test_a_train_gives_exactly_its_pulses_at_its_angles(
        self, bench: StageBench, first: float, step: float, n: int
    ) -> None:
        train = bench.train(first, step, n)
        bench.stage.arm(train)
        bench.clock.sleep(1.0)
        assert bench.pulses() == []
        bench.go(first + n * step + math.copysign(1.0, step))
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [train.start + k * train.interval for k in range(n)]
        for k, pulse in enumerate(bench.pulses()):
            asked = bench.stage.to_angle(train.start + k * train.interval)
            assert pulse.angle == pytest.approx(asked, abs=math.radians(bench.count))
            assert bench.line.angle_at(pulse.time) == pytest.approx(asked, abs=math.radians(bench.count))

    @pytest.mark.parametrize("sign", [1, -1])
    def test_a_single_pulse_may_have_any_interval(self, bench: StageBench, sign: int) -> None:
        bench.stage.arm(TriggerTrain(sign * 100, sign, 1))
        bench.go(sign * 3.0)
        assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [sign * 100]

    def test_at_constant_speed_pulses_are_equally_spaced_in_time(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(5.0, 0.5, 21))
        bench.go(20.0)
        times = [pulse.time for pulse in bench.pulses()]
        periods = [later - earlier for earlier, later in itertools.pairwise(times)]
        assert periods == pytest.approx([0.05] * 20, rel=1e-3)

    def test_the_train_ends_with_its_last_pulse_however_far_it_turns(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        bench.go(30.0)
        assert len(bench.pulses()) == 3

    def test_a_train_fires_once(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        bench.go(5.0)
        bench.go(0.0)
        bench.go(5.0)
        assert len(bench.pulses()) == 3

    def test_one_train_after_another(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        bench.go(5.0)
        bench.stage.arm(bench.train(4.5, -1.0, 4))
        bench.go(0.0)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [bench.counts(at) for at in (1.0, 2.0, 3.0, 4.5, 3.5, 2.5, 1.5)]

    def test_no_pulse_without_arming(self, bench: StageBench) -> None:
        bench.go(10.0)
        assert bench.pulses() == []

    def test_no_pulse_after_disarming(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 3))
        bench.stage.disarm()
        bench.go(10.0)
        assert bench.pulses() == []

    def test_disarming_in_the_middle_of_a_train_ends_it(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 9))
        bench.go(3.5)
        bench.stage.disarm()
        bench.go(7.5)
        bench.go(0.0)
        bench.go(20.0)
        assert len(bench.pulses()) == 3
        bench.stage.arm(bench.train(21.0, 1.0, 4))
        bench.go(30.0)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [bench.counts(at) for at in (1.0, 2.0, 3.0, 21.0, 22.0, 23.0, 24.0)]

    @pytest.mark.parametrize("sign", [1, -1])
    def test_a_train_that_is_stopped_in_the_middle_goes_on_with_the_next_move(
        self, bench: StageBench, sign: int
    ) -> None:
        bench.go(-4.5 if sign > 0 else 10.0)
        first = -3.0 if sign > 0 else 8.0
        bench.stage.arm(bench.train(first, sign * 0.5, 20))
        for degrees in (first + sign * 1.25, first + sign * 3.1, first + sign * 10.0):
            bench.go(degrees)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [bench.counts(first) + sign * k * bench.counts(0.5) for k in range(20)]

    def test_arming_again_replaces_the_train(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 9))
        bench.stage.arm(bench.train(2.0, 3.0, 2))
        bench.go(20.0)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [bench.counts(2.0), bench.counts(5.0)]

    def test_arming_again_in_the_middle_of_a_train_replaces_it(self, bench: StageBench) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 9))
        bench.go(3.5)
        bench.stage.arm(bench.train(2.0, -1.0, 2))
        bench.go(0.0)
        bench.go(20.0)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [bench.counts(at) for at in (1.0, 2.0, 3.0, 2.0, 1.0)]

    @pytest.mark.parametrize("sign", [1, -1])
    def test_at_a_speed_that_is_low_enough_pulses_come_at_each_of_the_smallest_intervals(
        self, build: Build, sign: int
    ) -> None:
        """A count where pulses have a width, two where fires toggle the output."""
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
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()]
        assert counts == [sign * (20 + interval * k) for k in range(50)]
        bench.stage.close()

    def test_disarming_what_is_not_armed_is_fine(self, bench: StageBench) -> None:
        bench.stage.disarm()
        bench.stage.disarm()

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

    def test_pulses_still_to_come_are_counted_where_the_controller_tells(self, bench: StageBench) -> None:
        told = [bench.stage.remaining_pulses()]
        bench.stage.arm(bench.train(1.0, 1.0, 5))
        told.append(bench.stage.remaining_pulses())
        bench.go(2.5)
        told.append(bench.stage.remaining_pulses())
        bench.go(10.0)
        told.append(bench.stage.remaining_pulses())
        assert told in ([0, 5, 3, 0], [None] * 4)

    def test_a_pulse_width_is_kept_and_trains_that_would_run_together_are_refused(self, build: Build) -> None:
        if self.WIDTH is None:
            pytest.skip("this output's pulses have one width; that another is refused is tested below")
        bench = build(pulse_width=self.WIDTH)
        described = bench.stage.describe()["pulse_width_s"]
        assert described == pytest.approx(self.WIDTH)
        per_count = 2 * math.pi / bench.stage.limits.counts_per_turn / bench.stage.limits.max_speed
        touching, apart = math.floor(self.WIDTH / per_count), math.ceil(2.5 * self.WIDTH / per_count)
        if touching > 0:
            with pytest.raises(DeviceRefused, match="cannot be emitted"):
                bench.stage.arm(TriggerTrain(bench.counts(2.0), touching, 5))
        bench.stage.arm(TriggerTrain(bench.counts(2.0), apart, 50))
        bench.stage.start_move(math.radians(90), bench.stage.limits.max_speed)
        bench.stage.wait(LONG)
        assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [
            bench.counts(2.0) + k * apart for k in range(50)
        ]
        bench.stage.close()

    def test_a_pulse_width_or_polarity_that_it_has_not_is_refused(self, build: Build) -> None:
        with pytest.raises((DeviceRefused, ValueError)):
            build(pulse_width=self.NO_WIDTH)
        if not self.INVERTS:
            with pytest.raises((DeviceRefused, ValueError)):
                build(active_high=False)

    def test_inverted_pulses_are_as_many_and_at_the_same_angles(self, build: Build) -> None:
        if not self.INVERTS:
            pytest.skip("this output cannot be inverted; that it refuses is tested above")
        bench = build(active_high=False)
        bench.stage.arm(bench.train(1.0, 0.5, 10))
        bench.go(10.0)
        assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [
            bench.counts(1.0) + k * bench.counts(0.5) for k in range(10)
        ]
        bench.stage.close()

    # stops

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_a_stop_on_the_way_stands_short_and_gives_no_more_pulses(self, bench: StageBench, hard: bool) -> None:
        bench.stage.arm(bench.train(1.0, 1.0, 40))
        bench.stage.start_move(math.radians(50), SPEED)
        bench.clock.sleep(2.0)
        asked_at = bench.clock.now()
        (bench.stage.abort if hard else bench.stage.stop)()
        with pytest.raises(DeviceError, match="stopped short"):
            bench.stage.wait(LONG)
        assert not bench.stage.moving()
        where = bench.stage.position()
        braking = 0.0 if hard else SPEED / bench.stage.limits.acceleration
        assert bench.clock.now() - asked_at == pytest.approx(braking, abs=0.3)
        bench.clock.sleep(30.0)
        assert bench.stage.position() == where
        assert 5.0 < math.degrees(where) < 25.0
        assert len(bench.pulses()) == math.floor(math.degrees(where) + 1e-9)

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_a_stop_is_legal_while_it_stands_and_it_moves_afterwards(self, bench: StageBench, hard: bool) -> None:
        (bench.stage.abort if hard else bench.stage.stop)()
        assert bench.stage.wait(1.0) == 0.0
        assert bench.go(2.0) == pytest.approx(2.0, abs=bench.count)

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_after_a_stop_it_goes_on_elsewhere(self, bench: StageBench, hard: bool) -> None:
        bench.stage.start_move(math.radians(50), SPEED)
        bench.clock.sleep(1.0)
        (bench.stage.abort if hard else bench.stage.stop)()
        assert bench.go(-2.0) == pytest.approx(-2.0, abs=bench.count)

    # the end

    def test_closing_twice_is_fine_and_a_closed_stage_says_so(self, bench: StageBench) -> None:
        bench.stage.close()
        bench.stage.close()
        with pytest.raises(DeviceError):
            bench.stage.position()
