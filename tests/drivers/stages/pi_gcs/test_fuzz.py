"""Fuzz of the PI GCS 2.0 driver: whatever the controller seems to say, calls end in time, with DeviceError at worst."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.drivers.fuzz import Pieces, plans
from tests.drivers.stages.fuzz_laws import (
    CALLS,
    Call,
    Fuzzed,
    every_call_ends_in_time_and_the_stage_can_be_used_again,
    opening_opens_or_says_why,
)
from tests.drivers.stages.pi_gcs_rig import Rig

REPLIES_TO_OPEN = 22
"""*IDN? CSV? ERR? SAI? #5 ERR? SPA? SPA? ERR? TRO? SVO? ERR? SVO? ERR? ACC? ERR? DEC? TMN? TMX?"""
SAMPLES = [
    b"(c)2026 Physik Instrumente (PI) GmbH & Co. KG, C-863.12, 0, 1.2.1.0\n",
    b"2.0\n",
    b"0\n",
    b"1\n",
    b"5\n",
    b"10\n",
    b"1024\n",
    b"1=0\n",
    b"1=1\n",
    b"1=-12.500000\n",
    b"1=1.79769e+308\n",
    b"1 0xE=90000.000000\n",
    b"1=1.5000 \n2=-3.2500\n",
    b"2 8=0.000000\n",
    b"2=1\n",
    b"0x9005\n",
    b"\xb0\n",
    b"\xb1\n",
]
PI_GCS = Fuzzed(Rig, REPLIES_TO_OPEN, disarmed=lambda rig: not rig.controller.box.outputs[2].on)


@given(plans(SAMPLES))
def test_fuzz_opening_opens_or_says_why(plan: list[Pieces | None]) -> None:
    opening_opens_or_says_why(PI_GCS, plan)


@given(plans(SAMPLES), st.lists(st.sampled_from(CALLS), min_size=1, max_size=8))
def test_fuzz_every_call_ends_in_time_and_the_stage_can_be_used_again(
    plan: list[Pieces | None], calls: list[Call]
) -> None:
    every_call_ends_in_time_and_the_stage_can_be_used_again(PI_GCS, plan, calls)
