"""Rules that find flats with the sample in the beam, by comparing the intensity of flats and projections.

These rules belong to `beamline.monitor.references`. They compare the intensities of flats and projections on a coarse
grid, as line integrals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from beamline.monitor.evidence import BRIGHT, DRIFT, BadFrames, Evidence, lit_places, place_noise
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, F64, Mask

SIGMAS = 8.0  # standard deviations of a place
WORST = 99.0  # percentile of the places that counts, so that zingers do not
# a flat resembles a projection if it differs from the projection by less than this share of its difference from other
# flats
LIKER = 0.5
# percent of the places that are ignored at either end of a distribution: one or two zingers in a thousand cells
CLIPPED = 0.2
# flats show the sample if projections are brighter than flats at some places, by this share of the absorption elsewhere
BRIGHTER = 0.5
# the projections contain too little mass if they have less than this share of the smallest mass of the sample. The
# ratio is 1.09 or more if flats are clean (60 simulated scans, 53 with other faults), and 0.01 if the sample is in all
# flats
LIGHTER = 0.5
AIR = 0.1  # line integral at the edges of the field of view, above which the edges are not air
EDGE = 16  # this share of the columns at each edge is assumed to be air
# smallest number of projections with beam; percent of them that may count as having the least sample at a place
FEWEST, SHALLOW = 8, 10.0
OF_SHALLOW = 1.2816  # standard deviations; SHALLOW percent of normal noise are lower than this, and are not material


def flats_like_views(single: bool) -> Callable[[Evidence, Any], Iterator[BadFrames]]:
    """Rule: flats that resemble a projection more than other flats. Flats are compared within their group, or as whole
    groups."""
    return partial(_like_views, single=single)


def _like_views(evidence: Evidence, _: Any, single: bool) -> Iterator[BadFrames]:
    views, groups = evidence.lit_views, evidence.of_kind(FrameKind.FLAT)
    if len(views) < FEWEST:
        return
    projections, intensity = (
        [evidence.intensity(view) for view in views],
        [[evidence.intensity(flat) for flat in each] for each in groups],
    )
    if single:  # if there are only two flats, each can be compared only with the other one
        compared = [
            ([group[i]], own[i], [np.median(rest, axis=0)])
            for group, own in zip(groups, intensity, strict=True)
            for i in range(len(group))
            if (rest := own[:i] + own[i + 1 :])
        ]
    else:
        means = [np.mean(own, axis=0) for own in intensity]
        compared = [(list(group), means[i], means[:i] + means[i + 1 :]) for i, group in enumerate(groups)]
    compared_with, bad_frames = "other flats of their group" if single else "other flats", list[BadFrames]()
    for frames, image, others in compared:
        if others and (nearest_view := _nearest_view(image, others, projections)) is not None:
            difference, difference_from_view, nearest = nearest_view
            nearest_frame = views[nearest].row
            bad_frames.append(BadFrames(frames, difference, difference_from_view / LIKER, (
                f"the sample was in the beam. In line integral, these flats differ by {difference:.3g} from the "
                f"{compared_with}, but only by {difference_from_view:.2g} from the projection in frame {nearest_frame}."
            )))  # fmt: skip
    # otherwise the beam drifts, and each flat is similar to the projections next to it
    if len(bad_frames) < len(compared):
        yield from bad_frames


def _nearest_view(image: F32, others: Sequence[F32], views: Sequence[F32]) -> tuple[float, float, int] | None:
    """The difference of a flat from the most similar other flat and from the most similar projection, and the number of
    this projection. None if the flat does not show the sample."""
    exposed = lit_places(np.maximum.reduce([image, *others]))
    difference = _beyond_noise(min((log_ratio(image, flat, exposed) for flat in others), key=_spread))
    like = [_beyond_noise(log_ratio(image, view, exposed)) for view in views] if difference > 0 else [np.inf]
    nearest = int(np.argmin(like))
    return (difference, like[nearest], nearest) if like[nearest] < LIKER * difference else None


class ViewsAboveFlats(NamedTuple):
    """How much brighter projections are than each group of flats [group], as line integrals, at places with the least
    sample.

    Attributes:
        brightest: at the places at which projections are brightest; 0 for an open beam.
        at_edges: at the left or right edge of the field of view, whichever is less.
        mismatch: largest local difference between each group and the group with the smallest `brightest`, apart
            from a factor.
        limit: value that noise alone does not reach.
    """

    brightest: F64
    at_edges: F64
    mismatch: F64
    limit: float


def _views_above_flats(evidence: Evidence) -> ViewsAboveFlats | None:
    views = [evidence.intensity(view) for view in evidence.lit_views]
    intensity = [
        np.asarray(np.mean([evidence.intensity(flat) for flat in group], axis=0), np.float32)
        for group in evidence.of_kind(FrameKind.FLAT)
    ]
    exposed = lit_places(np.maximum.reduce(intensity))
    if len(views) < FEWEST or not exposed.any():
        return None
    over = [
        np.percentile([log_ratio(view, each, exposed) for view in views], 100 - SHALLOW, axis=0) for each in intensity
    ]
    brightest = np.percentile(over, WORST, axis=1)
    columns, n = np.nonzero(exposed)[1], max(1, exposed.shape[1] // EDGE)
    sides = [columns < columns.min() + n, columns > columns.max() - n]
    at_edges = np.min([np.median(np.array(over)[:, side], axis=1) for side in sides], axis=0)
    changes = [log_ratio(each, intensity[int(np.argmin(brightest))], exposed) for each in intensity]
    mismatch = np.array([np.percentile(np.abs(change - np.median(change)), WORST) for change in changes])
    return ViewsAboveFlats(
        brightest, at_edges, mismatch, max(AIR, SIGMAS * max(place_noise(change) for change in changes))
    )


def flats_below_views(evidence: Evidence, _: Any) -> Iterator[BadFrames]:
    """Rule: groups of flats that are locally darker than projections, although other flats are not, because an object
    was in the beam.

    If two groups of flats differ in shape, the projections show which of them is the open beam, because a sample can
    only absorb.
    """
    groups = evidence.of_kind(FrameKind.FLAT)
    if len(groups) < 2 or (above := _views_above_flats(evidence)) is None:
        return
    least = float(above.brightest.min())
    for group, top, mismatch in zip(groups, above.brightest.tolist(), above.mismatch.tolist(), strict=True):
        if min(top, top - least, mismatch) > above.limit:
            yield BadFrames(group, top, above.limit, (
                "the sample, or something else, was in the beam. A sample can only absorb, but projections are "
                f"locally brighter than these flats, by {top:.3g} in line integral (limit {above.limit:.2g}). The "
                f"projections are brighter than the other flats by only {max(least, 0.0):.2g}."
            ))  # fmt: skip


def views_brighter(evidence: Evidence, _: Any) -> Iterator[BadFrames]:
    """Rule: projections are brighter than flats at some places, and less so at the edges."""
    if (above := _views_above_flats(evidence)) is not None:
        brightest_view = int(np.argmax(above.brightest))
        top = float(above.brightest[brightest_view])
        if min(top, top - float(above.at_edges[brightest_view])) > above.limit:
            yield BadFrames((), top, above.limit, (
                "Was the sample, or something else, in the beam during the flats, or did the beam change its shape? "
                f"The projections are locally brighter than the flats by {top:.2g} in line integral, but a sample can "
                "only absorb."
            ))  # fmt: skip


def sample_in_all_flats(evidence: Evidence, _: Any) -> Iterator[BadFrames]:
    """Rule: all flats show the sample. It may have been displaced, or at an angle that no projection has.

    There are two signs. (1) If the sample is in flats and projections, both have the same total absorption. The
    projections, divided by the flats, then have no net absorption: they are brighter at some places by as much as they
    are darker at others. (2) The rotating part of the sample absorbs more than the projections show relative to the
    flats. The rotating part is measured from the differences between projections, which do not depend on the flats; its
    smallest absorption is set to zero. Air is assumed at the edges of rows.
    """
    if (depth := _depth_over_air(evidence)) is None:
        return
    flats = evidence.frames(FrameKind.FLAT)
    mean = depth.mean(axis=0)
    brighter, limit = -float(np.percentile(mean, 100 - WORST)), max(AIR, SIGMAS * place_noise(mean))
    if brighter > limit and float((-mean).clip(0).sum()) > BRIGHTER * float(mean.clip(0).sum()):
        yield BadFrames(flats, brighter, limit, (
            "the sample was in the beam, or the beam changed its shape between flats and projections. A sample can "
            f"only absorb, but the projections are locally brighter than the flats, by {brighter:.2g} in line "
            f"integral (limit {limit:.2g}). In the rest of the frame the projections are hardly darker than the "
            "flats."
        ))  # fmt: skip
        return
    turning = depth - mean
    deepest = -np.percentile(turning, SHALLOW, axis=0) - OF_SHALLOW * place_noise(turning)
    masses, least = depth.mean(axis=(1, 2)), float(deepest.mean())
    typical_mass = float(masses.mean())
    if np.percentile(deepest, WORST) > DRIFT and LIGHTER * least - typical_mass > SIGMAS * float(masses.std()):
        least_shown = LIGHTER * least
        yield BadFrames(flats, typical_mass, LIGHTER * least, (
            "the sample was in the beam. The differences between projections show that the sample absorbs at least "
            f"{least:.2g} (line integral, mean over the frame). But after the division by these flats, the projections "
            f"show only {typical_mass:.2g} (expected: at least {least_shown:.2g})."
        ))  # fmt: skip


def views_show_nothing(evidence: Evidence, _: Any) -> Iterator[BadFrames]:
    """Rule: projections differ from flats and from each other only by noise."""
    if (depth := _depth_over_air(evidence)) is None:
        return
    mean = depth.mean(axis=0)
    limits = [SIGMAS * place_noise(part) for part in (mean, depth - mean)]
    largest = [float(np.abs(part).max()) for part in (mean - np.median(mean), depth - mean)]
    if all(value < limit for value, limit in zip(largest, limits, strict=True)):
        yield BadFrames((), max(largest), max(limits), (
            "The projections show no sample: the projections that were checked differ from the flats only by noise "
            f"(all line integrals are below {max(largest):.2g}). Check whether the sample was in the field of view. If "
            "the sample was in the field of view, the sample was also in the beam during the flats, and looks the same "
            "from all sides: take new flats without the sample."
        ))  # fmt: skip


def _depth_over_air(evidence: Evidence) -> F64 | None:
    """Line integrals [view, row, col] of places, minus the straight line between the edges of each row.

    Only projections with air at the edges are used. None if there are too few such projections, or too few places.
    """
    intensity = np.mean([evidence.intensity(flat) for flat in evidence.frames(FrameKind.FLAT)], axis=0)
    exposed = lit_places(intensity)
    rows = np.flatnonzero(2 * exposed.sum(axis=1) > exposed.shape[1])
    cols = np.flatnonzero(exposed[rows].all(axis=0))
    views = evidence.lit_views
    if len(views) < FEWEST or not rows.size or cols.size < EDGE:
        return None
    part = np.ix_(rows, cols)
    all_cells = np.ones(intensity[part].shape, np.bool_)
    lines = (
        log_ratio(evidence.intensity(view)[part], intensity[part], all_cells).reshape(all_cells.shape) for view in views
    )
    depth = -np.stack(list(lines))
    n = max(1, cols.size // EDGE)
    left_edge, right_edge = depth[:, :, :n].mean(axis=2), depth[:, :, -n:].mean(axis=2)
    air = np.percentile(np.abs(np.concatenate([left_edge, right_edge], axis=1)), WORST, axis=1) < AIR
    along = (np.arange(cols.size) - (n - 1) / 2) / (cols.size - n)
    depth = depth - (left_edge[..., None] + (right_edge - left_edge)[..., None] * along)
    return np.asarray(depth[air], np.float64) if air.sum() >= FEWEST else None


def log_ratio(image: F32, reference: F32, places: Mask) -> F32:
    """Logarithm of the ratio of two images at places with beam. Values near zero count as a thousandth of the bright
    part."""
    least = 1e-3 * float(np.percentile(np.maximum(image, reference)[places], BRIGHT)) if places.any() else 1.0
    least = max(least, 1e-30)
    return np.asarray(np.log(np.maximum(image[places], least) / np.maximum(reference[places], least)), np.float32)


def _spread(values: F32) -> float:
    """Standard deviation without the outermost values."""
    if not values.size:
        return 0.0
    low, high = np.percentile(values, (CLIPPED, 100 - CLIPPED))
    return float(np.clip(values, low, high).std())


def _beyond_noise(values: F32) -> float:
    """Standard deviation of the values without the part from noise; 0 if all of it may be noise."""
    spread, noise = _spread(values), place_noise(values)
    chance = 1 + SIGMAS * (2 / max(values.size, 1)) ** 0.5
    return (spread**2 - noise**2) ** 0.5 if spread**2 > chance * noise**2 else 0.0
