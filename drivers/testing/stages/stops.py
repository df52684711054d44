"""Every stage: a stop or an abort during a move and while it stands, and moves afterwards."""

from __future__ import annotations

import math
import threading

import pytest

from drivers.base.errors import DeviceError
from drivers.testing.stages.bench import LONG, SPEED, StageBench


class StopTests:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

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

    def test_a_stop_from_another_thread_ends_the_wait_with_an_error(self, bench: StageBench) -> None:
        bench.stage.start_move(math.radians(90), math.radians(1))
        bench.clock.sleep(5.0)
        stopper = threading.Thread(target=bench.stage.stop)
        stopper.start()
        with pytest.raises(DeviceError, match="stopped short"):
            bench.stage.wait(1e4)
        stopper.join()
        assert not bench.stage.moving()
