"""Scans that decide after each pass, on the curves of next_pass: the choices of `do`, and the result.

python -m tests.bench.next_pass_policy SCORES.json --scenes 0,1,2 --seeds 0,1,2 adds the missing error models and
volumes to SCORES.json and prints the tables; see next_pass for both.

The error model at the end of a pass is measured from the projections with three noise seeds, in the geometry of the
scan, with only the data that a live reconstruction has. The quality is that of volumes with seed 0; other noise changes
it by some hundredths of a dB. The plan is that of the same scan with simulated devices. A prediction is for the next
pass of the plan, even if another choice was made. It counts as right within 0.3 dB or 30 % of the gain in the curve.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from beamline.plan.choose import ScanTarget, choose, options, remaining_gain
from beamline.plan.passes import Choice, Passes, pass_blocks
from beamline.plan.plan import Block
from beamline.plan.timeline import block_seconds
from beamline.scan.dry_run import DryRun, dry_run
from drivers.base.frame import FrameKind
from recon.base.error_law import ErrorLaw
from tests.bench.next_pass import WISH, ScoreFile, State, fixed, hindsight, whole_plan
from tests.bench.next_pass_devices import config_of
from tests.bench.next_pass_scenes import CRUMBED, DEV, PASS, PASSES, RECIPES

CLOSE_DB, CLOSE_SHARE = 0.3, 0.3


@dataclass(frozen=True)
class Step:
    """The end of a pass: passes so far, their error model, the choice, and the gain in dB of the rest of the plan."""

    state: State
    law: ErrorLaw
    choice: Choice
    remaining: float


@lru_cache(maxsize=1)
def planned(number: int) -> DryRun:
    """The plan of a scene's scan with simulated devices."""
    return dry_run(config_of(number))


def decided(number: int, seed: int, scores: ScoreFile, target: ScanTarget) -> tuple[list[Step], State]:
    """The decisions of `do`, and the state that the scan ends in."""
    plan = planned(number)
    timeline = plan.timeline

    def seconds_of(block: Block) -> float:
        return block_seconds(block, plan.stage, plan.camera, plan.plan.settle)

    blocks = pass_blocks(timeline.views, 0)
    wide = tuple(block for block in timeline.blocks if block.kind is FrameKind.OFFSET_VIEW)
    state, done, to_come, steps = State(1), blocks[:1], blocks[1:], list[Step]()
    while True:
        passes = Passes(done, to_come, () if state.wide else wide, _retakes(number, state))
        if not (passes.to_come or passes.retakes):
            return steps, state._replace(wide=bool(wide))
        law = scores.law(number, seed, state)
        offered, remaining = options(passes, law, timeline, seconds_of), remaining_gain(passes, law)
        choice, _ = choose(offered, target, remaining, 0.0, 0.0)
        steps.append(Step(state, law, choice, remaining.mean))
        match choice:
            case Choice.NEXT:
                done, to_come = (*done, to_come[0]), to_come[1:]
                state = state._replace(passes=state.passes + 1)
            case Choice.AGAIN:
                done, to_come = (*done, done[-1]), to_come[:-1]
                state = state._replace(again=(*state.again, state.passes - 1))
            case Choice.OFFSET:
                state = state._replace(wide=True)
            case Choice.RETAKE:
                state = state._replace(retaken=True)
            case Choice.ENOUGH:
                return steps, state._replace(wide=bool(wide))


def _retakes(number: int, state: State) -> int:
    spoilt = RECIPES[number].crumb and state.passes * PASS > CRUMBED.start and not state.retaken
    return len(CRUMBED) if spoilt else 0


@dataclass(frozen=True)
class Outcome:
    """The result of a scan that decides, compared with fixed plans and with the best choice, known afterwards.

    Attributes:
        ratio: frames, divided by those of the best choice.
        below: dB below the whole plan.
        over_fixed: dB above the fixed plan with as many frames.
        right: for each prediction, whether it was right.
        middle: density in the middle, divided by the true one.
    """

    state: State
    frames: int
    ratio: float
    below: float
    over_fixed: float
    right: tuple[bool, ...]
    middle: float


def outcome(number: int, seed: int, scores: ScoreFile, target: ScanTarget) -> Outcome:
    """Of one scene and noise."""
    steps, state = decided(number, seed, scores, target)
    score, frames = scores.score(number, state), state.frames(number)
    right = []
    for step in steps:
        if step.state.passes + len(step.state.again) < PASSES:
            following = step.state._replace(passes=step.state.passes + 1)
            gain = scores.score(number, following).quality - scores.score(number, step.state).quality
            off = abs(step.law.gain(views=PASS).mean - gain)
            right.append(off <= max(CLOSE_DB, CLOSE_SHARE * abs(gain)))
    return Outcome(
        state,
        frames,
        frames / hindsight(number, scores).frames(number),
        scores.score(number, whole_plan(number)).quality - score.quality,
        score.quality - fixed(number, scores, frames),
        tuple(right),
        score.middle,
    )


def table(scores: ScoreFile, numbers: Sequence[int], seeds: Sequence[int], target: ScanTarget) -> str:
    """Markdown: medians over the seeds for each scene; the last line summarises all scenes."""
    lines = [
        "| scene | ends with | frames | over hindsight | below all, dB | over fixed, dB | predictions | middle |",
        "|---" * 8 + "|",
    ]
    of_all = []
    for number in numbers:
        outcomes = [outcome(number, seed, scores, target) for seed in seeds]
        of_all += outcomes
        right = [was_right for one in outcomes for was_right in one.right]
        median = {
            name: statistics.median(getattr(one, name) for one in outcomes)
            for name in ("frames", "ratio", "below", "over_fixed", "middle")
        }
        states = ", ".join(dict.fromkeys(str(one.state) for one in outcomes))
        lines.append(
            f"| {number} {RECIPES[number]} | {states} | {median['frames']:.0f} | {median['ratio']:.2f} "
            f"| {median['below']:.2f} | {median['over_fixed']:+.2f} | {sum(right)} of {len(right)} "
            f"| {median['middle']:.3f} |"
        )
    right = [was_right for one in of_all for was_right in one.right]
    ratio = statistics.median(one.ratio for one in of_all)
    worst = min(one.over_fixed for one in of_all)
    target_db = target.quality_db or 0.0
    near = f"{sum(one.below <= target_db for one in of_all)} of {len(of_all)} reach {target_db:g}"
    lines.append(f"| all | | | {ratio:.2f} | {near} | {worst:+.2f} at least | {sum(right)} of {len(right)} | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scores", type=Path)
    parser.add_argument("--scenes", default=",".join(map(str, DEV)))
    parser.add_argument("--seeds", default="0,1,2")
    arguments = parser.parse_args()
    numbers, seeds = ([int(word) for word in words.split(",")] for words in (arguments.scenes, arguments.seeds))
    print(table(ScoreFile(arguments.scores), numbers, seeds, ScanTarget(quality_db=WISH)))


if __name__ == "__main__":
    main()
