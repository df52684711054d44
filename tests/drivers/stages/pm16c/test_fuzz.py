"""Fuzz of the PM16C driver: whatever the controller seems to say, calls end in time, and nothing but DeviceError."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.drivers.fuzz import Pieces, plans
from tests.drivers.pm16c_rig import QUERIES_TO_OPEN, Rig
from tests.drivers.stages.fuzz_laws import (
    CALLS,
    Call,
    Fuzzed,
    every_call_ends_in_time_and_the_stage_can_be_used_again,
    opening_opens_or_says_why,
)

SAMPLES = [
    b"1.50 17-04-01 PM16C-04XDL-SIMULATED\r\n",
    b"RBS000+0000000\r\n",
    b"RBP007+0000100\r\n",
    b"RBS040-0000100\r\n",
    b"RBS---+2147483647\r\n",
    b"B123\r\n",
    b"+0000000\r\n",
    b"-0000135\r\n",
    b"0002500\r\n",
    b"017\r\n",
    b"HSPD\r\n",
    b"YES\r\n",
    b"NO\r\n",
    b"NO H.P\r\n",
    b"R4\r\n",
    b"NO ERROR\r\n",
    b"00000000\r\n",
    b"STOPB\r\n",
]
PM16C = Fuzzed(
    lambda: Rig(home_at=300),
    QUERIES_TO_OPEN,
    disarmed=lambda rig: rig.say("TMGR?B") == "NO",
    counts=lambda rig: rig.controller.box.sample.position(),
)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    opening_opens_or_says_why(PM16C, plan)


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Call]
) -> None:
    every_call_ends_in_time_and_the_stage_can_be_used_again(PM16C, plan, calls)
