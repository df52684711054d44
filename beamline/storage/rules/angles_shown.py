"""Rules that compare stated angles with images: projections look the same if, and only if, their angles say that they
see the same rays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import count
from beamline.monitor.evidence import lit_places
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.illumination import LEAST, VIEWS, brightness
from drivers.base.frame import FrameKind
from recon.base.views import spread
from recon.prep.align import mirror_mismatch
from recon.prep.unmeasured import DARK

_LEAST_SEEN = 8  # fewest projections, and fewest columns, with which a rotation is visible
# share of 180 degrees, and number of steps: if the projection that is sought is spoilt, nearer ones look similar
OTHER = 0.08
_FACTORS = 2.0, 0.5  # factors on the stated angles: twice or half the rotation, because of a gear or its pulses
PAIRS = 6  # number of projections that are compared with the projection at 180 degrees
# factor on the difference: twice as far apart in angle, because the difference grows with the square of a small
# rotation
UNLIKE = 4.0
_FINE = 90  # share of the range of angles: neighbours within it show how much a small rotation changes a projection
_AROUND = 9  # number of projections that are compared around the best of a first selection
_LEAST_INTENSITY = 1e-3  # share of the beam
# steps: projections that are at least so far apart count as distant, and up to so far as neighbours
_FAR, _NEXT = 4.0, 1.5
_SINGLE = 0.1  # share of the projections: if so few angles are wrong, they are named one by one
_MIRRORED = 0.5  # how much the sums of directions agree, from 0 (evenly spread, as for frames taken in passes) to 1
# share of some projections that look like distant ones, if the frames are in another order
_MOST = 0.75
# fewest frames at one angle; ratio of the difference from the first frame: 1 if the stage stands still, 4 after two
# steps
_STANDS, _TURNED = 3, 2.0
_EQUAL = 1e-6  # 1 minus the correlation of equal frames; rounding changes it a little
ORDER = "angle-order"
Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class CoarseViews:
    """Coarse line integrals of projections of a scan, each read once.

    Attributes:
        rows: the projections that have an angle and can be read, in the order of the file.
        degrees: float64 [frame], the stated angles.
    """

    scan: ScanEvidence
    rows: NDArray[np.int64]
    degrees: NDArray[np.float64]
    _depths: dict[int, NDArray[np.float64]] = field(default_factory=dict)

    def depth(self, row: int) -> NDArray[np.float64]:
        """Line integrals [row, col] of a projection, minus the mean of each row, smoothed along the rows. The smoothing
        removes two columns.
        """
        if row not in self._depths:
            lines = self._lines(row)
            lines = (lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:]) / 4
            self._depths[row] = lines - lines.mean(axis=1, keepdims=True)
        return self._depths[row]

    def _lines(self, row: int) -> NDArray[np.float64]:
        cells = self.scan.frame(row).places
        if self.scan.dark_and_flat is None:
            return np.nan_to_num(cells.astype(np.float64))
        dark, flat = self.scan.dark_and_flat
        beam = np.nan_to_num(flat - dark)
        least = _LEAST_INTENSITY * max(float(beam.max()), 1e-30)
        intensity = np.nan_to_num(cells - dark)
        return np.asarray(-np.log(np.maximum(intensity, least) / np.maximum(beam, least)), np.float64)

    def _has_beam(self, row: int) -> bool:
        if self.scan.dark_and_flat is None:
            return bool(np.ptp(self._lines(row)))
        cells, (dark, flat) = self.scan.frame(row).places, self.scan.dark_and_flat
        # something that is opaque from top to bottom is not part of the sample
        if (bright := lit_places(flat - dark)).any():
            posts = ((cells - dark < DARK * (flat - dark)) | ~bright).all(axis=0) & bright.any(axis=0)
            if posts.any():
                return False
        return brightness(cells, dark, flat) > LEAST * self.scan.illumination.brightest

    def with_beam(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool [view], True if the projection has beam and shows a sample."""
        return np.array([self._has_beam(row) for row in rows.tolist()], np.bool_)

    def pairs_with_beam(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> list[Pair]:
        """A few of the pairs of projections, evenly spread. Both projections of a pair have beam."""
        chosen = spread(np.arange(first.size), PAIRS)
        chosen = chosen[self.with_beam(first[chosen]) & self.with_beam(second[chosen])]
        return list(zip(first[chosen].tolist(), second[chosen].tolist(), strict=True))

    def mismatch(self, pair: Pair, mirrored: bool = False) -> float:
        """1 minus the correlation of two projections. To compare mirror images, the second projection is mirrored about
        the column with the best agreement. This column is searched for in the middle half of the detector. If the best
        column is at the edge of this half, the whole width is searched.
        """
        first, second = self.depth(pair[0]), self.depth(pair[1])
        if not mirrored:
            norm = float(np.linalg.norm(first) * np.linalg.norm(second))
            return 1 - float((first * second).sum()) / norm if norm > 0 else 1.0
        half_cols = np.arange(0, first.shape[1] - 0.9, 0.5)  # half columns, because edges are sharp
        first, second = (
            np.stack([np.interp(half_cols, half_cols[::2], row) for row in image]) for image in (first, second)
        )
        cols = first.shape[1]
        for reach in (cols // 4, cols // 2):
            curve = mirror_mismatch(first, second, (cols - 1 + np.arange(-reach, reach + 1)) / 2)
            lowest = int(np.argmin(curve))
            if 0 < lowest < 2 * reach:
                mismatch_below, mismatch_lowest, mismatch_above = curve[lowest - 1 : lowest + 2]
                return max(
                    float(
                        mismatch_lowest
                        - (mismatch_below - mismatch_above) ** 2
                        / 8
                        / max(mismatch_below - 2 * mismatch_lowest + mismatch_above, 1e-12)
                    ),
                    0.0,
                )
        return float(curve.min())

    def mismatches(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """[view, view] `mismatch` for each pair of these projections."""
        depths = np.stack([self.depth(row).ravel() for row in rows.tolist()])
        norms = np.array([np.linalg.norm(depth) for depth in depths])
        products = np.stack([(depth * depths).sum(axis=1) for depth in depths])
        powers = np.multiply.outer(norms, norms)
        return 1 - np.divide(products, powers, out=np.zeros_like(powers), where=powers > 0)

    def typical_mismatch(self, pairs: Sequence[Pair]) -> float:
        """Median of `mismatch` over the pairs."""
        return float(np.median([self.mismatch(pair) for pair in pairs]))


def coarse_views(scan: ScanEvidence) -> CoarseViews | None:
    """The coarse projections of a scan. None if there are too few projections, or if their line integrals are
    unknown.
    """
    views = scan.table.views_with_angles
    if scan.source.quantity == "unknown" or scan.table.shifts is not None:
        return None
    references_missing = scan.in_counts and not scan.table.has(FrameKind.DARK, FrameKind.FLAT)
    if references_missing or min(scan.source.shape[1], views.size) < _LEAST_SEEN:
        return None
    _ = scan.illumination.brightest  # some of these frames may turn out to be unreadable
    views = np.array([row for row in views.tolist() if row not in scan.source.unreadable], np.int64)
    return CoarseViews(scan, views, np.degrees(scan.table.angles)) if views.size >= _LEAST_SEEN else None


def angles_shown(scan: ScanEvidence) -> Iterator[Finding]:
    """The projections agree with the rotation and with the order of angles that the file states."""
    if (coarse := coarse_views(scan)) is not None:
        yield from stage_stands_still(coarse)
        yield from rotation_matches_images(coarse)
        yield from angles_in_order(coarse)


def stage_stands_still(coarse: CoarseViews) -> Iterator[Finding]:
    """Consecutive frames with the same stated angle look the same, as frames do that are to be averaged.

    If the stage kept rotating, the last frame differs from the first one by more than neighbouring frames do: the
    squared difference grows with the square of the rotation.
    """
    degrees = coarse.degrees[coarse.rows]
    starts = np.flatnonzero(np.diff(degrees, prepend=np.nan) != 0)
    lengths = np.diff(starts, append=degrees.size)
    runs = spread(np.flatnonzero(lengths >= _STANDS), PAIRS)
    first, second, last = (coarse.rows[starts[runs] + offset] for offset in (0, 1, lengths[runs] - 1))
    if not runs.size or not (coarse.with_beam(first) & coarse.with_beam(last)).all():
        return
    neighbour_mismatch, end_mismatch = (
        max(_EQUAL, coarse.typical_mismatch(list(zip(first.tolist(), frames.tolist(), strict=True))))
        for frames in (second, last)
    )
    if end_mismatch > _TURNED * neighbour_mismatch:
        n = int(np.median(lengths[lengths >= _STANDS]))
        first_of_each = (
            f" Or use the first projection of each angle: --frames 0::{n}." if (lengths[:-1] == n).all() else ""
        )
        one_frame = first[0]
        other_frame = last[0]
        start = degrees[0]
        stated_degrees = coarse.degrees[first[0]]
        times = end_mismatch / neighbour_mismatch
        yield Finding(
            "warning",
            "angle-spread",
            f"Give the angle of each of the {degrees.size} projections with --angles FILE (degrees, one per line), "
            f"from {start:.6g} in equal steps if the stage rotated evenly.{first_of_each} The scan file states the "
            f"same angle for {n} frames at a time, but the stage rotated between these frames: frames {one_frame} and "
            f"{other_frame}, both at {stated_degrees:.6g} degrees, differ {times:.2g} times as much as neighbouring "
            "frames. The scan probably took frames faster than it read the angles.",
        )


def rotation_matches_images(coarse: CoarseViews) -> Iterator[Finding]:
    """Parallel projections are mirror images if, and only if, their angles are 180 degrees apart.

    A ray measures the same from both sides. This is true for any sample, even one that is wider than the field of view.
    The difference between neighbouring projections shows how a rotation, and noise, changes the projections of this
    sample: a round sample looks the same at all angles.
    """
    if coarse.scan.cone is not None:
        return
    views = coarse.rows[np.argsort(coarse.degrees[coarse.rows], kind="stable")]
    sampled = _sampled_with_beam(coarse, views)
    stated = coarse.degrees[sampled]
    if np.unique(stated).size < _LEAST_SEEN:
        return
    small_rotation = max(np.ptp(stated) / _FINE, float(np.median(np.diff(np.unique(coarse.degrees[views])))))
    neighbours = _nearest(coarse, views, stated + small_rotation)
    chosen = spread(np.flatnonzero(neighbours != sampled), PAIRS)
    if not chosen.size:
        return
    neighbour_mismatch = coarse.typical_mismatch(
        list(zip(sampled[chosen].tolist(), neighbours[chosen].tolist(), strict=True))
    )
    if (turn := _mirror_images(coarse, views, sampled, neighbour_mismatch)) is not None:
        yield _angles_finding(coarse.scan, coarse.degrees[views], turn)


def _sampled_with_beam(coarse: CoarseViews, views: NDArray[np.int64]) -> NDArray[np.int64]:
    sampled = spread(views, VIEWS)
    return sampled[coarse.with_beam(sampled)]


def _nearest(coarse: CoarseViews, views: NDArray[np.int64], degrees: NDArray[np.float64]) -> NDArray[np.int64]:
    """The projection whose stated angle is nearest to each of these angles."""
    return views[np.abs(coarse.degrees[views] - degrees[:, None]).argmin(axis=1)]


@dataclass(frozen=True)
class _Turn:
    """A pair of frames that look 180 degrees apart, and a pair whose stated angles are 180 degrees apart. None: there
    is no such pair.
    """

    alike: Pair
    degrees: float
    stated: Pair | None


def _mirror_images(
    coarse: CoarseViews, views: NDArray[np.int64], sampled: NDArray[np.int64], neighbour_mismatch: float
) -> _Turn | None:
    """Pairs of projections that look the same after a wrong angle, if those that should look the same do not.

    Args:
        views, sampled: all projections, and some of them, by ascending angle.
        neighbour_mismatch: how much the neighbours of the selected projections differ.
    """
    degrees = coarse.degrees
    step = float(np.ptp(degrees[sampled])) / (sampled.size - 1)
    partner = _nearest(coarse, views, degrees[sampled] + 180)
    pair_tolerance = min(float(np.median(np.diff(np.unique(degrees[views])))), step)
    # if the stated step is 180 degrees or more, a projection may be the nearest to its own partner
    pairs = (partner != sampled) & (np.abs(degrees[partner] - degrees[sampled] - 180) <= pair_tolerance)
    stated = coarse.pairs_with_beam(sampled[pairs], partner[pairs])
    # The most similar pairs decide: a loose particle makes one pair different, wrong angles make all pairs different.
    stated_mismatch = min((coarse.mismatch(pair, mirrored=True) for pair in stated), default=np.inf)
    if stated_mismatch < 2 * UNLIKE * neighbour_mismatch:
        return None
    first, last, quarter = int(sampled[0]), int(sampled[-1]), sampled.size // 4
    ends = [(first, row) for row in sampled[quarter:].tolist()] + [(last, row) for row in sampled[1:-quarter].tolist()]
    differences = np.array([coarse.mismatch(pair, mirrored=True) for pair in ends])
    usual_mismatch, (end, similar) = float(np.median(differences)), ends[int(np.argmin(differences))]
    around = spread(views[(np.abs(degrees[views] - degrees[similar]) < step) & (views != end)], _AROUND).tolist()
    best, nearest = min((coarse.mismatch((end, row), mirrored=True), row) for row in around)
    rotation, tolerance = abs(float(degrees[nearest] - degrees[end])), max(OTHER * 180, 2 * step)
    distances = np.array([abs(degrees[second] - degrees[first]) for first, second in ends])
    stated_mismatch = min([stated_mismatch, *differences[np.abs(distances - 180) <= tolerance]])
    if abs(rotation - 180) <= tolerance or not best < min(
        2 * neighbour_mismatch, stated_mismatch / UNLIKE, usual_mismatch / UNLIKE
    ):
        return None
    return _Turn((min(end, nearest), max(end, nearest)), rotation, stated[len(stated) // 2] if stated else None)


def _angles_finding(scan: ScanEvidence, degrees: NDArray[np.float64], turn: _Turn) -> Finding:
    known_factors = [factor for factor in _FACTORS if abs(turn.degrees - 180 * factor) < np.ptp(degrees) / VIEWS]
    counts_up = np.allclose(degrees, np.arange(degrees.size))
    if counts_up:
        unit = "the values are 0, 1, 2 and so on, so they are frame numbers"
    else:
        times = 180 / turn.degrees
        unit = f"the true angles are probably {times:.3g} times the stated angles"
    pairs = (
        f"Two projections that are 180 degrees apart are mirror images of each other. Frames {turn.alike[0]} and "
        f"{turn.alike[1]} are mirror images, but their stated angles differ by {turn.degrees:.4g} degrees"
    )
    if turn.stated is not None:
        pairs += (
            f". Frames {turn.stated[0]} and {turn.stated[1]}, whose stated angles differ by 180 degrees, are not "
            "mirror images"
        )
    # A plan belongs to a scan of this program, whose angles are in degrees. If no projections have stated angles 180
    # degrees apart, a symmetric sample may look the same, too. Mistakes are by one of these factors, while a moving
    # sample may repeat after any angle.
    certain = not scan.source.plan and turn.stated is not None and (counts_up or bool(known_factors))
    which = "The" if certain else "Unless the sample moved or is symmetric, the"
    return Finding(
        "error" if certain else "warning",
        "angle-spread",
        f"{pairs}. {which} angles are not in degrees: {unit}. Give the angles in degrees with --angles FILE (one per "
        "line).",
    )


def angles_in_order(coarse: CoarseViews) -> Iterator[Finding]:
    """Consecutive frames look similar only if their angles are close, and close angles look similar.

    The rule finds a list of angles in another order than the frames, and single wrong angles. If the list is shifted,
    this is visible only where the angles jump, so the rule checks these places.
    """
    rows, degrees = coarse.rows, coarse.degrees[coarse.rows] % 360
    order = np.argsort(degrees, kind="stable")
    gaps = np.diff(degrees[order])
    if not (gaps > 0).any():
        return
    step = float(np.median(gaps[gaps > 0]))
    jumps = np.flatnonzero(np.abs((np.diff(degrees) + 180) % 360 - 180) > _FAR * step)
    close = np.flatnonzero((gaps <= _NEXT * step) & (np.abs(np.diff(order)) > 1))
    distant_pairs = coarse.pairs_with_beam(rows[jumps], rows[jumps + 1])
    close_pairs = coarse.pairs_with_beam(rows[order[close]], rows[order[close + 1]])
    if (
        distant_pairs
        and close_pairs
        and coarse.typical_mismatch(close_pairs) > UNLIKE * coarse.typical_mismatch(distant_pairs)
    ):
        yield _in_another_order(coarse, jumps, distant_pairs[0], close_pairs[0])
    elif (finding := _alike_elsewhere(coarse, rows[order])) is not None:
        yield finding


def _alike_elsewhere(coarse: CoarseViews, rows: NDArray[np.int64]) -> Finding | None:
    """True if most projections look more like a distant projection than like their neighbours. `rows` are in ascending
    order of angle.

    Test on two measured scans (the tooth, Diamond) that were reordered as if taken in 2, 3, 4 and 6 passes: the rule
    finds 5 of these 8, but not the two with 2 passes. In the original order it reports neither scan.
    """
    sampled = _sampled_with_beam(coarse, rows)
    if sampled.size < PAIRS:
        return None
    degrees = coarse.degrees[sampled] % 360
    mismatch = coarse.mismatches(sampled)
    distances = np.abs((degrees - degrees[:, None] + 180) % 360 - 180)
    distant_mismatches = np.where(
        distances > max(OTHER * 180, 2 * float(np.median(np.diff(degrees)))), mismatch, np.nan
    )
    if not np.isfinite(distant_mismatches).any():
        return None
    usual_mismatch, next_mismatches = float(np.nanmedian(distant_mismatches)), np.diagonal(mismatch, 1)
    distant_mismatches = np.nan_to_num(distant_mismatches, nan=np.inf)
    most_similar, neighbour_mismatches = (
        distant_mismatches.argmin(axis=1),
        np.minimum(np.append(next_mismatches, np.inf), np.append(np.inf, next_mismatches)),
    )
    misplaced = distant_mismatches.min(axis=1) < np.minimum(neighbour_mismatches, usual_mismatch / UNLIKE)
    # A sample with a plane of symmetry looks the same from directions that mirror each other: the sums of such
    # directions are equal.
    sums = np.radians(degrees[misplaced] + degrees[most_similar[misplaced]])
    if misplaced.mean() < _MOST or abs(np.exp(1j * sums).mean()) > _MIRRORED:
        return None
    first = int(np.flatnonzero(misplaced)[0])
    pair = int(sampled[first]), int(sampled[most_similar[first]])
    return Finding(
        "warning",
        ORDER,
        f"{_stated(coarse, pair)} look more similar than neighbouring frames do. {misplaced.sum()} of the "
        f"{sampled.size} compared projections look like a projection at a distant angle. If the sample is not "
        "symmetric, either the angles are not in the order of the frames, or the sample rotated further than the "
        "angles state.",
    )


def _stated(coarse: CoarseViews, pair: Pair) -> str:
    first, second = coarse.degrees[list(pair)]
    return f"Frames {pair[0]} and {pair[1]}, stated at {first:.6g} and {second:.6g} degrees,"


def _in_another_order(coarse: CoarseViews, jumps: NDArray[np.int64], far: Pair, near: Pair) -> Finding:
    text = f"{_stated(coarse, far)} look similar, but f{_stated(coarse, near)[1:]} do not. "
    single = np.intersect1d(jumps, jumps + 1)  # between two jumps of the angles
    if single.size and jumps.size == 2 * single.size and single.size <= _SINGLE * coarse.rows.size:
        wrong = ", ".join(
            f"frame {row} ({coarse.degrees[row]:.6g} degrees)" for row in coarse.rows[single[:5]].tolist()
        )
        text += (
            f"In {count(single.size, 'projection')} the angle is not between the angles of the neighbouring "
            f"projections: {wrong}. "
        )
        return Finding("warning", ORDER, text + "Give the right angles with --angles FILE (degrees, one per line).")
    text += (
        "The angles are not in the order of the frames. Give one angle for each projection, in the order of the "
        "projections, with --angles FILE."
    )
    return Finding("warning" if coarse.scan.source.plan else "error", ORDER, text)
