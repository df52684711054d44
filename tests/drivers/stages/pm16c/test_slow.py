"""PM16C driver with older firmware, for any position of the first pulse, and pulse widths in microseconds."""

from __future__ import annotations

import pytest

from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.pm16c.settings import Pm16cFirstPulse
from tests.drivers.pm16c_rig import Rig
from tests.messages import refused


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("fires_at_start", [True, False])
def test_a_train_is_right_whether_the_start_point_fires_or_not_as_long_as_that_is_known(
    sign: int, fires_at_start: bool
) -> None:
    known = Pm16cFirstPulse.AT_START if fires_at_start else Pm16cFirstPulse.INTERVAL_AFTER
    bench = Rig(fires_at_start=fires_at_start).bench(low=-2.0, high=2.0, first_pulse=known)
    for first, interval, n in ((500, 100, 12), (2000, 7, 3), (3000, 4, 1), (3100, 1, 9)):
        before = len(bench.pulses())
        bench.stage.arm(TriggerTrain(sign * first, sign * interval, n))
        bench.go(sign * 20.0)
        counts = [bench.stage.to_counts(pulse.angle) for pulse in bench.pulses()[before:]]
        assert counts == [sign * (first + interval * k) for k in range(n)]
        bench.go(0.0)
    assert bench.stage.describe()["first_pulse"] == known
    bench.stage.close()


def test_the_room_before_the_first_pulse_is_in_the_limits_and_asked_for() -> None:
    bench = Rig(fires_at_start=False).bench(first_pulse="interval_after")
    assert bench.stage.limits.run_up == 1
    with refused(DeviceRefused):
        bench.stage.arm(bench.train(1.0, 1.0, 5))
    bench.stage.close()
    bench = Rig().bench()
    assert bench.stage.limits.run_up == 0
    bench.stage.close()
    with refused(ValueError):
        Rig().open(first_pulse="sometimes")


def test_firmware_without_the_status_of_one_channel_is_refused_in_words() -> None:
    rig = Rig(version="1.46 06-10-14 PM16C-04X")
    with refused(DeviceRefused):
        rig.open()
    Rig(version="1.47 12-10-14 PM16C-04XD").open().close()


def test_the_status_of_another_channel_is_not_believed() -> None:
    rig = Rig()
    stage = rig.open()
    transmit = rig.transmit
    rig.transmit = lambda: transmit().replace(b"RBS", b"RAS")  # type: ignore[method-assign]
    with refused(DeviceError):
        stage.moving()
    rig.transmit = transmit  # type: ignore[method-assign]
    stage.close()


@pytest.mark.parametrize("width", [10 * 1e-6, 100 * 1e-6, 0.2 * 1e-6, 1000 * 1e-6])
def test_a_width_in_microseconds_times_a_millionth_is_that_width(width: float) -> None:
    """10 * 1e-6 is not 1e-05, and 0.2 * 1e-6 not 200e-9, in floating point."""
    stage = Rig().open(pulse_width=width)
    assert stage.describe()["pulse_width_s"] == pytest.approx(width)
    stage.close()
