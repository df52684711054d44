"""The registry of checks: bits never change, limits are values, and a new check needs only its line."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import beamline
from beamline.monitor.check import Check, Flag, Level, ScanContext
from beamline.monitor.checks import ALARM_SHIFT, CHECKS, _distinct, bitmask
from beamline.monitor.digest import digest

REPOSITORY = Path(beamline.__file__).parents[1]
BITS = {"beam": 0, "saturation": 1, "stuck": 2, "bands": 3, "timing": 4, "mass": 5, "dark": 6, "lost": 7, "gain": 8}
BITS |= {
    "motion": 9,
    "floater": 10,
    "ghost": 11,
    "pixels": 12,
    "field": 13,
    "blur": 14,
    "zingers": 32,
    "opposite": 15,
}
"""As files hold them since the first version: a number here is never changed."""

check_of_each_name = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)


def test_the_bits_are_those_of_the_files_that_exist() -> None:
    assert ({check.name: check.bit for check in CHECKS}, ALARM_SHIFT) == (BITS, 16)


@given(st.lists(st.tuples(st.sampled_from(sorted(BITS)), st.sampled_from(Level)), unique_by=lambda pair: pair[0]))
def test_every_set_of_flags_has_its_own_bits(found: list[tuple[str, Level]]) -> None:
    bits = bitmask([Flag(check, level, 0, 1.0, 0.0, "") for check, level in found])
    assert bits == sum(1 << BITS[name] for name, level in found if level is not Level.INFO) + sum(
        1 << 16 + BITS[name] for name, level in found if level is Level.ALARM
    )
    assert 0 <= bits < 2**64


@pytest.mark.parametrize("change", [{"bit": 3}, {"name": "bands"}, {"bit": 16}, {"bit": 48}, {"bit": -1}])
def test_a_check_with_a_bit_or_a_name_that_is_taken_is_refused(change: dict[str, Any]) -> None:
    bands = next(check for check in CHECKS if check.name == "bands")
    other = type("Other", (type(bands),), {"name": "other", "bit": 47} | change)()
    with pytest.raises(ValueError, match=r"bit \(0 \.\.\. 15, 32 \.\.\. 47\).*bands 3"):
        _distinct(*CHECKS, other)


@check_of_each_name
def test_a_look_changes_neither_the_check_nor_the_state_it_was_given(fake: Any, check: Check) -> None:
    state, context = check.start(), ScanContext(65535, 64 * 96, 0.1)
    for frame in fake.flats(3) + fake.views(12) + fake.darks(2, light=1.0) + fake.views(12, light=0.5):
        found = digest(frame.counts, 65535, 4)
        first, again = check.look(state, frame, found, context), check.look(state, frame, found, context)
        assert first.flag == again.flag
        state = first.state


@check_of_each_name
def test_every_check_has_its_row_on_the_monitors_page(check: Check) -> None:
    page = (REPOSITORY / "docs" / "monitor.md").read_text(encoding="utf-8")
    assert page.count(f"\n| {check.name} | ") == 1
