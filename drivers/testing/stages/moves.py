"""Every stage: identity, position, absolute and relative moves, status, closing."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.testing.stages.bench import LONG, SPEED, StageBench, StageKind, start_move_by


class Moves:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

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

    @pytest.mark.slow
    def test_a_thousand_relative_moves_of_a_third_of_a_degree_land_on_exact_counts(
        self, kind: StageKind, bench: StageBench
    ) -> None:
        """A third of a degree is no whole count; no move may add another rounding, up, down, or at the turns."""
        stage = bench.stage
        third = math.radians(1 / 3)
        counts = stage.to_counts(third)
        assert third != stage.to_angle(counts)
        speed = stage.limits.max_speed
        expected = 0
        for sign, share in ((1, 0.29), (-1, 0.3), (1, 0.295), (-1, 0.115)):
            moves = round(share * kind.relative_moves)
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

    def test_closing_twice_is_fine_and_a_closed_stage_says_so(self, bench: StageBench) -> None:
        bench.stage.close()
        bench.stage.close()
        with pytest.raises(DeviceError):
            bench.stage.position()
