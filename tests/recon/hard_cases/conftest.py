"""The kernels that a hard case runs on. Files that use them say `slow`: a run of slow tests skips those that do not."""

from __future__ import annotations

import pytest

from tests.recon.hard_cases.on import On, cpu, gpu

# The interpreter is numpy, which warns of an infinity that a GPU just makes; tests/recon/kernels/gpu is quick.
INTERPRETED = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


@pytest.fixture(params=[pytest.param(cpu, id="cpu"), pytest.param(gpu, id="gpu", marks=INTERPRETED)])
def on(request: pytest.FixtureRequest) -> On:
    return request.param()
