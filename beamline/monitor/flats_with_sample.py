"""Flats with the sample in the beam: they look like views, or leave the views without the matter that turns in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.references import (
    BRIGHT,
    CHANGE_SIGMAS,
    UNLIT,
    WORST,
    FaultKind,
    Group,
    ReferenceFault,
    ReferenceFrame,
)
from recon.base.arrays import median_deviation

BLOCK_SIGMAS = 3.0  # noises of a place: the mean of a few may be off by so much
LIKER = 0.5  # a frame is a view rather than a flat if it differs from a view by less than this share of the difference
CLIPPED = 0.2  # percent of the places at either end that a spread does not see: zingers
BRIGHTER = 0.5  # flats hold the sample where places outshine them by this share of what the views take elsewhere
LIGHTER = 0.5  # of the least mass of the sample, below which the mass in the views is too little
DRIFTS = 0.02  # of the light: a beam may drift by so much (as in the check `beam`), so a weaker sample is not judged
AIR = 0.1  # line integral at the edges of the field from which they are no air
EDGE = 16  # one column in so many, at each edge, is taken for air
EMPTY, SHALLOW = 8, 10.0  # views at least, and percent of them that may be taken for the emptiest at a place
OF_SHALLOW = 1.2816  # standard deviations: SHALLOW percent of noise are further below

Places = NDArray[np.float32]
Depth = NDArray[np.float64] | None  # Of `depth_over_air`


@dataclass(frozen=True)
class OddFrame:
    """A frame that cannot be used: its fault, the figure, the limit, and a sentence with {figures}."""

    frame: ReferenceFrame
    kind: FaultKind
    score: float
    limit: float
    sentence: str


def flats_like_views(
    flats: Sequence[Group], darks: Sequence[Group], views: Group, depth: Depth
) -> ReferenceFault | None:
    """The fault that all flats show the sample: they look like one view, and other views are brighter.

    In a true scan nothing outshines the flats in places, though a view may be empty where a sample leaves the field.
    """
    views = lit_views(views, darks)
    if len(views) < 3 or not flats:
        return None
    base = _base(darks)
    light = np.mean([_cells(frame, base) for group in flats for frame in group], axis=0)
    lit = lit_places(light)
    stated = np.stack([_log(_cells(view, base), light, lit) for view in views])
    through = _without_drift(stated, lit)
    spreads = np.array([_spread(each) for each in through])
    beyond = np.array([_beyond_noise(each) for each in through])
    nearest, noise = int(np.argmin(spreads)), float(np.median([noise_of(each) for each in through]))
    if not beyond[nearest] < LIKER * np.median(beyond):
        return None
    level = np.median(through[nearest])
    brighter = float(np.median([np.percentile(each, WORST) - level for each in through]))
    darker = float(np.median([level - np.percentile(each, 100 - WORST) for each in through]))
    if depth is not None:
        brighter = min(brighter, -float(np.median(np.percentile(depth, 100 - WORST, axis=(1, 2)))))
    else:  # the sample fills the field: less the drift, half of its places are brighter than the others
        brighter = min(brighter, float(np.median(np.percentile(stated, WORST, axis=1))))
    limit = max(BRIGHTER * darker, BLOCK_SIGMAS * noise)
    if not brighter > limit > 0:
        return None
    sentence = (
        f"they look like the view in frame {views[nearest].row}, and in places the views are brighter by "
        f"{brighter:.2g} of line integral (limit {limit:.2g}), though a sample only takes light: "
        "the sample was in the beam."
    )
    return ReferenceFault(FaultKind.SAMPLE_IN, brighter, limit, sentence)


def mass_missing(depth: Depth) -> ReferenceFault | None:
    """The fault that flats show the sample, even at an angle of no view or displaced.

    A sample in the flats has the mass of that in the views, so that the views divided by the flats hold none: they are
    as much brighter in places as darker in others. Or they turn more than they hold: whatever the flats are, the views
    differ by the sample alone, which is nowhere less than nothing in the emptiest views. Air is at the edges of rows.
    """
    if depth is None:
        return None
    mean = depth.mean(axis=0)
    brighter, darker = -float(np.percentile(mean, 100 - WORST)), float(mean.clip(0).sum())
    limit = max(AIR, CHANGE_SIGMAS * noise_of(mean))
    if brighter > limit and float((-mean).clip(0).sum()) > BRIGHTER * darker:
        sentence = (
            f"in places the views are brighter by {brighter:.2g} of line integral (limit {limit:.2g}) and hold no more "
            "matter elsewhere, though a sample only takes light: the sample was in the beam, or the beam changed its "
            "shape between flats and views."
        )
        return ReferenceFault(FaultKind.SAMPLE_IN, brighter, limit, sentence)
    noise = noise_of(depth - depth.mean(axis=0))
    deepest = -np.percentile(depth - depth.mean(axis=0), SHALLOW, axis=0) - OF_SHALLOW * noise
    masses = depth.mean(axis=(1, 2))
    least, seen = float(deepest.mean()), float(masses.mean())
    if not np.percentile(deepest, WORST) > DRIFTS:
        return None
    if not LIGHTER * least - seen > CHANGE_SIGMAS * float(masses.std()):
        return None
    sentence = (
        f"what turns in the views takes at least {least:.2g} of line integral, the mean over the frame, but against "
        f"these flats there is {seen:.2g} (limit {LIGHTER * least:.2g}): the sample was in the beam."
    )
    return ReferenceFault(FaultKind.SAMPLE_IN, seen, LIGHTER * least, sentence)


def nothing_seen(depth: Depth) -> float | None:
    """Line integral below which views differ from flats and from one another only by noise; None if they differ."""
    if depth is None:
        return None
    mean = depth.mean(axis=0)
    limits = [CHANGE_SIGMAS * noise_of(part) for part in (mean, depth - mean)]
    shows = [float(np.abs(part).max()) for part in (mean - np.median(mean), depth - mean)]
    return max(shows) if all(most < limit for most, limit in zip(shows, limits, strict=True)) else None


def depth_over_air(flats: Sequence[Group], darks: Sequence[Group], views: Group) -> Depth:
    """Line integrals [view, row, col] of places, less the straight line between the edges of each row.

    Only views that have air there; None where they, places or flats are too few.
    """
    views = lit_views(views, darks)
    if len(views) < EMPTY or not flats:
        return None
    base = _base(darks)
    light = np.mean([_cells(frame, base) for group in flats for frame in group], axis=0)
    lit = lit_places(light)
    rows = np.flatnonzero(2 * lit.sum(axis=1) > lit.shape[1])
    cols = np.flatnonzero(lit[rows].all(axis=0))
    if not rows.size or cols.size < EDGE:
        return None
    part = np.ix_(rows, cols)
    every = np.ones(light[part].shape, np.bool_)
    depth = np.stack([-_log(_cells(view, base)[part], light[part], every).reshape(every.shape) for view in views])
    n = max(1, cols.size // EDGE)
    left, right = depth[:, :, :n].mean(axis=2), depth[:, :, -n:].mean(axis=2)
    air = np.percentile(np.abs(np.concatenate([left, right], axis=1)), WORST, axis=1) < AIR
    if air.sum() < EMPTY:
        return None
    depth, left, right = depth[air], left[air], right[air]
    along = (np.arange(cols.size) - (n - 1) / 2) / (cols.size - n)
    return np.asarray(depth - (left[..., None] + (right - left)[..., None] * along), np.float64)


def lit_views(views: Group, darks: Sequence[Group]) -> list[ReferenceFrame]:
    """The views with more light than with a closed shutter, and more than one value."""
    base = _base(darks)
    light = [float(np.percentile(_cells(view, base), BRIGHT)) for view in views]
    least = UNLIT * max(light, default=0.0)
    return [view for view, bright in zip(views, light, strict=True) if bright > least and varies(view)]


def varies(frame: ReferenceFrame) -> bool:
    known = frame.blocks[np.isfinite(frame.blocks)]
    return known.size > 0 and bool(np.ptp(known) > 0)


def with_sample(
    flats: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]], views: Group, *, single: bool
) -> list[OddFrame]:
    """Flats that differ less from a view than from other flats.

    Args:
        single: each flat beside those of its group; else each group beside the other groups.
    """
    base = _base(darks)
    seen = [_cells(view, base) for view in views]
    light = [[_cells(flat, base) for flat in group] for group in flats]
    means = [np.mean(group, axis=0) for group in light]
    bright = [float(np.percentile(mean, BRIGHT)) for mean in means]
    shining = None if single or len(flats) < 2 else _outshining(flats, darks, views)
    displaced = []
    for at, group in enumerate(flats):
        if not bright[at] > UNLIT * max(bright):
            continue  # without light, which is another fault
        if shining is not None and np.delete(shining.tops, at).min() > shining.tops[at] + shining.limit:
            continue  # the views outshine all others, which hold something
        if single:  # of two flats each is the other one's only witness
            own, n = light[at], len(group)
            rest = [own[:i] + own[i + 1 :] for i in range(n)]
            compared = [(own[i], [np.median(rest[i], axis=0)] if n > 2 else rest[i]) for i in range(n)]
        else:
            compared = [(means[at], means[:at] + means[at + 1 :])]
        for i, (image, others) in enumerate(compared):
            if (found := _like_a_view(image, others, seen)) is None:
                continue
            off, like, nearest = found
            sentence = (
                f"they differ from the {'others of their group' if single else 'other flats'} by {{figures}} of "
                f"line integral, and by {like:.2g} only from the view in frame {views[nearest].row}: the sample was in "
                "the beam."
            )
            frames = [group[i]] if single else group
            displaced += [OddFrame(frame, FaultKind.SAMPLE_IN, off, like / LIKER, sentence) for frame in frames]
    return displaced


def _like_a_view(image: Places, others: Sequence[Places], views: Sequence[Places]) -> tuple[float, float, int] | None:
    """How much a flat differs from the most similar other flat and from the most similar view, and the number of that
    view; None if the flat does not show the sample."""
    if not others:
        return None
    lit = lit_places(np.maximum.reduce([image, *others]))
    off = _beyond_noise(min((_log(image, other, lit) for other in others), key=_spread))
    if not off > 0:
        return None
    like = [_beyond_noise(_log(image, view, lit)) for view in views]
    nearest = int(np.argmin(like))
    return (off, like[nearest], nearest) if like[nearest] < LIKER * off else None


@dataclass(frozen=True, eq=False)
class _Outshining:
    """How much brighter than each group of flats views are, where they are emptiest.

    Attributes:
        tops: of each group, how much brighter views are in their brightest places, as a line integral; an open beam: 0.
        edges: the same at the edge of the field where it is least.
        unlike: line integrals by which each group differs in places from that with the least top, but for a factor.
        noise: of a place, in the difference of two groups.
    """

    tops: NDArray[np.float64]
    edges: NDArray[np.float64]
    unlike: NDArray[np.float64]
    noise: float

    @property
    def limit(self) -> float:
        return max(AIR, CHANGE_SIGMAS * self.noise)


def _outshining(flats: Sequence[Group], darks: Sequence[Group], views: Group) -> _Outshining | None:
    views = lit_views(views, darks)
    if len(views) < EMPTY or not flats:
        return None
    base = _base(darks)
    light = [np.asarray(np.mean([_cells(flat, base) for flat in group], axis=0), np.float32) for group in flats]
    lit = lit_places(np.maximum.reduce(light))
    if not lit.any():
        return None
    seen = [_cells(view, base) for view in views]
    emptiest = np.stack(
        [np.percentile([_log(view, open_beam, lit) for view in seen], 100 - SHALLOW, axis=0) for open_beam in light]
    )
    tops = np.percentile(emptiest, WORST, axis=1)
    columns = np.nonzero(lit)[1]
    n = max(1, lit.shape[1] // EDGE)
    sides = [columns < columns.min() + n, columns > columns.max() - n]
    edges = np.min([np.median(emptiest[:, side], axis=1) for side in sides], axis=0)
    best = light[int(np.argmin(tops))]
    changes = [_log(each, best, lit) for each in light]
    unlike = np.array([np.percentile(np.abs(change - np.median(change)), WORST) for change in changes])
    return _Outshining(tops, edges, unlike, max(noise_of(change) for change in changes))


def outshone(flats: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]], views: Group) -> list[OddFrame]:
    """Groups of flats that are darker than views in places where other flats are not: an object was in the beam.

    Where two groups differ in shape, the views tell which of them is the open beam: a sample only takes light.
    """
    seen = _outshining(flats, darks, views) if len(flats) > 1 else None
    if seen is None:
        return []
    limit, least = seen.limit, float(seen.tops.min())
    odd = []
    for group, top, unlike in zip(flats, seen.tops.tolist(), seen.unlike.tolist(), strict=True):
        if min(top, top - least, unlike) > limit:
            sentence = (
                f"in places the views are brighter than they by {{figures}} of line integral (limit {limit:.2g}), and "
                f"than other flats by {max(least, 0.0):.2g} only, though a sample only takes light: the sample, or "
                "something else, was in the beam."
            )
            odd += [OddFrame(frame, FaultKind.SAMPLE_IN, top, limit, sentence) for frame in group]
    return odd


def brighter_in_places(flats: Sequence[Group], darks: Sequence[Group], views: Group) -> float | None:
    """How much brighter than the flats views are in places, as a line integral; None: nowhere, or at the edges, too."""
    seen = _outshining(flats, darks, views)
    if seen is None:
        return None
    most = max(range(len(flats)), key=lambda at: seen.tops[at])
    top = float(seen.tops[most])
    return top if min(top, top - float(seen.edges[most])) > seen.limit else None


def _base(darks: list[list[ReferenceFrame]] | Sequence[Group]) -> Places | float:
    frames = [_whole(frame) for group in darks for frame in group]
    return 0.0 if not frames else np.asarray(np.mean(frames, axis=0), np.float32)


def _whole(frame: ReferenceFrame) -> Places:
    return frame.blocks if frame.cells is None else frame.cells


def _cells(frame: ReferenceFrame, base: Places | float) -> Places:
    return np.asarray(np.nan_to_num(_whole(frame) - base), np.float32)


def lit_places(light: Places) -> NDArray[np.bool_]:
    """Mask of the places where images of the beam have light."""
    return light > UNLIT * max(float(np.percentile(light, BRIGHT)), 1e-30)


def _log(image: Places, other: Places, lit: NDArray[np.bool_]) -> Places:
    """Logarithm of the one over the other where there is light; what has none counts as a thousandth."""
    least = 1e-3 * float(np.percentile(np.maximum(image, other)[lit], BRIGHT)) if lit.any() else 1.0
    least = max(least, 1e-30)
    return np.asarray(np.log(np.maximum(image[lit], least) / np.maximum(other[lit], least)), np.float32)


def _without_drift(values: Places, lit: NDArray[np.bool_]) -> Places:
    """Values [view, place] less a polynomial of the second order in row and column each: so a beam drifts, and a sample
    has more detail."""
    row, col = (at / max(n, 1) for at, n in zip(np.nonzero(lit), lit.shape, strict=True))
    terms = np.stack([np.ones_like(row), row, col, row * row, row * col, col * col], axis=1)
    drift = np.linalg.lstsq(terms, values.T.astype(np.float64), rcond=None)[0]
    return np.asarray(values - (terms @ drift).T, np.float32)


def _spread(values: Places) -> float:
    """Standard deviation without the outermost values."""
    if not values.size:
        return 0.0
    low, high = np.percentile(values, (CLIPPED, 100 - CLIPPED))
    return float(np.clip(values, low, high).std())


def _beyond_noise(values: Places) -> float:
    """Their spread without the noise; 0 where it may all be noise."""
    spread, noise = _spread(values), noise_of(values)
    chance = 1 + CHANGE_SIGMAS * (2 / max(values.size, 1)) ** 0.5
    return (spread**2 - noise**2) ** 0.5 if spread**2 > chance * noise**2 else 0.0


def noise_of(values: Places) -> float:
    """Standard deviation of a place, estimated from its neighbours along the row: matter and beam change more
    slowly."""
    change = np.diff(values, 2, axis=-1)
    change = change[np.isfinite(change)]
    return median_deviation(change) / 6**0.5 if change.size else 0.0
