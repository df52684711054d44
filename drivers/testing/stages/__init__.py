"""StageConformance: conformance tests for every stage, real or simulated; the tests of a stage derive from them."""

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
        pytest.fail(
            "Define the fixture `kind` in the subclass: a StageKind with the facts about the stage that the tests need."
        )

    @pytest.fixture
    def build(self, kind: StageKind) -> Build:
        pytest.fail(
            "Define the fixture `build` in the subclass: a function that opens the stage with settings of the driver "
            "on a new wire."
        )

    @pytest.fixture
    def bench(self, build: Build) -> Iterator[StageBench]:
        bench = build()
        yield bench
        bench.stage.close()


class StageConformance(_Suite, Moves, Trains):
    """The tests of a stage. A subclass defines the fixtures `kind` and `build`; the stage of `build` is at angle 0."""


class StepStageConformance(_Suite, Moves, NoTrains):
    """The tests of a stage without a trigger output (`StageKind.triggers` is False)."""
