"""Frames that are lost, ignored or added between trigger and file are named exactly; kept frames have their angle."""

from dataclasses import dataclass
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.text import spans
from beamline.scan.ledger import (
    EXTRA,
    LOOK,
    DeliveredFrame,
    Ledger,
    LedgerEntry,
    Train,
    assign,
    enter,
    settle,
)

PERIOD = 0.12
FIRST = 1_795_152_000.0
OK, LOST, IGNORED = "ok", "lost", "ignored"


@dataclass(frozen=True)
class Sent:
    """A frame as a camera would deliver it, with the trigger that made it (EXTRA: none)."""

    framestamp: int
    time: float
    trigger: int


def camera(
    fates: list[str], jitter: list[float], period: float, extra_after: frozenset[int] = frozenset()
) -> list[Sent]:
    """An independent model of a camera: exposes, counts and loses as `fates` says; extra exposures half a period on."""
    sent, stamp = [], 0
    for i in range(-1, len(fates)):
        if i >= 0 and fates[i] != IGNORED:
            if fates[i] == OK:
                sent.append(Sent(stamp, FIRST + (i + jitter[i]) * period, i))
            stamp += 1
        if i in extra_after:
            sent.append(Sent(stamp, FIRST + (i + 0.5) * period, EXTRA))
            stamp += 1
    return sent


def book(train: Train, sent: list[Sent]) -> tuple[list[LedgerEntry], Ledger]:
    """Frames one after the other, as they come; the last ones when there will be no more."""
    ledger, entries, waiting = Ledger(train), list[LedgerEntry](), list[DeliveredFrame]()
    for frame in sent:
        waiting.append(DeliveredFrame(frame.framestamp, frame.time))
        assert len(waiting) <= LOOK
        while waiting and (entered := enter(ledger, waiting, last=frame is sent[-1])):
            ledger, entry = entered
            entries.append(entry)
            waiting.pop(0)
    assert not waiting
    return entries, settle(ledger)


def angles(n: int) -> np.ndarray:
    return np.deg2rad(np.linspace(0, 180, n, endpoint=False))


@st.composite
def scans(draw: st.DrawFn) -> tuple[list[str], list[float], float]:
    fates = draw(st.lists(st.sampled_from([OK, OK, OK, LOST, IGNORED]), min_size=1, max_size=60))
    jitter = draw(st.lists(st.floats(-0.1, 0.1), min_size=len(fates), max_size=len(fates)))
    longest_gap = 1 + max((len(run) for run in "".join(" " if f == OK else "x" for f in fates).split()), default=0)
    error = draw(st.floats(-0.1, 0.1)) / longest_gap  # of the period that the ledger is told
    return fates, jitter, PERIOD * (1 + min(max(error, -0.03), 0.03))


@given(scans())
def test_any_set_of_lost_and_ignored_triggers_is_reported_exactly(scan: tuple[list[str], list[float], float]) -> None:
    fates, jitter, period = scan
    kept = [i for i, fate in enumerate(fates) if fate == OK]
    # The planned period is a little wrong; the time of trigger 0 is known to a fifth of a period.
    first = FIRST if not kept else FIRST + kept[0] * (period - PERIOD)
    entries, account = book(
        Train(angles(len(fates)), PERIOD, first, tolerance=0.2 * PERIOD), camera(fates, jitter, period)
    )
    assert [e.trigger for e in entries] == kept
    assert [e.angle for e in entries] == [angles(len(fates))[i] for i in kept]
    assert list(account.missing) == [i for i, fate in enumerate(fates) if fate != OK]
    before_last = fates[: kept[-1]] if kept else []
    assert (account.lost, account.ignored) == (before_last.count(LOST), before_last.count(IGNORED))
    assert account.extra == ()
    assert account.possible_shift == 0
    assert (not account.missing) == (len(kept) == len(fates))


@given(scans())
def test_without_a_known_start_a_camera_that_saw_the_first_trigger_is_enough(
    scan: tuple[list[str], list[float], float],
) -> None:
    fates, jitter, period = scan
    fates = ["ok", *fates]
    entries, account = book(Train(angles(len(fates)), PERIOD), camera(fates, [0.0, *jitter], period))
    assert [e.trigger for e in entries] == [i for i, fate in enumerate(fates) if fate == OK]
    assert list(account.missing) == [i for i, fate in enumerate(fates) if fate != OK]
    at_the_end = len(fates) - 1 - entries[-1].trigger
    assert account.possible_shift == at_the_end  # nobody can say at which end they are missing, and the account says so


@given(
    st.lists(st.sampled_from([OK, OK, OK, LOST, IGNORED]), min_size=2, max_size=40),
    st.sets(st.integers(-1, 39), min_size=1, max_size=5),
    st.randoms(use_true_random=False),
)
def test_frames_that_no_trigger_made_are_named_and_cost_no_angle(
    fates: list[str], where: set[int], random: Random
) -> None:
    after = frozenset(i for i in where if i < len(fates))
    jitter = [random.uniform(-0.1, 0.1) for _ in fates]
    sent = camera(fates, jitter, PERIOD, after)
    entries, account = book(Train(angles(len(fates)), PERIOD, FIRST), sent)
    assert [e.trigger for e in entries] == [s.trigger for s in sent]
    assert account.extra == tuple(s.framestamp for s in sent if s.trigger == EXTRA)
    assert list(account.missing) == [i for i, fate in enumerate(fates) if fate != OK]
    last = max((s.trigger for s in sent), default=EXTRA)
    before_last = fates[: max(last, 0)]
    assert (account.lost, account.ignored) == (before_last.count(LOST), before_last.count(IGNORED))
    step = angles(len(fates))[1]
    for frame, entry in zip(sent, entries, strict=True):
        place = (frame.time - FIRST) / PERIOD
        if frame.trigger == EXTRA and 0 < place < len(fates) - 1:
            assert entry.angle == pytest.approx(place * step, abs=0.15 * step)


def test_the_stage_may_turn_a_little_faster_than_planned() -> None:
    n = 400
    fates = [OK] * n
    fates[17] = IGNORED
    fates[300] = LOST
    entries, account = book(Train(angles(n), PERIOD, FIRST), camera(fates, [0.0] * n, PERIOD * 0.95))
    assert account.missing == (17, 300)
    assert [e.trigger for e in entries] == [i for i in range(n) if i not in (17, 300)]


@pytest.mark.parametrize(("tolerance", "shift"), [(0.0, 0), (0.9, 0), (1.1, 1), (5.0, 2)])
def test_a_vague_start_says_how_far_the_angles_may_be_off(tolerance: float, shift: int) -> None:
    fates = [OK, OK, OK, LOST, LOST]
    entries, account = book(Train(angles(5), PERIOD, FIRST, tolerance * PERIOD), camera(fates, [0.0] * 5, PERIOD))
    assert [e.trigger for e in entries] == [0, 1, 2]
    assert account.possible_shift == shift and not account.complete


def test_an_angle_lost_at_the_start_could_be_lost_at_the_end() -> None:
    train = Train(angles(5), PERIOD, FIRST, tolerance=1.5 * PERIOD)
    _, account = book(
        train, [Sent(0, FIRST + 2 * PERIOD, 2), Sent(1, FIRST + 3 * PERIOD, 3), Sent(2, FIRST + 4 * PERIOD, 4)]
    )
    assert account.missing == (0, 1)
    # two triggers later than expected is one more than the start's uncertainty allows
    assert account.possible_shift == 1


@pytest.mark.parametrize(("late", "shift"), [(0, 0), (0.4, 0), (1, 1), (1.4, 1)])
def test_a_pass_cut_short_misses_nothing_after_its_last_frame_and_doubts_a_late_first_one(
    late: float, shift: int
) -> None:
    """Whether the first trigger was ignored cannot be told from their number, only from the first one's time."""
    ledger = Ledger(Train(angles(9), PERIOD, FIRST, tolerance=1.5 * PERIOD))
    for stamp, at in ((0, 0), (2, 2)):
        ledger, entry = assign(ledger, stamp, FIRST + (at + late) * PERIOD)
        assert entry.trigger == at
    account = settle(ledger, cut_short=True)
    assert (account.missing, account.lost, account.ignored, account.extra) == ((1,), 1, 0, ())
    assert account.possible_shift == shift
    assert account.largest_residual == pytest.approx(0, abs=1e-6)


def with_noise(n: int, *at: float, taken: float = 0.0) -> list[Sent]:
    """A camera with all triggers, and noise at these positions in periods; after it no trigger for `taken` periods."""
    moments = [(place, EXTRA) for place in at]
    moments += [(float(i), i) for i in range(n) if not any(0 <= i - place < taken for place in at)]
    return [Sent(stamp, FIRST + place * PERIOD, trigger) for stamp, (place, trigger) in enumerate(sorted(moments))]


@pytest.mark.parametrize("tolerance", [0.0, 0.2, 0.7, 2.5], ids="start known to {} periods".format)
@pytest.mark.parametrize("noise", [(-3.4,), (-0.7,), (-0.6,), (-0.4,), (-0.3,), (-0.15,), (0.2,), (0.4,), (-2.6, -0.3)])
def test_noise_around_the_first_trigger_costs_no_view(tolerance: float, noise: tuple[float, ...]) -> None:
    sent = with_noise(12, *noise)
    entries, account = book(Train(angles(12), PERIOD, FIRST, tolerance * PERIOD), sent)
    assert [entry.trigger for entry in entries] == [frame.trigger for frame in sent]
    assert account.missing == () and len(account.extra) == len(noise)


@given(st.lists(st.integers(1, 28), min_size=1, max_size=4, unique=True), st.floats(0.12, 0.49))
def test_noise_shortly_before_a_trigger_does_not_take_its_place(triggers: list[int], before: float) -> None:
    sent = with_noise(30, *(i - before for i in triggers))
    entries, account = book(Train(angles(30), PERIOD, FIRST), sent)
    assert [entry.trigger for entry in entries] == [frame.trigger for frame in sent]
    assert account.missing == () and account.largest_residual == pytest.approx(0, abs=1e-4)  # 0.12 s of 1.8e9


def test_noise_that_keeps_the_camera_from_its_trigger_says_how_far_the_angle_is_off() -> None:
    entries, account = book(Train(angles(12), PERIOD, FIRST), with_noise(12, 4.7, taken=0.5))
    assert [entry.trigger for entry in entries] == list(range(12))
    assert account.largest_residual == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize(("tolerance", "shift"), [(0.4, 0), (1.2, 1)])
def test_noise_a_whole_period_before_the_first_trigger_is_told_where_the_start_is_vague(
    tolerance: float, shift: int
) -> None:
    """Nothing but the time of the start tells which of thirteen regular frames is none of twelve triggers'."""
    entries, account = book(Train(angles(12), PERIOD, FIRST, tolerance * PERIOD), with_noise(12, -1.0))
    assert sorted(entry.trigger for entry in entries) == [EXTRA, *range(12)]
    assert account.possible_shift == shift
    assert (entries[0].trigger == EXTRA) is (shift == 0)


def test_a_spurious_exposure_that_is_lost_too_is_no_lost_trigger() -> None:
    entries, account = book(
        Train(angles(3), PERIOD, FIRST), [Sent(i, FIRST + t * PERIOD, 0) for i, t in ((0, 0), (2, 1), (3, 2))]
    )
    assert [e.trigger for e in entries] == [0, 1, 2]
    assert (account.lost, account.ignored, account.missing) == (0, 0, ())


def test_a_frame_delivered_twice_is_extra() -> None:
    ledger, _ = assign(Ledger(Train(angles(4), PERIOD, FIRST)), 0, FIRST)
    ledger, entry = assign(ledger, 0, FIRST)
    assert entry.trigger == EXTRA
    ledger, entry = assign(ledger, 1, FIRST + PERIOD)
    assert entry.trigger == 1
    assert settle(ledger).extra == (0,)


@given(st.sets(st.integers(0, 50)))
def test_spans_name_each_index_once(indices: set[int]) -> None:
    named = [
        i
        for group in spans(sorted(indices), limit=99).split(", ")
        if group
        for i in range(int(group.split("-")[0]), int(group.split("-")[-1]) + 1)
    ]
    assert named == sorted(indices)


@pytest.mark.parametrize(("n", "period"), [(0, 1.0), (3, 0.0), (3, float("nan"))])
def test_a_train_without_triggers_or_period_is_refused(n: int, period: float) -> None:
    with pytest.raises(ValueError, match=r"angle|period"):
        Train(angles(n) if n else np.zeros(0), period)
