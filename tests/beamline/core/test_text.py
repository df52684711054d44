"""Text of files is shown, and does nothing to a terminal."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from beamline.core.text import printable


def test_control_characters_are_shown_not_sent() -> None:
    assert printable("a\x1b[31mb\x07\u202e") == "a\\x1b[31mb\\x07\\u202e"
    assert printable("20 °C,\tµm\n") == "20 °C,\tµm\n"


@given(st.text())
def test_printable_is_printable_and_stays(text: str) -> None:
    shown = printable(text)
    assert shown.replace("\n", "").replace("\t", "").isprintable()
    assert printable(shown) == shown
