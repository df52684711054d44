"""Times are read and written in s, min and h."""

from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from recon.assess.time_model import duration_text, parse_budget


@given(st.floats(0.1, 900))
def test_times_are_read_in_any_unit(value: float) -> None:
    assume(value > 0.1)
    assert parse_budget(f"{value}s") == parse_budget(str(value)) == pytest.approx(value)
    assert parse_budget(f" {value}m ") == pytest.approx(60 * value)
    assert parse_budget(f"{value}H") == pytest.approx(3600 * value)


@pytest.mark.parametrize("text", ["", "s", "0s", "-1m", "nan", "inf", "30 parsecs", "1h30m", "1e400s"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match="is not a time"):
        parse_budget(text)


def test_times_are_said_in_units_that_fit() -> None:
    assert [duration_text(t) for t in (0.25, 31.4, 150, 7200)] == ["0.25 s", "31.4 s", "2.5 min", "2 h"]
