"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# How many examples property tests and fuzz run: HYPOTHESIS_PROFILE=thorough pytest tests/drivers -k fuzz
# No deadline: a busy machine makes an example slow now and then; that is no fault of the code.
settings.register_profile("few", deadline=None)
settings.register_profile("ci", deadline=None, max_examples=500, print_blob=True)
settings.register_profile("thorough", deadline=None, max_examples=10_000, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "few"))

ROOT = Path(__file__).parents[1]
WITH_KERNELS = ("beamline", "bench", "recon")
"""Folders of tests that need compiled kernels."""
SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def _folder(item: pytest.Item) -> str:
    return item.path.relative_to(ROOT / "tests").parts[0]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests without kernels go first: meanwhile `compiled_ahead` compiles."""
    items.sort(key=lambda item: _folder(item) in WITH_KERNELS)


@pytest.fixture(scope="session", autouse=True)
def compiled_ahead(request: pytest.FixtureRequest) -> Iterator[None]:
    """Where tests of both kinds are run, kernels that are not in numba's cache yet are compiled in the background."""
    needs_kernels = {_folder(item) in WITH_KERNELS for item in request.session.items}
    if needs_kernels != {True, False}:
        yield
        return
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "1"}
    with subprocess.Popen([sys.executable, str(ROOT / "tests" / "compile_ahead.py")], env=environment) as process:
        yield
        process.kill()


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed: a failing test fails again."""
    return np.random.default_rng(20261120)


@pytest.fixture
def shared_data() -> Path:
    """Folder of real scans beside the checkout; tests that need it skip where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("real scans are not beside this checkout (../shared/data)")
    return SHARED_DATA
