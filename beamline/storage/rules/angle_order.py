"""The order of angles: views that are stated side by side look alike, and no others do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from beamline.storage.readers.base import ScanSource
from beamline.storage.rules import Finding
from beamline.storage.rules.angles import OTHER, PAIRS, UNLIKE, CoarseViews, angles_seen, coarse_views
from beamline.storage.rules.references import VIEWS
from recon.base.views import spread

_FAR, _NEXT = 4.0, 1.5  # steps from which two views are stated to be apart, and up to which side by side
_SINGLE = 0.1  # of the views: so few wrong angles are named one by one
_AROUND, _RETRACED = 3, 1.5  # pairs about such frames; times a step: symmetric samples 0.1 to 1.2, two sides 1.75 to 3
_MIRRORED = 0.5  # of 1: how alike sums of directions are, 0 where they spread evenly, as of frames taken in passes
_MOST = 0.75  # of some views: as many look like others that are far from them, if the frames were in another order
_STANDS, _TURNED = 3, 2.0  # frames of one angle; times as different from the first: 1 at rest, 4 after two steps
_EQUAL = 1e-6  # 1 minus the correlation of equal frames, which rounding makes a little more or less than 0

RULE = "angle-order"


def angles_shown(source: ScanSource) -> Iterator[Finding]:
    """Views show the turns, and the order of angles, that the file states."""
    if (seen := coarse_views(source)) is not None:
        yield from angles_stand(seen)
        yield from angles_seen(seen)
        yield from angles_in_order(seen)


def angles_stand(seen: CoarseViews) -> Iterator[Finding]:
    """Frames in a row that are stated at one angle look alike, as those that are averaged do.

    Where the stage turns on, the last differs from the first by the square of the turn, more than neighbours do.
    """
    starts = np.flatnonzero(np.diff(seen.source.angles[seen.rows], prepend=np.nan) != 0)
    lengths = np.diff(starts, append=seen.rows.size)
    runs = starts[some := spread(np.flatnonzero(lengths >= _STANDS), PAIRS)]
    ends, firsts = seen.rows[runs + lengths[some] - 1], seen.rows[runs]
    if not runs.size or not seen.lit(np.concatenate([firsts, ends])).all():
        return
    pairs = (
        [[pair] for pair in zip(firsts.tolist(), rows.tolist(), strict=True)] for rows in (seen.rows[runs + 1], ends)
    )
    beside, across = (
        max(_EQUAL, float(np.median([seen.unlike_pairs(pair, False) for pair in each]))) for each in pairs
    )
    if across > _TURNED * beside:
        n, degrees = int(np.median(lengths[lengths >= _STANDS])), np.degrees(seen.source.angles[seen.rows])
        first_of_each = f" Or --frames 0::{n} takes the first view of each angle." if (lengths[:-1] == n).all() else ""
        yield Finding(
            "warning",
            "angle-spread",
            f"Angles stand for {n} frames each, which differ (frames {firsts[0]} and {ends[0]}, both stated at "
            f"{degrees[runs[0]]:.6g} degrees, {across / beside:.2g} times as much as neighbours): angles were read "
            f"back more slowly than frames came, while the stage turned. Give that of each of {degrees.size} views by "
            f"--angles FILE (degrees, one a line), from {degrees[0]:.6g} in even steps where it turned evenly."
            f"{first_of_each}",
        )


def angles_in_order(seen: CoarseViews) -> Iterator[Finding]:
    """Consecutive frames look alike only if their angles are close, and close angles look alike.

    A list in another order than the frames shows so, and a single angle that is wrong. Only one view of many tells of
    it where the list is shifted, so the places are looked at where angles jump.
    """
    source, rows = seen.source, seen.rows
    degrees = np.degrees(source.angles[rows]) % 360
    order = np.argsort(degrees, kind="stable")
    gaps = np.diff(degrees[order])
    if not (gaps > 0).any():
        return
    step = float(np.median(gaps[gaps > 0]))
    jumps = np.flatnonzero(_apart(np.diff(degrees)) > _FAR * step)
    beside = np.flatnonzero((gaps <= _NEXT * step) & (np.abs(np.diff(order)) > 1))
    far = _lit(seen, [(int(rows[at]), int(rows[at + 1])) for at in jumps])
    near = _lit(seen, [(int(rows[order[at]]), int(rows[order[at + 1]])) for at in beside])
    if far and near:
        unlike_far, unlike_near = (
            float(np.median([seen.unlike_pairs([pair], False) for pair in pairs])) for pairs in (far, near)
        )
        if unlike_near > UNLIKE * unlike_far:
            yield _in_another_order(source, rows, jumps, far[0], near[0])
            return
    if elsewhere := list(_alike_elsewhere(seen, rows[order])):
        yield from elsewhere
    elif source.cone is None and (pair := _mirrored_neighbours(seen, rows[order])) is not None:
        yield Finding(
            "warning",
            RULE,
            f"{_stated(source, pair)} are mirror images, as views half a turn apart are. Unless the sample moved, "
            "the angles were taken modulo 180 degrees, or frames lie in another order than their angles. Give one for "
            "each projection, in their order, with --angles FILE.",
        )


def _mirrored_neighbours(seen: CoarseViews, rows: NDArray[np.int64]) -> tuple[int, int] | None:
    """Two frames that are stated side by side and look half a turn apart; None where none are. Rows by their angles.

    A sample that is symmetric looks alike both ways, and one that moved looks unlike both ways. One with a plane of
    symmetry retraces its views beyond it, mirrored, which frames of two sides do not.
    """
    some = spread(rows, VIEWS)
    some = some[seen.lit(some)]
    if some.size <= PAIRS:
        return None
    pairs = list(zip(some[:-1].tolist(), some[1:].tolist(), strict=True))
    apart = np.diff(np.degrees(seen.source.angles[some]) % 360)
    allowed = np.maximum(apart / np.median(apart[apart > 0]), 1) ** 2  # views differ by the square of a small turn
    unlike = np.diagonal(seen.unlike(some), 1)
    rate = np.pad(unlike / allowed, 2, mode="edge")
    near = np.median(np.lib.stride_tricks.sliding_window_view(rate, 5), axis=1)  # some directions change faster
    usual = np.maximum(near, np.median(rate))
    for at in np.flatnonzero(unlike > UNLIKE * usual * allowed)[:PAIRS].tolist():
        around = list(zip(some[at::-1].tolist(), some[at + 1 :].tolist(), strict=False))[:_AROUND]
        retraced = len(around) == _AROUND and seen.unlike_pairs(around, True) < _RETRACED * usual[at]
        if not retraced and seen.unlike_pairs([pairs[at]], True) < min(
            2 * usual[at] * allowed[at], unlike[at] / UNLIKE
        ):
            return pairs[at]
    return None


def _apart(turned: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees between directions, of differences of angles."""
    return np.abs((turned + 180) % 360 - 180)


def _lit(seen: CoarseViews, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """A few of the pairs of frames, evenly spread, with light."""
    some = [pairs[at] for at in spread(np.arange(len(pairs)), PAIRS)]
    return [pair for pair in some if seen.lit(np.array(pair)).all()]


def _stated(source: ScanSource, pair: tuple[int, int]) -> str:
    first, second = np.degrees(source.angles[list(pair)])
    return f"Frames {pair[0]} and {pair[1]}, stated at {first:.6g} and {second:.6g} degrees,"


def _in_another_order(
    source: ScanSource, rows: NDArray[np.int64], jumps: NDArray[np.int64], far: tuple[int, int], near: tuple[int, int]
) -> Finding:
    text = f"{_stated(source, far)} look alike, and f{_stated(source, near)[1:]} do not. "
    single = np.intersect1d(jumps, jumps + 1)  # between two jumps
    if single.size and jumps.size == 2 * single.size and single.size <= _SINGLE * rows.size:
        wrong = ", ".join(f"{row} ({np.degrees(source.angles[row]):.6g})" for row in rows[single[:5]].tolist())
        text += f"The angles of {single.size} views are not between those of their neighbours: frames {wrong}. "
        return Finding("warning", RULE, text + "Give the right ones with --angles FILE (degrees, one a line).")
    text += (
        "The angles are not in the order of the frames. Give one for each projection, in their order, with "
        "--angles FILE."
    )
    return Finding("warning" if source.plan else "error", RULE, text)


def _alike_elsewhere(seen: CoarseViews, rows: NDArray[np.int64]) -> Iterator[Finding]:
    """Most views look more like one that is far from them than like their neighbours; rows by ascending angle.

    Of two measured scans (the tooth, Diamond) as if taken in 2, 3, 4 and 6 passes, 5 of 8 are told, those of
    two passes never; as they were taken, none.
    """
    some = spread(rows, VIEWS)
    some = some[seen.lit(some)]
    if some.size < PAIRS:
        return
    degrees = np.degrees(seen.source.angles[some]) % 360
    apart = _apart(degrees - degrees[:, None])
    is_far = apart > max(OTHER * 180, 2 * float(np.median(np.diff(degrees))))
    if not is_far.any():
        return
    unlike = seen.unlike(some)
    usual, beside = float(np.median(unlike[is_far])), np.diagonal(unlike, 1)
    neighbours = np.minimum(np.append(beside, np.inf), np.append(np.inf, beside))
    far_alone = np.where(is_far, unlike, np.inf)
    like, elsewhere = far_alone.argmin(axis=1), far_alone.min(axis=1)
    odd = elsewhere < np.minimum(neighbours, usual / UNLIKE)
    if odd.mean() < _MOST:
        return
    # A sample with a plane of symmetry looks the same from directions that mirror each other: their sums are equal.
    sums = np.radians(degrees[odd] + degrees[like[odd]])
    if abs(np.exp(1j * sums).mean()) > _MIRRORED:
        return
    first = int(np.flatnonzero(odd)[0])
    pair = int(some[first]), int(some[like[first]])
    yield Finding(
        "warning",
        RULE,
        f"{_stated(seen.source, pair)} look more alike than neighbours, as {odd.sum()} of {some.size} views looked at "
        "do. Unless the sample is symmetric, the angles are not in the order of the frames, or the sample went round "
        "more often than they state.",
    )
