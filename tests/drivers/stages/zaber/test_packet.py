"""Zaber packets on the host: published checksums, and the effect of damaged replies."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.stages.zaber.axis import ENDINGS, FAULTS, Reply, damage, encode, lrc, meaning_of, reply_form
from tests.drivers.zaber_vectors import VECTORS
from tests.simulators.wires.zaber.wire import frame

COMMANDS = [
    ("/1 0 01 trigger 1 when 1 dist 1000:C1", (1, 0, 1, "trigger 1 when 1 dist 1000")),
    ("/1 1 19 move abs 1000:E6", (1, 1, 19, "move abs 1000")),
    ("/1 1 21 home:32", (1, 1, 21, "home")),
    ("/1 1 22 stop:14", (1, 1, 22, "stop")),
    ("/1 1 25:F7", (1, 1, 25, "")),
]
"""As the vendor's library sends them."""


@pytest.mark.parametrize("packet", VECTORS)
def test_checksums_are_the_published_ones(packet: str) -> None:
    body, _, checksum = packet[1:].partition(":")
    assert lrc(body) == checksum


@pytest.mark.parametrize(("packet", "command"), COMMANDS)
def test_commands_are_those_of_the_vendors_library(packet: str, command: tuple[int, int, int, str]) -> None:
    assert encode(*command) == packet


@pytest.mark.parametrize("line", ["@01 1 OK IDLE -- 0:8C", "@01 0 RJ IDLE -- BADCOMMAND:F5", "!01 1 IDLE --:96"])
def test_published_replies_are_sound(line: str) -> None:
    assert damage(line, must_have_checksum=True) == ""


def test_a_missing_checksum_matters_once_it_must_be_there() -> None:
    assert damage("@01 1 OK IDLE -- 0", must_have_checksum=False) == ""
    assert damage("@01 1 OK IDLE -- 0", must_have_checksum=True) != ""
    assert damage("!01 1 IDLE --", must_have_checksum=True) == ""


@given(st.integers(1, 20), st.characters(min_codepoint=32, max_codepoint=126))
def test_any_one_byte_that_changes_is_noticed(at: int, new: str) -> None:
    line = "@01 1 07 OK BUSY WR -1234567:" + lrc("01 1 07 OK BUSY WR -1234567")
    spoilt = line[:at] + new + line[at + 1 :]
    assert (damage(spoilt, must_have_checksum=True) == "") == (spoilt == line)


@given(st.text(max_size=60))
def test_junk_is_judged_without_a_fuss(text: str) -> None:
    for line in (text, "@" + text, "@01 1 07 OK " + text):
        assert isinstance(damage(line, must_have_checksum=True), str)
        match = re.fullmatch(reply_form(1, 1, 7, r"-?\d+"), line)
        assert match is None or Reply.of(match).raw == line


@given(
    st.integers(1, 99), st.integers(0, 9), st.integers(0, 99), st.booleans(), st.sampled_from(["--", "WR", "FS", "NI"])
)
def test_a_reply_that_a_device_frames_is_read_back(
    device: int, axis: int, identity: int, busy: bool, flag: str
) -> None:
    text = f"@{device:02d} {axis} {identity:02d} OK {'BUSY' if busy else 'IDLE'} {flag} -42"
    line = frame(text, checksum=True).decode().removesuffix("\r\n")
    assert damage(line, must_have_checksum=True) == ""
    match = re.fullmatch(reply_form(device, axis, identity, r"-?\d+"), line)
    assert match is not None
    reply = Reply.of(match)
    assert (reply.accepted, reply.busy, reply.flag, reply.data) == (True, busy, flag.strip("-"), "-42")
    assert re.fullmatch(reply_form(device, axis, (identity + 1) % 100, r"-?\d+"), line) is None
    assert re.fullmatch(reply_form(device, axis, identity, "[a-z]+"), line) is None


def test_flags_become_words_and_advice_the_gravest_first() -> None:
    meaning = meaning_of(("FS", "WL", "WR"))
    assert meaning is not None
    assert meaning.text.startswith("stalled and stopped (FS), reached a limit switch")
    assert "blocks the stage" in meaning.advice
    assert meaning_of(("WR", "NR")) is None
    unknown = meaning_of(("FX",))
    assert unknown is not None
    assert "FX" in unknown.text
    assert all(meaning.text and meaning.advice for meaning in (*FAULTS.values(), *ENDINGS.values()))
