"""The stages that every test of the shared suite runs on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.drivers.stage_bench import Build, StageBench
from tests.drivers.stages.conformance.benches import BENCHES, Kind


@pytest.fixture(params=BENCHES)
def kind(request: pytest.FixtureRequest) -> Kind:
    return request.param


@pytest.fixture
def build(kind: Kind) -> Iterator[Build]:
    """Called with settings of the constructor that differ from the usual ones it opens the stage, on a fresh wire."""
    with ExitStack() as plugged:
        yield kind.build(plugged)


@pytest.fixture
def bench(build: Build) -> Iterator[StageBench]:
    bench = build()
    yield bench
    bench.stage.close()
