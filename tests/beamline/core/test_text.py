"""Text of files is shown, and does nothing to a terminal; an advised number has three digits and keeps its side."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.text import printable, rounded


def test_control_characters_are_shown_not_sent() -> None:
    assert printable("a\x1b[31mb\x07\u202e") == "a\\x1b[31mb\\x07\\u202e"
    assert printable("20 °C,\tµm\n") == "20 °C,\tµm\n"


@given(st.text())
def test_printable_is_printable_and_stays(text: str) -> None:
    shown = printable(text)
    assert shown.replace("\n", "").replace("\t", "").isprintable()
    assert printable(shown) == shown


@given(st.floats(1e-9, 1e9))
def test_rounded_has_three_digits_on_the_side_asked_for(value: float) -> None:
    down, up = rounded(value), rounded(value, up=True)
    assert down <= value * (1 + 1e-11) and up >= value * (1 - 1e-11)
    assert up - down <= 0.0101 * value
    assert all(math.isclose(number, float(f"{number:.3g}")) for number in (down, up))


@pytest.mark.parametrize("value", [0.0, math.inf])
def test_what_has_no_digits_stays(value: float) -> None:
    assert rounded(value) == rounded(value, up=True) == value
