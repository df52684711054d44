"""PI GCS 2.0 driver: bytes as in a captured dialogue, number formats, windows of trains."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.protocols import TriggerTrain
from drivers.stages.pi_gcs.line import ANY_NUMBER, EVENTS, NUMBER, REFUSALS, advice, is_rounding_of, meaning, plain
from drivers.stages.pi_gcs.settings import PiFirstPulse, is_spent_by, window_of
from tests.drivers.stages.pi_gcs_rig import Rig

# bytes

CAPTURED = {
    "CTO 1 3 0\n", "CTO 1 1 0.1\n", "TRO 1 1\n", "TRO? 1\n", "MOV 1 10.5\n", "SVO 1 1\n", "HLT 1\n", "FRF 1\n",
    "*IDN?\n", "ERR?\n", "\x05", "\x18",
}  # fmt: skip
"""What the vendor's own host library was seen to send for these calls."""


def test_the_bytes_are_those_that_the_vendors_library_sends() -> None:
    rig = Rig(wire={"output": 1})
    stage = rig.open(trigger_line=1)
    stage.arm(TriggerTrain(25, 25, 4))
    stage.start_move(math.radians(10.5), math.radians(20))
    stage.stop()
    stage.abort()
    stage.start_home()
    stage.wait(60.0)
    heard = bytes(rig.heard).decode()
    assert set(re.findall(r"[\x01-\x09\x0b-\x1f]|[^\x00-\x1f]+\n", heard)) >= CAPTURED
    assert "\r" not in heard


# numbers


@given(st.integers(-(10**9), 10**9), st.integers(1000, 10**8))
def test_a_place_in_text_is_its_count_again(counts: int, per_turn: int) -> None:
    text = plain(Fraction(counts) * 360 / per_turn)
    assert re.fullmatch(r"-?\d+(\.\d*[1-9])?", text)
    assert round(float(text) * per_turn / 360) == counts


@given(st.integers(1, 10**5), st.integers(1, 10**5), st.integers(1000, 10**8))
def test_a_step_in_text_misses_no_count_at_the_end_of_a_train(interval: int, n: int, per_turn: int) -> None:
    text = plain(Fraction(interval) * 360 / per_turn)
    assert abs(Fraction(text) * n * per_turn / 360 - interval * n) < Fraction(1, 50)


@given(st.fractions(-(10**6), 10**6))
def test_plain_numbers_are_the_nearest_with_twelve_decimals(value: Fraction) -> None:
    assert abs(Fraction(plain(value)) - value) <= Fraction(1, 2 * 10**12)
    assert Fraction(plain(-value)) == -Fraction(plain(value))
    assert plain(value) != "-0"


@given(
    st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["{:.6f}", "{:g}", "{:.12g}", "{:e}", "{:+.3f}"])
)
def test_every_way_to_write_a_number_is_read(value: float, form: str) -> None:
    """Limits as large as a number can be; places up to a million million, for more nothing can turn."""
    text = form.format(value)
    match = re.fullmatch(ANY_NUMBER, text)
    assert match is not None
    assert float(Fraction(match[1])) == float(text)
    assert abs(value) >= 1e11 or abs(value) < 1e-90 or re.fullmatch(NUMBER, text)


@pytest.mark.parametrize("text", ["", ".", "nan", "inf", "1,5", "1_0", "0x10", "--1", "1.5.2", "1e", "1 2", "1e1000"])
def test_what_is_no_number_is_not_read(text: str) -> None:
    assert re.fullmatch(NUMBER, text) is None
    assert re.fullmatch(ANY_NUMBER, text) is None


@pytest.mark.parametrize(
    ("reply", "sent", "agrees"),
    [
        ("1.950000", "1.95", True), ("0.137329", "0.1373291015625", True), ("0.137330", "0.1373291015625", False),
        ("1e-1", "0.1", True), ("2", "1.95", True), ("1.9", "1.95", True), ("1.8", "1.95", False),
        ("-1.95", "1.95", False),
    ],
)  # fmt: skip
def test_a_read_back_may_be_rounded_and_nothing_else(reply: str, sent: str, agrees: bool) -> None:
    assert is_rounding_of(reply, sent) is agrees


# windows

TRAINS = st.builds(
    TriggerTrain, st.integers(-5000, 5000), st.integers(1, 900).flatmap(lambda i: st.sampled_from([i, -i])),
    st.integers(1, 50),
)  # fmt: skip


@given(TRAINS, st.sampled_from(list(PiFirstPulse)))
def test_a_window_begins_before_and_ends_half_a_step_behind_its_train(train: TriggerTrain, rule: PiFirstPulse) -> None:
    sign = 1 if train.interval > 0 else -1
    if rule is PiFirstPulse.GRID:
        train = TriggerTrain(train.start * train.interval, train.interval, train.n)
    window = window_of(train, rule)
    assert (window.step == abs(train.interval)) or (train.n == 1 and window.step == 2)
    behind = sign * (window.stop - train.end)
    assert behind == window.step / 2
    before = sign * (train.start - window.start)
    shares: dict[PiFirstPulse, Fraction | int] = {
        PiFirstPulse.AT_THRESHOLD: 0,
        PiFirstPulse.STEP_AFTER: 1,
        PiFirstPulse.GRID: Fraction(1, 2),
    }
    assert before == shares[rule] * window.step
    assert window.start != window.stop


@given(TRAINS, st.integers(-60_000, 60_000), st.integers(-60_000, 60_000))
def test_a_train_is_spent_where_a_move_would_repeat_it(train: TriggerTrain, here: int, target: int) -> None:
    """Independent: the counts that the move passes, those of the train among them that lie behind it already."""
    sign = 1 if train.interval > 0 else -1
    passed = [at for at in range(train.start, train.end + sign, train.interval) if sign * (here - at) >= 0]
    if not passed:
        assert not is_spent_by(train, here, target)
    elif len(passed) == train.n or sign * (target - here) < 0:
        assert is_spent_by(train, here, target)
    else:
        assert not is_spent_by(train, here, target)


# errors


def test_every_code_has_words_and_advice_and_is_of_one_kind() -> None:
    assert not REFUSALS.keys() & EVENTS.keys()
    for code in REFUSALS | EVENTS:
        assert f"error {code}, " in meaning(code)
        assert len(advice(code)) > 20
    assert meaning(0) == ""
    assert "4711" in meaning(4711)
    assert "manual" in advice(4711)
