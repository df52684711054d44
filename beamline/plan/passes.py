"""Passes: parts of the projections of a scan, and the choices of what to measure after each pass."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import accumulate, pairwise
from typing import Any

from beamline.plan.plan import Block


class Choice(StrEnum):
    """A choice of what is measured next."""

    NEXT = "next"  # the next pass of the plan
    AGAIN = "again"  # the angles of the last pass once more, in place of the last pass of the plan
    OFFSET = "offset"  # the laterally offset projections of the plan, now
    RETAKE = "retake"  # projections that were flagged or gave no frame, now
    # no further pass; the laterally offset projections of the plan are still taken, because they determine the density
    ENOUGH = "enough"

    @classmethod
    def _missing_(cls, value: object) -> Choice | None:
        """Name of the offset projections in files of earlier versions: `wide`."""
        return cls.OFFSET if value == "wide" else None


@dataclass(frozen=True, eq=False)
class Passes:
    """The state of a scan at the end of a pass.

    Attributes:
        done: passes so far, oldest first; a pass that was taken again is listed twice.
        to_come: passes of the plan that are not taken yet.
        offset: blocks of offset projections that are not taken yet.
        retakes: number of projections that could be taken again now.
    """

    done: tuple[Block, ...]
    to_come: tuple[Block, ...]
    offset: tuple[Block, ...] = ()
    retakes: int = 0

    @property
    def n_frames(self) -> int:
        """Number of frames of projections so far (`ScanPlan.frames_per_view` for each projection)."""
        return sum(block.n_to_take for block in self.done)

    @property
    def n_planned(self) -> int:
        """Number of frames of projections, so far and to come, without those that are taken again."""
        return self.n_frames + sum(block.n_to_take for block in self.to_come)

    @property
    def may_repeat(self) -> bool:
        """Whether the last pass can be taken again: only if a pass of at least the same length is still to come."""
        return bool(self.to_come) and self.done[-1].n_to_take <= self.to_come[-1].n_to_take

    def after(self, choice: Choice) -> Passes:
        """The state of the scan after this choice was carried out. If the last pass cannot be taken again, AGAIN means
        NEXT."""
        match choice:
            case Choice.AGAIN if self.may_repeat:
                return replace(self, done=(*self.done, self.done[-1]), to_come=self.to_come[:-1])
            case Choice.NEXT | Choice.AGAIN:
                return replace(self, done=(*self.done, *self.to_come[:1]), to_come=self.to_come[1:])
            case Choice.OFFSET:
                return replace(self, offset=())
            case Choice.ENOUGH:
                return replace(self, to_come=())
        return self  # projections that are taken again do not belong to a pass


def ended_by(decisions: Iterable[Mapping[str, Any]]) -> str:
    """A sentence on who ended a scan before the end of its plan, and why; "" if nobody ended it.

    Args:
        decisions: values of the events `next_chosen`, oldest first.
    """
    last = next((each for each in decisions if each.get("choice") == Choice.ENOUGH), {})
    after, by, reason, dropped = (last.get(name) for name in ("passes", "by", "reason", "dropped"))
    chosen = f" by the {by}" if by else ""
    chosen += (
        f": {reason}".rstrip(".") if reason and by != "operator" else ""
    )  # if the operator decided, the reason only repeats this
    dropped_text = f" {dropped} planned frames were not taken." if dropped else ""
    return (
        f"The scan ended after pass {after or last.get('number')}, because `enough` was chosen{chosen}.{dropped_text}"
        if last
        else ""
    )


def triggers_to_take(*blocks: Block) -> frozenset[int]:
    """Triggers (counted within a block) of the frames that are taken in these parts of the block."""
    return frozenset(i for block in blocks for i in range(block.n) if i not in block.stored)


def passes_at_start(views: Block, size: int, choices: Iterable[str], offset: Iterable[Block] = ()) -> Passes:
    """The passes of a scan at the end of its first pass. With choices: at the end of the pass that the scan resumes
    after these choices.

    The passes are those of the whole plan, even if earlier files contain some of their projections.

    Args:
        size: number of frames of a pass, as for `pass_blocks`.
    """
    passes = Passes((), pass_blocks(replace(views, stored=frozenset()), size), (*offset,))
    for choice in (Choice.NEXT, *choices):
        passes = passes.after(Choice(choice))
    return passes


def pass_blocks(views: Block, size: int) -> tuple[Block, ...]:
    """The passes of a block of projections: one pass for each train; in a step scan, passes of `size` frames (0: all
    frames).

    Each pass is the whole block, with the projections of other passes marked as stored. A pass without a projection to
    take is left out.
    """
    size = size or views.n
    sizes = [train.n for train in views.trains] or [size] * -(-views.n // size)
    spans = pairwise(accumulate(sizes, initial=0))
    blocks = (replace(views, stored=views.stored.union(range(first), range(end, views.n))) for first, end in spans)
    return tuple(block for block in blocks if block.n_to_take)
