"""StageConformance: laws for every stage, real or simulated: the suite that each stage's tests subclass."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.testing.stages.bench import Build, StageBench, StageKind
from drivers.testing.stages.moves import Moves
from drivers.testing.stages.pulses import Pulses
from drivers.testing.stages.reference import Reference
from drivers.testing.stages.stops import Stops
from drivers.testing.stages.trains import Trains

__all__ = ["Build", "StageBench", "StageConformance", "StageKind"]


class StageConformance(Moves, Stops, Trains, Pulses, Reference):
    """A subclass gives the fixtures `kind` and `build`; the stage of `build` stands at angle 0."""

    @pytest.fixture
    def kind(self) -> StageKind:
        """The facts about the stage that the suite needs."""
        raise NotImplementedError

    @pytest.fixture
    def build(self, kind: StageKind) -> Build:
        """Called with settings of the driver that differ from the usual ones it opens the stage on a fresh wire."""
        raise NotImplementedError

    @pytest.fixture
    def bench(self, build: Build) -> Iterator[StageBench]:
        bench = build()
        yield bench
        bench.stage.close()
