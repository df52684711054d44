"""The kernels for a hard case. Files that use them say `slow`: a run of slow tests skips those that do not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.recon.hard_cases.on import On, cpu, gpu

# The interpreter uses numpy, which warns about infinities that a GPU produces silently; tests/recon/kernels/gpu is
# quick.
INTERPRETED = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """In the gate, only the first case of each test is interpreted; the others run before a release."""
    seen = set[tuple[Path, str]]()
    for item in items:
        if isinstance(item, pytest.Function) and hasattr(item, "callspec") and item.callspec.params.get("on") is gpu:
            if (law := (item.path, item.originalname)) in seen:
                item.add_marker(pytest.mark.long)
            seen.add(law)


@pytest.fixture(params=[pytest.param(cpu, id="cpu"), pytest.param(gpu, id="gpu", marks=INTERPRETED)])
def on(request: pytest.FixtureRequest) -> On:
    return request.param()
