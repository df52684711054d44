"""Angles: every view has one, together they go round half a turn, and the views show the turns that they state."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.storage.readers.base import ScanSource
from beamline.storage.rules import Finding, Severity
from beamline.storage.rules.references import VIEWS, reference_groups, seen_frame
from beamline.storage.rules.unlit import LEAST, ViewLight, brightness
from drivers.base.frame import FrameKind
from recon.base.units import look_like_degrees
from recon.base.views import spread

FARTHEST = 1e6  # degrees
_GAP = 0.5  # degrees without a view beyond the others, of views in even steps
_SAME = 0.1  # of the mean step: views so close are one
_FALSE_ALARM = 1e-3  # of scans whose views are at random
_OF_MEAN = 0.8  # standard deviation of gaps at random, without the largest, over their mean
_COUNTED = " They are 0, 1, 2 and so on: do they count the frames?"
_LEAST_SEEN = 8  # views, and columns: fewer do not show a turn
OTHER = 0.08  # of half a turn, and two steps: nearer ones are alike where the view that is sought was spoilt
# Of degrees in what is stated: gradians; twice or half the turn, by a gear or its pulses; minutes; thousandths of rad.
_FACTORS = 1 / 0.9, 2.0, 0.5, 60.0, 1000 * math.pi / 180
PAIRS = 6  # of views that are stated half a turn apart, which are compared
UNLIKE = 4.0  # times as different: twice as far from one another, since a small turn shows by its square
_FINE = 90  # of the range of angles: neighbours that tell how much a small turn changes a view
_AROUND = 9  # views about the best of some that are looked at
_PARTS = 4  # steps to a column in which mirror images are moved
_LEAST_LIGHT = 1e-3  # of the beam
_ROUNDING = 1e-12  # of the power of an image: less is none
_FEWEST, _MANY = 5, 30  # views from which on a span tells a unit: if it is a turn in that unit, and in any case


def angles_known(source: ScanSource) -> Iterator[Finding]:
    """Every projection has a finite angle."""
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    unknown = views[~np.isfinite(source.angles[views])]
    if unknown.size:
        why = source.attributes.get("angles", "")
        yield Finding(
            "error",
            "angles",
            f"{unknown.size} of {views.size} projections have no angle (first: frame {unknown[0]})"
            + (f"; {why}" if why else "")
            + ". Give them with --angles FILE (degrees, one a line).",
        )


def angles_spread(source: ScanSource) -> Iterator[Finding]:
    """The projections have different directions, over half a turn, and their angles may be in degrees."""
    angles = source.angles[source.image_key == FrameKind.PROJECTION]
    if angles.size < 2 or not np.isfinite(angles).all():
        return
    farthest = float(np.abs(angles).max()) * 180 / np.pi
    if farthest > FARTHEST:
        yield Finding(
            "error",
            "angle-spread",
            f"The projections are at up to {farthest:.3g} degrees; expected at most {FARTHEST:g}, beyond which "
            "angles are not exact. Are their units right? Give them with --angles FILE (degrees, one a line).",
        )
        return
    degrees = np.degrees(angles)
    span = float(np.ptp(degrees))
    distinct = np.unique(np.round(degrees, 6))
    if distinct.size == 1:
        yield Finding("error", "angle-spread", f"All {angles.size} projections are at {distinct[0]:g} degrees.")
        return
    step = span / (distinct.size - 1)
    # A plan is of our own scans, whose angles are in degrees.
    severity: Severity = "warning" if source.plan else "error"
    between = float(np.median(np.abs(np.diff(degrees))))
    if look_like_degrees(angles):
        yield Finding(
            severity,
            "angle-spread",
            f"{angles.size} projections span {span / 360:.1f} turns, or {np.ptp(angles):.5g} in radians: these look "
            "like degrees under a label of radians. If so, give them with --angles FILE (degrees, one a line).",
        )
    elif between >= 360:
        yield Finding(
            severity,
            "angle-spread",
            f"The projections go from {degrees.min():.6g} to {degrees.max():.6g} degrees, {between:.4g} from one to "
            "the next, which is a turn or more: these look like counts of an encoder or of steps. Give them in "
            "degrees with --angles FILE (one a line); if they are right, give them less whole turns.",
        )
    elif (unit := _smaller_unit(distinct, angles.size)) is not None:
        yield Finding(
            severity,
            "angle-spread",
            f"{angles.size} projections span only {span:.4g} degrees: {unit} Give them in degrees with --angles FILE "
            "(one a line).",
        )
    elif (unseen := half_turn_unseen(angles)) > 0:
        span_text = (
            f"span {span:.2f} degrees: less than half a turn" if span + step < 180 else "do not go round half a turn"
        )
        yield Finding(
            "warning",
            "angle-spread",
            f"The projections {span_text} (limited angle): {unseen:.4g} of 180 degrees have no view."
            + (_COUNTED if np.allclose(degrees, np.arange(angles.size)) else ""),
        )


def half_turn_unseen(angles: NDArray[np.float64]) -> float:
    """Largest gap in degrees of half a turn without a view, beyond the spacing of the views [view] in rad.

    Views half a turn apart see the same rays. Of views at random, the largest gap exceeds the next by an exponentially
    distributed length, whose mean is that of all gaps (Rényi 1953); one scan in a thousand (of ten views: in a hundred)
    exceeds what is allowed for. Views in even steps have gaps alike, and half a degree more is named.
    """
    places = np.sort(np.mod(np.degrees(angles), 180.0))
    gaps = np.diff(places, append=places[0] + 180.0)
    gaps = gaps[gaps > _SAME * 180.0 / places.size]  # views side by side are one
    if gaps.size < 2:
        return 180.0
    *others, second, largest = np.sort(gaps)
    uneven = float(np.std([*others, second])) / _OF_MEAN
    n = len(others) + 1
    times = n * (_FALSE_ALARM ** (-1 / n) - 1)  # 6.9 of a mean that is known; more where it is estimated from n gaps
    limit = second + max(_GAP, times * uneven)
    if not np.isclose(largest, 180.0 - np.ptp(np.degrees(angles)), atol=_GAP):
        limit = max(limit, 2 * float(np.median(gaps)) + _GAP)  # within the views: one that was lost is no wedge
    return float(largest) if largest > limit else 0.0


def _smaller_unit(degrees: NDArray[np.float64], n: int) -> str | None:
    """What n angles under a label of degrees, distinct and ascending, are instead; None where they may be degrees."""
    span = float(degrees[-1] - degrees[0])
    whole = span + span / (degrees.size - 1)
    for unit, turn in (("radians", 2 * np.pi), ("turns", 1.0)):
        for part, name in ((turn / 2, "half a turn"), (turn, "a turn")):
            if n >= _FEWEST and min(abs(span / part - 1), abs(whole / part - 1)) < 0.01:
                return f"these look like {unit}: {name} is {part:.5g}."
    return "these look like radians or turns." if n > _MANY and span <= 2 * np.pi else None


@dataclass(frozen=True, eq=False)
class CoarseViews:
    """Coarse line integrals of views of a scan, each read once.

    Attributes:
        rows: views that have an angle and can be read, in the order of the file.
    """

    source: ScanSource
    light: ViewLight
    rows: NDArray[np.int64]
    _depths: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    _lit: dict[int, bool] = field(default_factory=dict)

    def depth(self, row: int) -> NDArray[np.float64]:
        """Line integrals [row, col] of a view, each row less its mean, smoothed along its rows, so that it has two
        columns less."""
        if row not in self._depths:
            lines = self._lines(row)
            lines = (lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:]) / 4
            self._depths[row] = lines - lines.mean(axis=1, keepdims=True)
        return self._depths[row]

    def _lines(self, row: int) -> NDArray[np.float64]:
        cells = seen_frame(self.source, row).places
        if self.light.dark is None or self.light.flat is None:
            return np.nan_to_num(cells.astype(np.float64))
        beam = np.nan_to_num(self.light.flat - self.light.dark)
        least = _LEAST_LIGHT * max(float(beam.max()), 1e-30)
        seen = np.nan_to_num(cells - self.light.dark)
        return np.asarray(-np.log(np.maximum(seen, least) / np.maximum(beam, least)), np.float64)

    def lit(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether views have light and show a sample [view]."""
        for row in set(rows.tolist()) - self._lit.keys():
            known = seen_frame(self.source, row).cells
            if known is None or self.light.dark is None or self.light.flat is None:
                self._lit[row] = bool(np.ptp(self._lines(row)))
            else:
                self._lit[row] = brightness(known, self.light.dark, self.light.flat) > LEAST * self.light.usual
        return np.array([self._lit[row] for row in rows.tolist()], np.bool_)

    def unlike(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """1 minus the correlation of views [view, view]; 1 for one without structure."""
        images = np.stack([self.depth(row).ravel() for row in rows.tolist()])
        power = np.linalg.norm(images, axis=1, keepdims=True)
        images = np.divide(images, power, out=np.zeros_like(images), where=power > 0)
        return np.asarray(1 - images @ images.T)

    def unlike_pairs(self, pairs: Sequence[tuple[int, int]], mirrored: bool, reach: float = 0.25) -> float:
        """1 minus the correlation of pairs of views; of mirror images, about the one column of best agreement.

        `reach`: how far mirror images are moved, of the field: twice as far as the axis is from its middle. It is
        doubled once where the best move is the farthest.
        """
        if not mirrored:
            return float(np.mean([self.unlike(np.array(pair))[0, 1] for pair in pairs]))
        farthest = int(reach * (self.depth(pairs[0][0]).shape[1] + 2))
        curve = np.mean([_unlike_moved(self.depth(a), self.depth(b)[:, ::-1], farthest) for a, b in pairs], axis=0)
        if reach < 0.5 and int(np.argmin(curve)) in (0, 2 * farthest):
            return self.unlike_pairs(pairs, mirrored, 2 * reach)
        return float(curve.min())


def coarse_views(source: ScanSource) -> CoarseViews | None:
    """The coarse views of a scan, if it has enough views, and their line integrals are known."""
    views = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & np.isfinite(source.angles))
    kinds = set(source.image_key.tolist())
    counts = source.quantity == "counts"
    if source.quantity == "unknown" or source.emission is not None or source.shifts is not None:
        return None
    if min(source.shape[1], views.size) < _LEAST_SEEN or (counts and not {FrameKind.DARK, FrameKind.FLAT} <= kinds):
        return None
    light = ViewLight.of(source, reference_groups(source) if counts else None)
    views = np.array([row for row in views.tolist() if row not in source.unreadable], np.int64)
    return CoarseViews(source, light, views) if views.size >= _LEAST_SEEN else None


def angles_seen(seen: CoarseViews) -> Iterator[Finding]:
    """Views half a turn apart by their angles are mirror images (a whole turn: alike), and no others are.

    Parallel rays see the same from both sides, whatever the sample is, also one that is wider than the field; a cone
    sees the same after a turn only. How much neighbours differ tells what a turn does to this sample, and what noise
    does: a round sample shows no angle.
    """
    source = seen.source
    views = seen.rows[np.argsort(source.angles[seen.rows], kind="stable")]
    some = spread(views, VIEWS)
    some = some[seen.lit(some)]
    degrees = np.degrees(source.angles)
    if np.unique(degrees[some]).size < _LEAST_SEEN:
        return
    apart = max(np.ptp(degrees[some]) / _FINE, float(np.median(np.diff(np.unique(degrees[views])))))
    beside = views[np.abs(degrees[views] - degrees[some][:, None] - apart).argmin(axis=1)]
    chosen = np.flatnonzero(beside != some)
    if not chosen.size:
        return
    pairs = np.stack([some, beside], axis=1)[spread(chosen, PAIRS)]
    near = float(np.median([seen.unlike(pair)[0, 1] for pair in pairs]))
    for mirrored in (True, False) if source.cone is None else (False,):
        turn = _turn_seen(seen, views, some, degrees, near, mirrored)
        if turn is not None:
            yield _angles_finding(source, degrees[views], turn, mirrored)
            return


@dataclass(frozen=True)
class _Turn:
    """Two frames that look half a turn apart (or a whole turn), and two that are stated to be; None: none are."""

    alike: tuple[int, int]
    degrees: float
    stated: tuple[int, int] | None


def _turn_seen(
    seen: CoarseViews, views: NDArray[np.int64], some: NDArray[np.int64], degrees: NDArray[np.float64], near: float,
    mirrored: bool,
) -> _Turn | None:  # fmt: skip
    """Views that are alike after another angle than they should be, where those that should be are not.

    Args:
        views, some: all, and some of them, by ascending angle.
        near: how much neighbours of these some differ.
    """
    period, step = (180.0 if mirrored else 360.0), float(np.ptp(degrees[some])) / (some.size - 1)
    stated = _stated_apart(seen, views, some, degrees, period)
    # The most alike of them: a crumb makes one pair unlike, wrong angles make all.
    off = min((seen.unlike_pairs([pair], mirrored) for pair in stated), default=np.inf)
    if off < 2 * UNLIKE * near or (not stated and not mirrored):
        return None
    first, last = int(some[0]), int(some[-1])
    ends = [(first, row) for row in some[some.size // 4 :].tolist()] + [
        (row, last) for row in some[1 : -(some.size // 4)].tolist()
    ]
    differences = [seen.unlike_pairs([pair], mirrored) for pair in ends]
    usual, (early, late) = float(np.median(differences)), ends[int(np.argmin(differences))]
    fixed, moved = (early, late) if early == first else (late, early)
    around = views[(np.abs(degrees[views] - degrees[moved]) < step) & (views != fixed)]
    best, nearest = min((seen.unlike_pairs([(fixed, row)], mirrored), row) for row in spread(around, _AROUND).tolist())
    turned = abs(float(degrees[nearest] - degrees[fixed]))
    right = max(OTHER * period, 2 * step)
    apart = np.array([abs(degrees[second] - degrees[first]) for first, second in ends])
    off = min([off, *np.array(differences)[np.abs(apart - period) <= right]])
    if abs(turned - period) <= right or not best < min(2 * near, off / UNLIKE, usual / UNLIKE):
        return None
    return _Turn((min(fixed, nearest), max(fixed, nearest)), turned, stated[len(stated) // 2] if stated else None)


def _stated_apart(
    seen: CoarseViews, views: NDArray[np.int64], some: NDArray[np.int64], degrees: NDArray[np.float64], period: float
) -> list[tuple[int, int]]:
    """A few pairs of views with light that are stated to be so many degrees apart, within a step."""
    partner = views[np.abs(degrees[views] - degrees[some][:, None] - period).argmin(axis=1)]
    step = min(float(np.median(np.diff(np.unique(degrees[views])))), float(np.ptp(degrees[some])) / (some.size - 1))
    pairs = np.flatnonzero(np.abs(degrees[partner] - degrees[some] - period) <= step)
    few = spread(pairs, PAIRS)
    return [(int(some[at]), int(partner[at])) for at in few[seen.lit(partner[few])]]


def _angles_finding(source: ScanSource, degrees: NDArray[np.float64], turn: _Turn, mirrored: bool) -> Finding:
    half, whole = ("half a turn", 180.0) if mirrored else ("a turn", 360.0)
    counted = _counted(degrees)
    known = [factor for factor in _FACTORS if abs(turn.degrees - whole * factor) < np.ptp(degrees) / VIEWS]
    unit = (
        "they are 0, 1, 2 and so on, and count the views"
        if counted
        else f"they look like gradians: {half} is {whole / 0.9:g}"
        if known == [_FACTORS[0]]
        else f"they look {whole / turn.degrees:.3g} times as large as stated"
    )
    pairs = (
        f"Frames {turn.alike[0]} and {turn.alike[1]} are {'mirror images' if mirrored else 'alike'}, as views {half} "
        f"apart are, and are stated to be {turn.degrees:.4g} degrees apart"
    )
    if turn.stated is not None:
        pairs += f"; frames {turn.stated[0]} and {turn.stated[1]}, stated {whole:g} degrees apart, are not"
    # A plan is of our own scans, whose angles are in degrees. Without views stated half a turn apart, a sample that is
    # symmetric may look so, too; and mistakes are by one of these factors, while a sample that moves may show any.
    sure = not source.plan and turn.stated is not None and (counted or bool(known))
    which = "The" if sure else "Unless the sample moved or is symmetric, the"
    return Finding(
        "error" if sure else "warning",
        "angle-spread",
        f"{pairs}. {which} angles are not in degrees: {unit}. Give them in degrees with --angles FILE (one a line).",
    )


def _counted(degrees: NDArray[np.float64]) -> bool:
    return bool(np.allclose(np.sort(degrees), np.arange(degrees.size)))


def _unlike_moved(a: NDArray[np.float64], b: NDArray[np.float64], farthest: int) -> NDArray[np.float64]:
    """1 minus the correlation [move] of images where b lies up to so many columns to the left or right: first by whole
    columns, ascending, then by fractions, of which both images take half."""
    curves = []
    for half in np.arange(_PARTS) / (2 * _PARTS):
        c, d = ((1 - half) * a[:, :-1] + half * a[:, 1:], half * b[:, :-1] + (1 - half) * b[:, 1:]) if half else (a, b)
        curves.append(1 - _correlations(c, d, np.arange(-farthest + (half > 0), farthest + 1)))
    return np.concatenate(curves)


def _correlations(a: NDArray[np.float64], b: NDArray[np.float64], moves: NDArray[np.int64]) -> NDArray[np.float64]:
    """Correlation [move] of the columns that both images [row, col] have where b lies so many columns to the left, each
    row less its mean there; 0 where there is nothing."""
    cols = np.arange(a.shape[1])
    n, at = cols.size - np.abs(moves), cols[:, None] - cols + cols.size - 1

    def sums(values: NDArray[np.float64], begin: NDArray[np.int64]) -> NDArray[np.float64]:
        total = np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(values, axis=-1)], axis=-1)
        return np.asarray(total[..., begin + n] - total[..., begin])

    together = np.bincount(at.ravel(), (a.T @ b).ravel())[moves + cols.size - 1]
    begins = np.maximum(moves, 0), np.maximum(-moves, 0)
    rows = [sums(image, begin) for image, begin in zip((a, b), begins, strict=True)]
    whole = [(image * image).sum(axis=0) for image in (a, b)]
    power = [sums(w, begin) - (r * r).sum(axis=0) / n for w, begin, r in zip(whole, begins, rows, strict=True)]
    seen = np.logical_and(*(p > _ROUNDING * w.sum() for p, w in zip(power, whole, strict=True)))
    both = np.where(seen, power[0] * power[1], 1.0)
    return np.asarray(np.where(seen, (together - (rows[0] * rows[1]).sum(axis=0) / n) / np.sqrt(both), 0.0))
