"""StageConformance: conformance tests for every stage, real or simulated; the tests of a stage subclass them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.testing.stages.bench import Build, StageBench, StageKind
from drivers.testing.stages.moves import Moves
from drivers.testing.stages.trains import NoTrains, Trains

__all__ = ["Build", "StageBench", "StageConformance", "StageKind", "StepStageConformance"]


class _Suite:
    """The fixtures of a suite."""

    @pytest.fixture
    def kind(self) -> StageKind:
        pytest.fail("A subclass gives the fixture `kind`: a StageKind, what the suite has to know of the stage.")

    @pytest.fixture
    def build(self, kind: StageKind) -> Build:
        pytest.fail(
            "A subclass gives the fixture `build`: a function of settings of the driver "
            "that opens the stage on a fresh wire."
        )

    @pytest.fixture
    def bench(self, build: Build) -> Iterator[StageBench]:
        bench = build()
        yield bench
        bench.stage.close()


class StageConformance(_Suite, Moves, Trains):
    """A subclass gives the fixtures `kind` and `build`; the stage of `build` stands at angle 0."""


class StepStageConformance(_Suite, Moves, NoTrains):
    """The same for a stage without a trigger output (`StageKind.triggers` is False)."""
