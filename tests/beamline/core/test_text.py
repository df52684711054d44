"""Text from files cannot control a terminal; a suggested number has three digits and stays on its side of a limit."""

import csv
import io
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.text import csv_text, printable, rounded, safe_name


def test_control_characters_are_shown_not_sent() -> None:
    assert printable("a\x1b[31mb\x07\u202e") == "a\\x1b[31mb\\x07\\u202e"
    assert printable("20 °C,\tµm\n") == "20 °C,\\tµm\n"


@given(st.text())
def test_printable_is_printable_and_stays(text: str) -> None:
    shown = printable(text)
    assert shown.replace("\n", "").isprintable()
    assert printable(shown) == shown


@given(st.floats(1e-9, 1e9))
def test_rounded_has_three_digits_on_the_side_asked_for(value: float) -> None:
    down, up = rounded(value), rounded(value, up=True)
    assert down <= value * (1 + 1e-11) and up >= value * (1 - 1e-11)
    assert up - down <= 0.0101 * value
    assert all(math.isclose(number, float(f"{number:.3g}")) for number in (down, up))


@given(st.text(), st.integers(8, 130))
def test_a_safe_name_is_its_own_and_stays_in_its_folder(text: str, most: int) -> None:
    name = safe_name(text, most)
    assert safe_name(name, most) == name and name.isprintable() and 0 < len(name.encode()) <= most
    assert not set(name) & set('/\\:*?"<>|$`;') and name[0] not in ".-=+@~ " and name[-1] not in ". "


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("walnut (1), 20 °C", "walnut (1), 20 °C"), ("..", "unnamed"), ("./../victim", "_.._victim"),
        ("con", "_con"), ("nul ", "_nul"), ("CON .txt", "_CON .txt"),
        ("LPT1.tif", "_LPT1.tif"), ("control", "control"), ("\x1b[2J\udcff", "_[2J_"),
        ("=1+1", "1+1"), ("骨" * 50, "骨" * 40),
    ],
)  # fmt: skip
def test_safe_names(text: str, name: str) -> None:
    assert safe_name(text) == name


@pytest.mark.parametrize("text", ["=1+1", "+1+1", "-1+1", "@sum(a1)", "-cmd", "=1+1\n"])
def test_a_table_has_no_formula_of_a_foreign_text(text: str) -> None:
    ((cell, other),) = csv.reader(io.StringIO(csv_text([[text, "a=1"]]), newline=""))
    assert (cell, other) == (f"'{text}", "a=1")


def test_a_table_shows_control_characters() -> None:
    assert csv_text([["\x1b[2J\ta", "\r=1"]]) == "\\x1b[2J\\ta,\\r=1\n"


def test_numbers_of_a_table_stay_numbers() -> None:
    row = [-1.5, "-1.5", "+3", "-1e-07", "-.5", "-inf", "-", None, Path("=1")]
    assert csv_text([row]) == "-1.5,-1.5,+3,-1e-07,-.5,-inf,-,,'=1\n"
