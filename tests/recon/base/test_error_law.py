"""Error model: gains in dB compared with the error itself, and inequalities."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.error_law import ErrorLaw, Gain

SHARE = st.floats(0, 0.5)
LAWS = st.builds(ErrorLaw, st.integers(1, 2000), st.floats(0, 2), st.floats(0, 0.2), SHARE, SHARE)


def test_gains_are_those_of_the_error() -> None:
    law = ErrorLaw(100, 0.5, 0.1, 0.4, 0.2)
    assert law.gain(views=100).mean == pytest.approx(-10 * math.log10(0.8 / math.sqrt(2) + 0.2))
    assert law.gain(again=100).mean == pytest.approx(-10 * math.log10(0.4 + 0.2 + 0.2))
    assert law.gain(wide=True).mean == pytest.approx(-10 * math.log10(0.8))
    ends = law.gain(views=100)
    assert ends.low == pytest.approx(-10 * math.log10(0.8 * 2**-0.3 + 0.2))
    assert ends.high == pytest.approx(-10 * math.log10(0.8 * 2**-0.7 + 0.2))
    again = law.gain(again=100)
    assert again.low == pytest.approx(-10 * math.log10(1 - 0.24 / 2))  # the share of the noise is as uncertain
    assert again.high == pytest.approx(-10 * math.log10(1 - 0.56 / 2))
    assert law.gain(wide=True).low == pytest.approx(-10 * math.log10(1 - 0.6 * 0.2))


@given(LAWS, st.integers(0, 500), st.integers(0, 500), st.booleans())
def test_more_never_makes_it_worse(law: ErrorLaw, views: int, again: int, wide: bool) -> None:
    gain = law.gain(views, again, wide)
    assert -1e-9 <= gain.low <= gain.mean + 1e-9 and gain.mean <= gain.high + 1e-9
    assert law.gain(views + 1, again, wide).mean >= gain.mean - 1e-9
    assert law.gain(views, again + 1, wide).mean >= gain.mean - 1e-9
    assert law.gain(views, again, True).mean >= gain.mean - 1e-9


@given(LAWS, st.integers(1, 500), st.integers(1, 500))
def test_steps_add_up_where_views_take_all_of_the_error(law: ErrorLaw, first: int, second: int) -> None:
    law = ErrorLaw(law.n_views, law.exponent, law.exponent_error, law.noise)
    later = ErrorLaw(law.n_views + first, law.exponent, law.exponent_error, law.noise)
    assert law.gain(first).mean + later.gain(second).mean == pytest.approx(law.gain(first + second).mean, abs=1e-9)


def test_nothing_brings_nothing() -> None:
    assert repr(ErrorLaw(10, 0.5, 0.1, 0.4).gain().mean) == "0.0"


@given(LAWS, st.integers(1, 500))
def test_a_gain_that_is_known_to_half_of_it_counts_as_its_mean_and_another_one_as_its_high_end(
    law: ErrorLaw, views: int
) -> None:
    gain = replace(law, exponent_error=law.exponent / 4).gain(views=views, wide=True)
    assert gain.at_most == gain.mean
    assert Gain(1.0, 0.1, 1.9).at_most == 1.9
