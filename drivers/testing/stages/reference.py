"""Every stage: the search for the reference ends at one place, can be stopped, and is refused without a reference."""

from __future__ import annotations

import math

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.testing.stages.bench import LONG, SPEED, StageBench, StageKind


class ReferenceTests:
    """Laws of drivers.base.protocols.RotationStage; see `drivers.testing.stages.StageConformance`."""

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
    """A stage without a reference refuses a search where it stands, and stays there."""
    bench.go(degrees)
    before = bench.stage.position()
    with pytest.raises(DeviceRefused, match="Nothing has moved"):
        bench.stage.start_home()
    assert bench.stage.position() == before
