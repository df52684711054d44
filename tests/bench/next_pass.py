"""The next pass: the gain of each pass, and the fewest frames of the best choice, known afterwards.

python -m tests.bench.next_pass SCORES.json --scenes 0,1,2 adds the missing volumes to SCORES.json and prints a table.
Several calls may add to one file at the same time.

Scenes: see tests.bench.next_pass_scenes. A state of a scan is the passes it has, including passes taken twice,
    laterally offset projections and repeated projections. Its quality is that of the volume of the default method from
    these projections, with the sample diameter from the configuration if the sample is wider than the field: PSNR in dB
    within 0.95 of the field's circle, relative to the largest density, with values clipped at 0. Middle: mean density
    within 0.3 of the field, divided by the true one.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import inspect
import json
import math
import sys
import time
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.error_law import ErrorLaw
from recon.base.geometry import Geometry
from recon.base.method import DataUse
from recon.methods import DEFAULT
from recon.voxels.measured_law import measured_law
from tests.bench.next_pass_scenes import COLS, CRUMBED, DEV, PASS, PASSES, RECIPES, VIEWS, noisy, open_beam, scene_of

F32 = NDArray[np.float32]
VERSION = 1
"""Version of scenes and figures; scores of different versions must not be in the same table."""
SEEN, MIDDLE, WISH = 0.95, 0.3, 1.0
"""Shares of the field's radius: evaluated region, and middle; dB that may be missing."""


class State(NamedTuple):
    """The measured part of the plan: `passes` in order, those of `again` a second time, and further projections."""

    passes: int
    again: tuple[int, ...] = ()
    wide: bool = False
    retaken: bool = False

    def __str__(self) -> str:
        again = "".join(f"+{repeated}" for repeated in self.again)
        return f"{self.passes}{again}{'w' if self.wide else ''}{'r' if self.retaken else ''}"

    def frames(self, number: int) -> int:
        """Number of exposures of the sample."""
        wide = scene_of(number).geometry.n_views - VIEWS if self.wide else 0
        return (self.passes + len(self.again)) * PASS + wide + (len(CRUMBED) if self.retaken else 0)


class Score(NamedTuple):
    """Score of a volume: dB, density of the middle divided by the true one, and CPU seconds."""

    quality: float
    middle: float
    seconds: float


def whole_plan(number: int) -> State:
    """The state after the whole plan of a scene."""
    recipe = RECIPES[number]
    return State(PASSES, wide=recipe.over > 1, retaken=recipe.crumb)


def views_of(number: int, seed: int, state: State) -> tuple[F32, Geometry]:
    """Line integrals and geometry of the projections of a state, in order, without those that a particle spoils."""
    scene, n_planned = _scene(number), state.passes * PASS
    spoilt = np.zeros(scene.geometry.n_views, np.bool_)
    if RECIPES[number].crumb:
        spoilt[CRUMBED.start : CRUMBED.stop] = True
    parts = [(0, np.flatnonzero(~spoilt[:n_planned]))]  # measurement, and numbers of its projections
    for k, repeated in enumerate(state.again):
        take = 1 + state.again[:k].count(repeated)
        parts.append((take, np.arange(repeated * PASS, (repeated + 1) * PASS)))
    if state.retaken:
        parts.append((1, np.flatnonzero(spoilt[:n_planned])))
    if state.wide:
        parts.append((0, np.arange(VIEWS, spoilt.size)))
    views = np.concatenate([_noisy(number, seed, take)[numbers] for take, numbers in parts])
    return views, scene.geometry.select(np.concatenate([numbers for _, numbers in parts]))


_scene = lru_cache(maxsize=2)(scene_of)


@lru_cache(maxsize=4)
def _noisy(number: int, seed: int, take: int) -> F32:
    return noisy(number, _scene(number), seed, take)


def use_of(number: int) -> DataUse:
    """The radius of the sample, as its stated diameter gives it."""
    over = RECIPES[number].over
    return DataUse(sample_radius=COLS / 2 * over if over > 1 else 0.0)


def judged(volume: F32, truth: F32) -> tuple[float, float]:
    """dB, and the density of the middle divided by the true one."""
    x = np.arange(truth.shape[2]) - (truth.shape[2] - 1) / 2
    away = np.hypot(x[:, None], x) / (truth.shape[2] / 2)
    error = np.mean(np.square(np.maximum(volume, 0) - truth, dtype=np.float64)[:, away < SEEN])
    middle = away < MIDDLE
    return 10 * math.log10(float(truth.max()) ** 2 / error), float(volume[:, middle].mean() / truth[:, middle].mean())


def measured(number: int, seed: int, state: State, method: str) -> Score:
    """The score of a state's volume."""
    views, geometry = views_of(number, seed, state)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        volume = recon.reconstruct(views, geometry, method, use=use_of(number)).volume.data
    return Score(*judged(volume, _scene(number).truth), time.process_time() - begin)


class Law(NamedTuple):
    """The values of an `ErrorLaw`, the gain of the last pass in dB according to it, and CPU seconds."""

    n_views: int
    exponent: float
    exponent_error: float
    noise: float
    offset: float
    gained: float | None
    seconds: float


def law_of(number: int, seed: int, state: State) -> Law:
    """The error model at the end of a pass, from the projections that a live reconstruction has then."""
    views, geometry = views_of(number, seed, state)
    earlier = (views_of(number, seed, State(passes))[0] for passes in range(1, state.passes))
    sizes = [*map(len, earlier), len(views)]
    begin = time.process_time()
    law, gained = measured_law(views, geometry, sizes, np.random.default_rng(seed), open_beam(number, seed))
    seconds = time.process_time() - begin
    return Law(law.n_views, law.exponent, law.exponent_error, law.noise, law.offset, gained, seconds)


@lru_cache(maxsize=1)
def _law_code() -> str:
    return hashlib.sha256(inspect.getsource(inspect.getmodule(measured_law) or measured_law).encode()).hexdigest()[:8]


class ScoreFile:
    """Scores and error models in a file to which several processes may add."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scores, self.laws = self._read()

    def _read(self) -> tuple[dict[str, Score], dict[str, Law]]:
        """Raises ValueError: the file was not written by this version of the bench, or is damaged."""
        if not self.path.exists():
            return {}, {}
        try:
            document = json.loads(self.path.read_text(encoding="utf-8"))
            version, scores = document["version"], {key: Score(*row) for key, row in document["next_pass"].items()}
            laws = {key: Law(*row) for key, row in document.get("laws", {}).items()}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{self.path} does not hold scores of next_pass ({error!r}); give another file") from error
        if version != VERSION:
            raise ValueError(f"{self.path} has scores of version {version}, and these are {VERSION}; give another file")
        return scores, laws

    def _add(self, scores: dict[str, Score], laws: dict[str, Law]) -> None:
        """Add to the present content of the file."""
        with self.path.with_suffix(".lock").open("w", encoding="ascii") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            before = self._read()
            self.scores, self.laws = before[0] | scores, before[1] | laws
            document = {"version": VERSION, "next_pass": self.scores, "laws": self.laws}
            part = self.path.with_suffix(".part")
            part.write_text(json.dumps(document, indent=0), encoding="utf-8")
            part.replace(self.path)

    def score(self, number: int, state: State, seed: int = 0, method: str = DEFAULT) -> Score:
        """The score in the file, or a new one."""
        key = f"{number}|{seed}|{method}|{state}"
        if key not in self.scores:
            score = measured(number, seed, state, method)
            print(key, *(round(value, 3) for value in score), file=sys.stderr, flush=True)
            self._add({key: score}, {})
        return self.scores[key]

    def has(self, number: int, state: State) -> bool:
        """Whether the file has the score of a state."""
        return f"{number}|0|{DEFAULT}|{state}" in self.scores

    def law(self, number: int, seed: int, state: State) -> ErrorLaw:
        """The error model in the file, or a new one; the key contains a checksum of the code that measures it."""
        key = f"{number}|{seed}|{_law_code()}|{state}"
        if key not in self.laws:
            law = law_of(number, seed, state)
            print(key, *law, file=sys.stderr, flush=True)
            self._add({}, {key: law})
        return ErrorLaw(*self.laws[key][:5])


def hindsight(number: int, scores: ScoreFile, below: float = WISH) -> State:
    """The state with the fewest frames whose quality is at most `below` dB lower than that of the whole plan.

    Each pass is assumed to improve the volume, so that few states are examined. States with passes taken twice count if
    the file contains them.
    """
    whole = whole_plan(number)
    least = scores.score(number, whole).quality - below

    def fewest(state: State) -> State:
        too_few, enough = 0, PASSES
        while enough - too_few > 1:
            passes = (too_few + enough + 1) // 2
            reached = scores.score(number, _with(state, passes)).quality >= least
            too_few, enough = (too_few, passes) if reached else (passes, enough)
        return _with(state, enough)

    best = fewest(whole)
    plain = State(best.passes) if whole.wide else fewest(State(PASSES))
    twice = [state for state in (State(1, (0,)), State(2, (1,))) if scores.has(number, state)]
    reached = [state for state in (plain, *twice) if scores.score(number, state).quality >= least]
    return min((best, *reached), key=lambda state: state.frames(number))


def _with(state: State, passes: int) -> State:
    """The state with this number of passes; before the particle appears, nothing is repeated."""
    return state._replace(passes=passes, retaken=state.retaken and passes * PASS > CRUMBED.start)


def fixed(number: int, scores: ScoreFile, frames: int) -> float:
    """dB of the fixed plan with this number of frames (interpolated); offset and repeated projections come last."""
    whole = whole_plan(number)
    if frames >= VIEWS:
        return scores.score(number, whole if frames >= whole.frames(number) else State(PASSES)).quality
    low = max(1, frames // PASS)
    share = frames / PASS - low
    below = scores.score(number, State(low)).quality
    return below + share * (scores.score(number, State(low + 1)).quality - below) if share else below


def table(scores: ScoreFile, numbers: Sequence[int]) -> str:
    """Markdown: dB by passes, the fewest frames known afterwards, and the density of the middle with the whole plan."""
    heads = [f"{PASS * passes}" for passes in range(1, PASSES + 1)]
    lines = ["| scene | " + " | ".join(heads) + " | whole plan | hindsight | middle |", "|---" * (len(heads) + 4) + "|"]
    for number in numbers:
        whole, best = whole_plan(number), hindsight(number, scores)
        states = [State(passes) for passes in range(1, PASSES + 1)]
        shown = [f"{scores.score(number, state).quality:.2f}" if scores.has(number, state) else "" for state in states]
        score = scores.score(number, whole)
        shown += [f"{score.quality:.2f} ({whole.frames(number)})", f"{best.frames(number)} ({best})"]
        lines.append(f"| {number} {RECIPES[number]} | " + " | ".join([*shown, f"{score.middle:.3f}"]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scores", type=Path)
    parser.add_argument("--scenes", default=",".join(map(str, DEV)))
    arguments = parser.parse_args()
    print(table(ScoreFile(arguments.scores), [int(number) for number in arguments.scenes.split(",")]))


if __name__ == "__main__":
    main()
