"""Jumps: views after the sample moved on its stage are corrected by shifts, or left out, as views held out say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from beamline.core.text import count, frames_text
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ScanPart, Unmoved, ViewMotion
from beamline.projections.selection import Selection, cone_of, geometry_of, rows_of
from beamline.projections.step import StepDone, StepMemory, option
from beamline.projections.usable_views import UsableViews, part_numbers, usable_views
from drivers.base.frame import FrameKind
from recon.base.volume import Grid
from recon.features.jumps import jump_clusters, part_groups, thinned

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.storage.readers.base import ScanSource
    from recon.base.arrays import I64
    from recon.base.geometry import Geometry
    from recon.voxels.displacement import Displacement, Judgement

LARGEST = 0.5  # pixels that nobody sees: a doubled edge as wide as the resolution begins there (see the check `motion`)
ALIKE = 1.5  # times the deviation of the longest part's views: a part that fits has no more
_LEVELS = ((64, 2), (128, 4), (320, 2))  # columns, at most, and volumes of all views
_ROUGH = 2  # levels that tell whether there was a jump
_HELPS = 0.005  # share of the deviation that a jump takes away, or a part may add
_ROWS = 16  # binned rows looked at
_VIEWS = 360  # looked at, and all of parts that have no more than
_SHORT = 40
_COPIES = 28  # float32 copies of the views looked at while they are registered


@dataclass(frozen=True)
class Jumps:
    """How views on either side of a motion alarm are treated.

    Attributes:
        mode: "correct": see `find_jumps`. "ignore": they are used as they are.
    """

    name: ClassVar[str] = "jumps"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase")
    needs_finished: ClassVar[str] = ""
    mode: str = option(
        "--jumps",
        "correct",
        "correct: after the monitor saw the sample jump, correct the views for its shift and turn, or leave them out. "
        "ignore: use them as they are.",
        choices=("correct", "ignore"),
    )

    @property
    def corrects_jumps(self) -> bool:
        """Whether sample jumps are corrected, in a finished scan."""
        return self.mode == "correct"

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=_search_memory(part.source, part.selection) if self.mode == "correct" else 0)

    def place(
        self,
        source: ScanSource,
        selection: Selection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        if stated_poses(source, selection) is not None:  # it states where the sample was
            return Unmoved(usable.frames)
        if self.mode == "correct":
            return find_jumps(source, selection, usable.frames, usable.jumps, axis_col, progress)
        where = frames_text(usable.jumps)
        sentence = f"The monitor saw the sample jump at {where}; --jumps ignore: views are used as they are."
        return SampleJumps(usable.frames, sentence=sentence if usable.jumps.size else "")


@dataclass(frozen=True, eq=False)
class SampleJumps:
    """Sample positions in the views of a scan in which the sample jumped.

    Attributes:
        starts: int64, rows of the file at which a part begins, without the first.
        moves: displacement of each part; empty: none moved.
        frames: int64 [view], the rows that are used.
        sentence: what was done, in a line; empty where there was no jump.
    """

    frames: I64
    starts: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    moves: tuple[Displacement, ...] = ()
    sentence: str = ""

    @property
    def done(self) -> StepDone:
        """What the step did; the volume's file records the jumps, if there were any."""
        return StepDone(self.sentence, {"jumps": self.sentence} if self.sentence else {}, warned=True)

    def corrected(self, geometry: Geometry, view_ids: I64) -> Geometry:
        """The geometry of these rows of the file, with views shifted and turned like the sample."""
        from recon.voxels.displacement import Displacement, displaced

        if all(move == Displacement() for move in self.moves):
            return geometry
        return displaced(geometry, part_numbers(self.starts, view_ids), self.moves)


def find_jumps(
    source: ScanSource,
    selection: Selection,
    frames: I64,
    jumps: I64,
    axis_col: float,
    progress: Callable[[int, int], None] = lambda n, most: None,
) -> SampleJumps:
    """Find the sample position in each part of a scan between jumps, and which views can be used.

    A jump is one where views held out, the same for every guess, are predicted better with a displacement than without.
    A part stays where views held out of the longest part are predicted with it as well as without, and its own views
    about as well. Otherwise it is left out. A jump below half a pixel is none.

    Args:
        frames: rows of the file that are to be used.
        jumps: rows from which on the sample is elsewhere.
        progress: how many guesses of where it moved were made, of at most how many.
    """
    from recon.voxels.displacement import Displacement

    jumps = np.array([row for row in jumps.tolist() if (frames < row).any() and (frames >= row).any()], np.int64)
    if not jumps.size:
        return SampleJumps(frames)
    if cone_of(source, selection) is not None:
        where = frames_text(jumps)
        return SampleJumps(
            frames,
            sentence=f"The sample jumped at {where}. Views of a cone beam are not corrected for that: they are used as "
            "if it had not moved. Choose those of one side with --views.",
        )
    fit = _Fit(source, selection, axis_col, frames, jumps)
    clusters = jump_clusters(fit.sizes)
    apart = part_groups(fit.sizes, clusters)
    if apart.max() < 1:
        return _done(fit, clusters, apart, [Displacement()])
    levels = fit.levels()
    looked = [fit.views(apart, factor, rounds) for factor, rounds in levels[:_ROUGH]]
    best = _needed(fit.sizes, clusters, apart, looked, progress)
    assert best.verdict is not None
    bad = np.flatnonzero(~_good(best.verdict))
    real = sorted(
        {*best.jumps, *(cluster for cluster in clusters if np.isin(apart[[cluster[0], cluster[1] + 1]], bad).any())}
    )
    groups = part_groups(fit.sizes, real)
    spoilt = np.isin(apart, bad)
    moves = [best.moves[max(apart[groups == at])] for at in range(groups.max() + 1)]
    for factor, rounds in levels[_ROUGH:] if len(moves) > 1 else ():
        moves = fit.views(np.where(spoilt, -1, groups), factor, rounds).displacements(moves)
    if not bad.size and fit.largest(moves) < LARGEST:
        return _done(fit, [], part_groups(fit.sizes, []), [Displacement()])
    return _done(fit, real, np.where(spoilt, -1, groups), moves, best.verdict, bool(bad.size))


def _search_memory(source: ScanSource, selection: Selection) -> int:
    """Bytes that `find_jumps` takes at most; 0 if the flags in the file name no jump, and none are made."""
    from beamline.projections.correction import at_once_memory
    from recon.voxels.displacement import SWEEPS
    from recon.voxels.methods import OsSirtTv

    asked = selection.step(Preparation)
    jumps = usable_views(source, asked.uses_flags).jumps
    if cone_of(source, selection) is not None or not (asked.judged or jumps.size):
        return 0
    frames = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    fit = _Fit(source, selection, (source.shape[1] - 1) / 2, frames, jumps)
    n = min(frames.size, _VIEWS + _SHORT * (1 + jumps.size))
    most, looked_at = 0, 0
    for factor, _ in fit.levels():
        band = fit.band(factor)
        views = geometry_of(source, band, fit.axis_col, np.linspace(0, math.pi, n, endpoint=False))
        copy = 4 * n * math.prod(views.detector_shape)
        work = OsSirtTv(iterations=SWEEPS, momentum=True).memory(views, Grid.matching(views), weighted=True)
        looked_at += copy
        most = max(most, at_once_memory(source, band, n), work + _COPIES * copy)
    return looked_at + most


@dataclass(frozen=True, eq=False)
class _Views:
    """Binned pixels of some rows of some views: line integrals, the group that each view belongs to, pixels known."""

    data: NDArray[np.float32]
    geometry: Geometry
    group: I64
    known: NDArray[np.bool_]
    rounds: int

    def displacements(self, start: list[Displacement] | None) -> list[Displacement]:
        from recon.voxels.displacement import displacements

        return displacements(self.data, self.geometry, self.group, self.known, start, self.rounds)


@dataclass(frozen=True)
class _Guess:
    """A trial of where the sample moved: the jumps, its displacement between them, and how well that predicts views."""

    jumps: list[tuple[int, int]]
    moves: list[Displacement]
    verdict: Judgement


def _needed(
    sizes: I64,
    clusters: Sequence[tuple[int, int]],
    apart: I64,
    looked: Sequence[_Views],
    progress: Callable[[int, int], None],
) -> _Guess:
    """The jumps that views held out need to be predicted, the one that helps most first.

    All guesses are judged by the same views, of the groups `apart` of all clusters. A cluster with too few views on one
    side is a jump in any case.
    """
    certain = [cluster for cluster in clusters if min(apart[cluster[0]], apart[cluster[1] + 1]) < 0]
    n_open = len(clusters) - len(certain)
    n_made, most = 0, 1 + n_open * (n_open + 1) // 2

    def guess(jumps: list[tuple[int, int]]) -> _Guess:
        nonlocal n_made
        made, n_made = _guess(sizes, jumps, apart, looked), n_made + 1
        progress(n_made, most)
        return made

    best = guess(certain)
    while len(best.jumps) < len(clusters):
        tried = [guess(sorted([*best.jumps, cluster])) for cluster in clusters if cluster not in best.jumps]
        better = min(tried, key=lambda guess: guess.verdict.overall)
        if not better.verdict.overall < (1 - _HELPS) * best.verdict.overall:
            break
        best = better
    return best


def _guess(sizes: I64, jumps: list[tuple[int, int]], apart: I64, looked: Sequence[_Views]) -> _Guess:
    """Where the sample was if it moved in these clusters of jumps."""
    from recon.voxels.displacement import judge

    joined = part_groups(sizes, jumps)
    group = np.array([joined[apart == at][0] for at in range(apart.max() + 1)])
    moves: list[Displacement] | None = None
    for views in looked:
        moves = replace(views, group=group[views.group]).displacements(moves)
    assert moves is not None
    each = [moves[at] for at in group]
    views = looked[-1]
    return _Guess(jumps, each, judge(views.data, views.geometry, views.group, views.known, each))


def _good(verdict: Judgement) -> NDArray[np.bool_]:
    """[group] those that can be used with the longest one, whose own deviation is the one that is compared with."""
    better = verdict.together <= (1 + _HELPS) * verdict.alone
    good = np.array([better and deviation <= ALIKE * verdict.together for deviation in verdict.others])
    good[verdict.longest] = True
    return good


@dataclass(frozen=True, eq=False)
class _Fit:
    """What displacements of groups of parts of a scan are fitted to: a band of its rows, from coarse to fine pixels."""

    source: ScanSource
    selection: Selection
    axis_col: float
    frames: I64
    jumps: I64

    @property
    def sizes(self) -> I64:
        """[part] number of views."""
        return np.bincount(part_numbers(self.jumps, self.frames), minlength=self.jumps.size + 1).astype(np.int64)

    @property
    def geometry(self) -> Geometry:
        return geometry_of(self.source, self.selection, self.axis_col, np.zeros(1))

    def largest(self, moves: Sequence[Displacement]) -> float:
        """Pixels, binned as for the volume, by which the sample moves at most."""
        return max(move.farthest(self.geometry.reach) for move in moves) / self.geometry.pixel_pitch

    def levels(self) -> list[tuple[int, int]]:
        """Binning, and volumes of all views."""
        width, steps = self.source.shape[1] // self.selection.binning, dict[int, int]()
        for cols, rounds in _LEVELS:
            factor = max(1, math.ceil(width / cols))
            steps[factor] = max(rounds, steps.get(factor, 0))
        return list(steps.items())

    def views(self, groups: I64, factor: int, rounds: int) -> _Views:
        """Views of each group of parts; those of parts in no group (-1) are not among them."""
        from beamline.projections.correction import ScanCorrection
        from recon.base.masks import areas

        group = groups[part_numbers(self.jumps, self.frames)]
        frames, group = self.frames[group >= 0], group[group >= 0]
        band = self.band(factor)
        views = ScanCorrection(self.source, band, lambda _: None).at_once(frames[thinned(group, _VIEWS, _SHORT)])
        kept = group[np.searchsorted(frames, views.view_ids)]
        geometry = geometry_of(self.source, band, self.axis_col, self.source.angles[views.view_ids])
        return _Views(views.data, geometry, kept, ~areas(views.masked), rounds)

    def band(self, factor: int) -> Selection:
        """Binned pixels, and rows around the middle of those that are used, also outside them."""
        binning = self.selection.binning * factor
        used, height = rows_of(self.source, self.selection), self.source.shape[0]
        n = min(_ROWS * binning, height)
        first = min(max((used.start + used.stop - n) // 2, 0), height - n)
        binning = min(binning, n)
        return replace(self.selection, rows=(first, first + n), binning=binning)


def _done(
    fit: _Fit,
    real: Sequence[tuple[int, int]],
    groups: I64,
    moves: Sequence[Displacement],
    verdict: Judgement | None = None,
    unlike: bool = False,
) -> SampleJumps:
    """The views that are used, where the sample is in them, and what was done in a line.

    Args:
        real: clusters of jumps in which the sample moved.
        groups: [part] -1: left out, because no displacement makes it fit (`unlike`) or it has too few views.
    """
    from recon.voxels.displacement import Displacement

    part = part_numbers(fit.jumps, fit.frames)
    frames = fit.frames[groups[part] >= 0]
    part_moves = tuple(moves[at] if at >= 0 else Displacement() for at in groups)
    lost, pitch, text = fit.frames.size - frames.size, fit.geometry.pixel_pitch, list[str]()
    seen = np.array([i for first, last in real for i in range(first, last + 1)], np.int64)
    if seen.size:
        text.append(f"The sample jumped at {frames_text(fit.jumps[seen])}.")
    for at, m in enumerate(moves):
        n = int((groups[part] == at).sum())
        if n and m != Displacement():
            x, y, z = (f"{mm / pitch:+.1f}" for mm in (m.x, m.y, m.z))
            text.append(
                f"{count(n, 'view')} {'is' if n == 1 else 'are'} corrected by shifts: the sample lies {x}, {y}, {z} px "
                f"(x, y, z in its own frame) elsewhere than in the others, turned by {math.degrees(m.turn):+.2f}°."
            )
    if lost:
        why = "no shift and turn of the sample makes them fit the others" if unlike else "too few for a fit"
        text.append(f"{count(lost, 'view')} {'is' if lost == 1 else 'are'} left out: {why}.")
    if verdict is not None:
        text.append(
            f"Views held out of the longest part deviate by {verdict.together:.3g} with the others corrected, by "
            f"{verdict.alone:.3g} without them."
        )
    none = np.setdiff1d(np.arange(fit.jumps.size), seen)
    if none.size:
        text.append(
            f"After the alarm of motion at {frames_text(fit.jumps[none])} the other views show nothing (less than "
            f"{LARGEST:g} px): views on both sides are used as they are."
        )
    return SampleJumps(frames, fit.jumps, part_moves, " ".join(text))
