"""Conformance tests of a stage: identity, position, moves, stops, the search for the reference, closing."""

from __future__ import annotations

import math
import threading

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.testing.stages.bench import LONG, SPEED, StageBench, StageKind


class Moves:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

    def test_it_says_who_it_is(self, bench: StageBench) -> None:
        assert bench.stage.name
        described = bench.stage.describe()
        assert described["model"]
        assert described["counts_per_turn"] == bench.stage.limits.counts_per_turn
        assert all(isinstance(value, str | int | float) for value in described.values())

    def test_its_limits_make_sense(self, kind: StageKind, bench: StageBench) -> None:
        limits = bench.stage.limits
        assert limits.counts_per_turn > 0
        assert limits.max_speed > 0
        assert limits.acceleration > 0
        assert limits.low < limits.high
        assert limits.trigger_output is kind.triggers

    def test_counts_and_angles_are_inverse_and_nearest(self, bench: StageBench) -> None:
        stage = bench.stage
        for counts in (-7, 0, 1, 999, 12_345):
            assert stage.to_counts(stage.to_angle(counts)) == counts
            assert stage.to_counts(stage.to_angle(counts) + 0.4 * math.radians(bench.count)) == counts
        assert stage.to_counts(2 * math.pi) == stage.limits.counts_per_turn

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

    @pytest.mark.parametrize("degrees", [-5.1, 100.1, 4000.0, 1e300, math.nan, math.inf])
    def test_a_target_beyond_the_limits_is_refused_and_nothing_moves(self, bench: StageBench, degrees: float) -> None:
        bench.go(7.0)
        with pytest.raises(DeviceRefused, match="Nothing has moved"):
            bench.stage.start_move(math.radians(degrees), SPEED)
        assert not bench.stage.moving()
        assert math.degrees(bench.stage.position()) == pytest.approx(7.0, abs=bench.count)

    def test_the_limits_themselves_can_be_reached(self, bench: StageBench) -> None:
        assert bench.go(math.degrees(bench.stage.limits.low)) == pytest.approx(-5.0, abs=bench.count)

    @pytest.mark.parametrize("times_max", [1.01, 1e300, math.inf, 0.0, -1.0, math.nan])
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

    def test_closing_twice_is_fine_and_a_closed_stage_says_so(self, bench: StageBench) -> None:
        bench.stage.close()
        bench.stage.close()
        with pytest.raises(DeviceError):
            bench.stage.position()

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_a_stop_on_the_way_stands_short_and_gives_no_more_pulses(
        self, kind: StageKind, bench: StageBench, hard: bool
    ) -> None:
        if kind.triggers:
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
        assert len(bench.pulses()) == (math.floor(math.degrees(where) + 1e-9) if kind.triggers else 0)

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

    def test_a_stop_from_another_thread_ends_the_wait_with_an_error(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(90), math.radians(1))
        bench.clock.sleep(5.0)
        stopper = threading.Thread(target=bench.stage.stop)
        stopper.start()
        with pytest.raises(DeviceError, match="stopped short"):
            bench.stage.wait(1e4)
        stopper.join()
        assert not bench.stage.moving()

    def test_a_search_ends_at_the_same_place_from_either_side(self, kind: StageKind, bench: StageBench) -> None:
        if not kind.homes:
            _refused(bench, 20.0)
            return
        places, counts = [], []
        for degrees in (20.0, -4.0, 0.0):
            bench.go(degrees)
            before = bench.clock.now()
            bench.stage.start_home()
            assert bench.clock.now() - before < 0.5
            where = bench.stage.wait(LONG)
            assert bench.stage.position() == where
            assert not bench.stage.moving()
            places.append(bench.line.angle_at(bench.clock.now()))
            counts.append(bench.stage.to_counts(where))
        assert places == pytest.approx([places[0]] * 3, abs=math.radians(bench.count))
        assert counts == [counts[0]] * 3
        assert bench.go(5.0) == pytest.approx(5.0, abs=bench.count)
        assert bench.pulses() == []

    def test_a_search_may_need_more_than_one_wait(self, kind: StageKind, bench: StageBench) -> None:
        if not kind.homes:
            _refused(bench, 30.0)
            return
        bench.go(30.0)
        bench.stage.start_home()
        with pytest.raises(DeviceTimeout, match="left moving"):
            bench.stage.wait(0.1)
        bench.stage.wait(LONG)

    @pytest.mark.parametrize("hard", [False, True], ids=["stop", "abort"])
    def test_a_search_that_is_stopped_is_not_taken_for_done(
        self, kind: StageKind, bench: StageBench, hard: bool
    ) -> None:
        if not kind.homes:
            _refused(bench, 90.0)
            return
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

    def test_a_search_is_refused_while_it_moves_or_without_a_reference(
        self, kind: StageKind, bench: StageBench
    ) -> None:
        if not kind.homes:
            _refused(bench, 0.0)
            return
        bench.stage.start_move(math.radians(20), SPEED)
        bench.clock.sleep(0.5)
        with pytest.raises(DeviceRefused, match="moves"):
            bench.stage.start_home()
        assert math.degrees(bench.stage.wait(LONG)) == pytest.approx(20.0, abs=bench.count)


def _refused(bench: StageBench, degrees: float) -> None:
    """A stage without a reference rejects a search, and does not move."""
    bench.go(degrees)
    before = bench.stage.position()
    with pytest.raises(DeviceRefused, match="Nothing has moved"):
        bench.stage.start_home()
    assert bench.stage.position() == before
