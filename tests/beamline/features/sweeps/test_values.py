"""Values of swept options: ranges and lists, and what is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.sweeps.command import sweepable
from beamline.features.sweeps.values import MOST, SweptOption, combinations, swept_option

LEGAL = ("tv-weight", "rings", "axis")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tv_weight=0.5:2:0.5", ("tv-weight", ("0.5", "1.0", "1.5", "2.0"))),
        ("--axis=84:85:0.3", ("axis", ("84.0", "84.3", "84.6", "84.9"))),
        ("axis=3:1:-1", ("axis", ("3", "2", "1"))),
        ("tv-weight=1e-3,2e-3", ("tv-weight", ("1e-3", "2e-3"))),
        ("rings=none, vo,none", ("rings", ("none", "vo"))),
    ],
)
def test_ranges_and_lists(text: str, expected: tuple[str, tuple[str, ...]]) -> None:
    option = swept_option(text, LEGAL)
    assert (option.name, option.values) == expected


@given(st.integers(-500, 500), st.integers(1, 60), st.integers(1, MOST - 1))
def test_a_range_has_each_step_and_both_ends_without_rounding(first: int, step: int, steps: int) -> None:
    """In hundredths, which binary numbers do not hold."""
    last = first + steps * step
    values = swept_option(f"axis={first / 100}:{last / 100}:{step / 100}", LEGAL).values
    assert [round(100 * float(value)) for value in values] == list(range(first, last + 1, step))
    assert all(len(value) <= 8 for value in values)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("tv_weigt=1,2", "did you mean tv-weight?"),
        ("rings", "expected NAME=A:B:STEP"),
        ("rings=vo", "at least two"),
        ("axis=5:1:1", "does not lead"),
        ("axis=1:5:0", "does not lead"),
        ("axis=1:5000:1", "give a larger STEP"),
    ],
)
def test_nonsense_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why.replace("?", r"\?")):
        swept_option(text, LEGAL)


def test_two_options_make_a_grid_whose_last_one_changes_fastest() -> None:
    grid = combinations([SweptOption("a", ("1", "2")), SweptOption("b", ("x", "y"))])
    assert [tuple(values.values()) for values in grid] == [("1", "x"), ("1", "y"), ("2", "x"), ("2", "y")]


@pytest.mark.parametrize("names", ["", "aa", "abc"])
def test_other_numbers_of_options_are_refused(names: str) -> None:
    with pytest.raises(ValueError, match="or two others"):
        combinations([SweptOption(name, ("1", "2")) for name in names])


def test_a_grid_too_large_is_refused() -> None:
    many = tuple(map(str, range(9)))
    with pytest.raises(ValueError, match="81 combinations"):
        combinations([SweptOption("a", many), SweptOption("b", many)])


def test_options_of_a_slice_can_be_swept_and_those_of_a_volume_or_a_call_cannot() -> None:
    names = sweepable().keys()
    assert {"tv-weight", "rings", "axis", "phase", "bin", "views", "method", "filter", "iterations"} <= names
    assert not {"output", "config", "follow", "memory", "json", "roi", "dry-run"} & names
