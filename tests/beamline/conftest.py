"""Fixtures for tests that fit small volumes."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import pytest


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Tiny fits on one thread: on a busy machine, waiting for a second one takes ten times as long as the work."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)
