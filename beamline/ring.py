"""Ring: a bounded hand-over from one producer to several consumers, each with its own policy for falling behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from enum import StrEnum
from typing import Generic, TypeVar

T = TypeVar("T")


class Policy(StrEnum):
    """What happens when a consumer is slower than the producer."""

    BLOCK = "block"  # the producer waits: nothing is lost (the file writer)
    NEWEST = "newest"  # the consumer jumps to the newest item and counts what it passed over (a progress display)
    DROP = "drop"  # items in order; the oldest are overwritten and counted (a live view that wants most of them)


class ConsumerFailed(Exception):  # noqa: N818 - it says whose failure it is
    """A consumer that must not lose anything has failed; its exception is the cause."""


class ConsumerStalled(Exception):  # noqa: N818
    """A consumer that must not lose anything has not taken an item for too long."""


class Ring(Generic[T]):
    """`capacity` slots, allocated once. One thread puts, each reader belongs to one thread.

    Items are numbered from 0 and item i lies in slot i % capacity, so the ring holds the last `capacity` items and
    never more: what waits in memory is bounded whatever the consumers do.

    Raises:
        ValueError: a capacity below 1.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"a ring needs at least one slot, got {capacity}")
        self._slots: list[T | None] = [None] * capacity
        self._changed = threading.Condition()
        self._count = 0  # items put so far
        self._closed = False
        self._readers: list[Reader[T]] = []

    @property
    def capacity(self) -> int:
        return len(self._slots)

    def reader(self, policy: Policy) -> Reader[T]:
        """A new consumer. It sees the items put from now on."""
        with self._changed:
            reader = Reader(self, policy, self._count)
            self._readers.append(reader)
            return reader

    def put(self, item: T, timeout: float | None = None) -> None:
        """Hand `item` over, waiting while a BLOCK reader has all slots still to take.

        Args:
            timeout: real seconds to wait for room; None waits for ever.

        Raises:
            ConsumerFailed: a BLOCK reader has failed; the item was not put.
            ConsumerStalled: no room within `timeout`; the item was not put.
            ValueError: the ring is closed.
        """
        with self._changed:
            room = self._changed.wait_for(lambda: self._failure() is not None or self._has_room(), timeout)
            if self._closed:
                raise ValueError("the ring is closed; nothing can be put any more")
            failure = self._failure()
            if failure is not None:
                raise ConsumerFailed(str(failure)) from failure
            if not room:
                raise ConsumerStalled(f"no item was taken for {timeout:g} s while all {self.capacity} slots were full")
            self._slots[self._count % self.capacity] = item
            self._count += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Nothing more will come. Readers take what is there, then end. May be called twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _has_room(self) -> bool:
        return all(self._count - r.position < self.capacity for r in self._readers if r.policy is Policy.BLOCK)

    def _failure(self) -> BaseException | None:
        return next((r.failure for r in self._readers if r.policy is Policy.BLOCK and r.failure is not None), None)

    def _take(self, reader: Reader[T], timeout: float | None) -> T | None:
        with self._changed:
            self._changed.wait_for(lambda: self._count > reader.position or self._closed, timeout)
            if self._count == reader.position:
                return None
            oldest = self._count - 1 if reader.policy is Policy.NEWEST else max(0, self._count - self.capacity)
            if oldest > reader.position:
                reader.dropped += oldest - reader.position
                reader.position = oldest
            item = self._slots[reader.position % self.capacity]
            reader.position += 1
            self._changed.notify_all()
            return item

    def _fail(self, reader: Reader[T], failure: BaseException) -> None:
        with self._changed:
            reader.failure = failure
            self._changed.notify_all()


class Reader(Generic[T]):
    """One consumer's place in the ring; made by Ring.reader. Iterating ends when the ring is closed and drained.

    Attributes:
        position: number of the next item.
        dropped: items that this reader will never see (always 0 for BLOCK).
        failure: why it gave up, None while it works.
    """

    def __init__(self, ring: Ring[T], policy: Policy, position: int) -> None:
        self._ring = ring
        self.policy = policy
        self.position = position
        self.dropped = 0
        self.failure: BaseException | None = None

    def take(self, timeout: float | None = None) -> T | None:
        """The next item by the reader's policy; None when the ring is closed and drained, or after `timeout` s."""
        return self._ring._take(self, timeout)

    def fail(self, failure: BaseException) -> None:
        """Give up. The producer of a BLOCK reader learns it from its next (or present) put; others go on unheeded."""
        self._ring._fail(self, failure)

    def __iter__(self) -> Iterator[T]:
        while (item := self.take()) is not None:
            yield item
