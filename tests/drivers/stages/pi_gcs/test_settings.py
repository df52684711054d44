"""PI GCS 2.0 trigger trains: where the firmware puts the first pulse, and trains that end with an error."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.pi_gcs.settings import PiFirstPulse
from tests.drivers.stages.pi_gcs_rig import Rig
from tests.messages import refused


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.mark.parametrize("rule", list(PiFirstPulse))
@pytest.mark.parametrize(("first", "step", "n"), [(250, 25, 10), (500, 5, 1), (-500, -100, 6), (375, 125, 30)])
def test_wherever_the_firmware_puts_the_first_pulse_a_train_is_at_its_counts(
    rule: PiFirstPulse, first: int, step: int, n: int
) -> None:
    bench = Rig(first_pulse=rule).bench(first_pulse=rule.value, low=math.radians(-20))
    bench.stage.arm(TriggerTrain(first, step, n))
    bench.go(math.copysign(18.0, step) if step < 0 else 40.0)
    assert [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [first + k * step for k in range(n)]


@pytest.mark.parametrize(
    ("rule", "says", "expected"),
    [("at_threshold", "step_after", 4), ("step_after", "at_threshold", 2)],
)
def test_the_wrong_rule_shows_in_the_number_of_pulses(rule: str, says: str, expected: int) -> None:
    """That is how it is found out at an instrument: one too many, or one too few."""
    bench = Rig(first_pulse=PiFirstPulse(rule)).bench(first_pulse=says)
    bench.stage.arm(bench.train(2.0, 1.0, 3))
    bench.go(20.0)
    assert len(bench.pulses()) == expected


def test_a_train_off_the_grid_is_refused_where_the_firmware_has_one() -> None:
    stage = Rig(first_pulse=PiFirstPulse.GRID).open(first_pulse="grid")
    with refused(DeviceRefused):
        stage.arm(TriggerTrain(250, 100, 3))


def test_arming_too_near_before_the_first_pulse_is_refused_where_a_step_goes_before_it() -> None:
    rig = Rig(first_pulse=PiFirstPulse.STEP_AFTER)
    bench = rig.bench(first_pulse="step_after")
    bench.go(3.0)
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(3.5, 1.0, 3))
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(3.0, 1.0, 3))
    bench.go(2.0)
    bench.stage.arm(bench.train(3.5, 1.0, 3))
    bench.go(10.0)
    assert [round(math.degrees(pulse.angle), 3) for pulse in bench.pulses()] == [3.5, 4.5, 5.5]


def test_pulses_that_would_merge_are_refused() -> None:
    """At 30 degrees/s a count of 0.004 degrees lasts 133 µs."""
    stage = Rig().open(firmware_pulse=60e-6)
    stage.arm(TriggerTrain(100, 1, 3))
    stage.close()
    with refused(DeviceRefused):
        Rig().open(firmware_pulse=70e-6).arm(TriggerTrain(100, 1, 3))
