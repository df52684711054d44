"""Need: time, memory and disk space of a piece of work, as each dry run states them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Need:
    """Upper bounds of what a piece of work takes.

    Attributes:
        memory: bytes; None: not known.
        seconds: None: not known before it is tried.
        least_seconds: where the data choose what takes least; otherwise `seconds`.
        output: bytes of the result.
        scratch: bytes on its disk while it works, beside the result.
    """

    memory: int | None = None
    seconds: float | None = None
    least_seconds: float | None = None
    output: int = 0
    scratch: int = 0

    @property
    def disk(self) -> int:
        """Peak bytes on the disk of the output while the work runs."""
        return self.output + self.scratch

    @staticmethod
    def in_turn(needs: Iterable[Need]) -> Need:
        """The need of several works in turn: the largest memory and scratch space, and the sum of known seconds."""
        each = list(needs)
        return Need(
            memory=max((need.memory or 0 for need in each), default=0),
            seconds=sum(need.seconds or 0.0 for need in each),
            least_seconds=sum(need.least_seconds or 0.0 for need in each),
            output=sum(need.output for need in each),
            scratch=max((need.scratch for need in each), default=0),
        )
