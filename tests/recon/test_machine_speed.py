"""Rates of operations: those of the law that the runs follow, and every operation does what it is named after."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon import machine_speed as module
from recon.base.work import Rate
from recon.machine_speed import measured_rate


class Counting:
    """A clock that only work moves on."""

    time = 0.0

    def __call__(self) -> float:
        return self.time

    def taking(self, seconds: float) -> Callable[[], None]:
        def run() -> None:
            self.time += seconds

        return run


@given(st.floats(0, 10), st.floats(1e-3, 10), st.integers(1, 4))
def test_the_rates_of_a_line_are_found_again(first: float, second: float, threads: int) -> None:
    clock = Counting()
    sizes = [(10.0, 20.0), (30.0, 600.0)]
    timed = tuple(module.SizedRun(a, b, clock.taking(first * a + second * b)) for a, b in sizes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "OPERATIONS", {"sweep": lambda which: timed, "draw": lambda which: timed})
        shared, alone = (measured_rate(name, clock, threads) for name in ("sweep, parallel", "draw"))
    assert shared == pytest.approx((first / threads, second / threads), rel=1e-6, abs=1e-6)
    assert alone == pytest.approx((first, second), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("seconds", [(9.0, 3.0), (1.0, 900.0)])
def test_no_rate_is_below_zero_on_a_busy_machine(seconds: tuple[float, float]) -> None:
    clock = Counting()
    timed = tuple(
        module.SizedRun(a, b, clock.taking(s)) for (a, b), s in zip([(10, 20), (30, 600)], seconds, strict=True)
    )
    found = module.rate_of(timed, clock)
    assert min(found) >= 0 and 30 * found.first + 600 * found.second == pytest.approx(seconds[1])


@pytest.mark.parametrize("operation", ["sweep, parallel", "single sweep, parallel", "pass", "tv", "view, parallel"])
def test_operations_run(operation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RUNS", 1)
    rate = measured_rate(operation, time.process_time)
    assert isinstance(rate, Rate) and max(rate) > 0
