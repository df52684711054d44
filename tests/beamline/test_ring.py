"""The ring loses nothing for a blocking consumer and counts every loss of the others, whatever the interleaving."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.ring import ConsumerFailed, ConsumerStalled, Policy, Ring

# A script of one thread that plays producer and consumer by turns: each letter is one step.
steps = st.lists(st.sampled_from(["put", "take"]), max_size=60)


@given(st.integers(1, 5), steps, st.sampled_from([Policy.NEWEST, Policy.DROP]))
def test_lossy_readers_count_exactly_what_they_did_not_see(capacity: int, script: list[str], policy: Policy) -> None:
    ring = Ring[int](capacity)
    reader = ring.reader(policy)
    put, seen = 0, []
    for step in [*script, "close"]:
        if step == "put":
            ring.put(put)
            put += 1
        elif step == "take":
            before, newest = reader.position, put - 1
            item = reader.take(timeout=0)
            if before == put:
                assert item is None
            elif policy is Policy.NEWEST:
                assert item == newest
            else:
                assert item == max(before, put - capacity)
            seen += [] if item is None else [item]
        else:
            ring.close()
            seen += list(reader)
    assert seen == sorted(set(seen))
    assert len(seen) + reader.dropped == put
    if put:
        assert seen[-1] == put - 1


@given(st.integers(1, 5), steps)
def test_a_blocking_reader_sees_all_in_order_and_bounds_the_producer(capacity: int, script: list[str]) -> None:
    ring = Ring[int](capacity)
    reader = ring.reader(Policy.BLOCK)
    put, seen = 0, []
    for step in script:
        if step == "put":
            if put - len(seen) == capacity:
                with pytest.raises(ConsumerStalled, match=f"{capacity} slots"):
                    ring.put(put, timeout=0)
            else:
                ring.put(put, timeout=0)
                put += 1
        else:
            item = reader.take(timeout=0)
            seen += [] if item is None else [item]
    ring.close()
    seen += list(reader)
    assert seen == list(range(put))
    assert reader.dropped == 0


@settings(max_examples=15)
@given(st.integers(1, 4), st.integers(0, 200))
def test_threads_blocking_readers_lose_nothing(capacity: int, n: int) -> None:
    ring = Ring[int](capacity)
    blocking = [ring.reader(Policy.BLOCK) for _ in range(2)]
    lossy = [ring.reader(Policy.NEWEST), ring.reader(Policy.DROP)]
    seen: list[list[int]] = [[] for _ in range(4)]
    threads = [
        threading.Thread(target=lambda r=reader, s=items: s.extend(r))
        for reader, items in zip([*blocking, *lossy], seen, strict=True)
    ]
    for thread in threads:
        thread.start()
    for i in range(n):
        ring.put(i)
    ring.close()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert seen[0] == seen[1] == list(range(n))
    for reader, items in zip(lossy, seen[2:], strict=True):
        assert items == sorted(set(items))
        assert len(items) + reader.dropped == n


def test_readers_are_independent() -> None:
    ring = Ring[int](2)
    slow, newest = ring.reader(Policy.DROP), ring.reader(Policy.NEWEST)
    for i in range(5):
        ring.put(i)
    late = ring.reader(Policy.BLOCK)
    assert (slow.take(0), slow.dropped) == (3, 3)
    assert (newest.take(0), newest.dropped) == (4, 4)
    assert late.take(0) is None
    ring.put(5)
    assert late.take(0) == 5


def test_a_failed_writer_is_heard_by_a_waiting_producer() -> None:
    ring = Ring[int](1)
    reader = ring.reader(Policy.BLOCK)
    ring.put(0)
    caught: list[BaseException] = []

    def produce() -> None:
        try:
            ring.put(1)
        except ConsumerFailed as error:
            caught.append(error)

    producer = threading.Thread(target=produce)
    producer.start()
    reader.fail(OSError(28, "No space left on device"))
    producer.join(30)
    assert len(caught) == 1
    assert "No space left" in str(caught[0])
    assert isinstance(caught[0].__cause__, OSError)
    with pytest.raises(ConsumerFailed):
        ring.put(2)


def test_a_failed_display_stops_nobody() -> None:
    ring = Ring[int](1)
    ring.reader(Policy.DROP).fail(RuntimeError("window closed"))
    for i in range(3):
        ring.put(i, timeout=0)


def test_closing() -> None:
    ring = Ring[int](2)
    reader = ring.reader(Policy.BLOCK)
    ring.put(7)
    ring.close()
    ring.close()
    with pytest.raises(ValueError, match="closed"):
        ring.put(8)
    assert list(reader) == [7]
    assert reader.take() is None


def test_an_empty_ring_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one slot"):
        Ring[int](0)
