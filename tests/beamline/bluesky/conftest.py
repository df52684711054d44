"""A RunEngine with a loop of its own."""

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def engine() -> Iterator[Any]:
    from bluesky.run_engine import RunEngine

    loop = asyncio.new_event_loop()
    engine = RunEngine(loop=loop, context_managers=[])
    yield engine
    loop.call_soon_threadsafe(loop.stop)
    engine._th.join(20)
    loop.close()
