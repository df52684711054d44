"""Every stage of ours, in each of its ways, passes the suite that is shipped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from drivers.testing.stages import Build, StageConformance
from tests.drivers.stages.conformance.benches import BENCHES, Kind


class TestStages(StageConformance):
    @pytest.fixture(params=BENCHES)
    def kind(self, request: pytest.FixtureRequest) -> Kind:
        return request.param

    @pytest.fixture
    def build(self, kind: Kind) -> Iterator[Build]:  # type: ignore[override]
        with ExitStack() as plugged:
            yield kind.build(plugged)
