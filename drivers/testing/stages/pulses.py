"""Every stage: widths and polarities of pulses, and trains that an output cannot emit."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.testing.stages.bench import LONG, SPEED, Build, StageBench, StageKind


class Pulses:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

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
        if kind.width is None:  # it has no choice, as the refusal shows
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
        assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [
            bench.counts(2.0) + k * apart for k in range(50)
        ]
        bench.stage.close()

    def test_inverted_pulses_are_as_many_and_at_the_same_angles_or_refused(self, kind: StageKind, build: Build) -> None:
        if not kind.inverts:
            with pytest.raises((DeviceRefused, ValueError)):
                build(active_high=False)
            return
        bench = build(active_high=False)
        bench.stage.arm(bench.train(1.0, 0.5, 10))
        bench.go(10.0)
        assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [
            bench.counts(1.0) + k * bench.counts(0.5) for k in range(10)
        ]
        bench.stage.close()
