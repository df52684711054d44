"""Rules on stated angles: every projection has one, they are in degrees, and together they cover 180 degrees."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import count
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from recon.base.units import gone_round, look_like_degrees
from recon.voxels.view_weights import angular_weights

FARTHEST = 1e6  # degrees
_GAP = 0.5  # degrees without a projection, beyond the normal spacing; for projections in equal steps
_UNWEIGHED = 9.0  # degrees that no weight of a projection covers: FBP then loses a twentieth of the density
_SAME = 0.1  # share of the mean step: projections that are closer count as one
_EQUAL, _FEW = 1e-3, 4  # degrees between projections that count as one direction; detector columns per direction
_FALSE_ALARM = 1e-3  # share of scans with random angles that may be reported
# standard deviation of random gaps, without the largest gap, divided by their mean
_OF_MEAN = 0.8
_COUNTED = " The values are 0, 1, 2 and so on: are these values frame numbers?"
_LISTED = 20  # most groups of frames that a sentence lists
_MANY = 30  # number of projections: a smaller scan within 6.28 degrees may be a test, and is not reported as radians


def angles_unknown(scan: ScanEvidence) -> str:
    """Every projection has a finite angle; otherwise the finding names the projections without one."""
    unknown = np.setdiff1d(views := scan.table.views, scan.table.views_with_angles)
    reason = f"; {reason}" if (reason := scan.source.attributes.get("angles")) else ""
    runs = np.split(unknown, np.flatnonzero(np.diff(unknown) > 1) + 1)
    listed = "+".join(f"{run[0]}:{run[-1] + 1}" for run in runs[:_LISTED] if run.size) + "+..." * (len(runs) > _LISTED)
    if not unknown.size:
        return ""
    first_frame, have = unknown[0], "has" if unknown.size == 1 else "have"
    return (
        f"{count(unknown.size, 'projection')} of {views.size} {have} no angle (first: frame {first_frame}){reason}. "
        "Give the angles with --angles FILE (degrees, one per "
        f"line){f', or leave these projections out: --frames none={listed}' * (unknown.size < views.size)}."
    )


def angles_spread(scan: ScanEvidence) -> Iterator[Finding]:
    """The projections have different directions over 180 degrees, and their angles can be in degrees."""
    angles = scan.table.angles[scan.table.views]
    if angles.size < 2 or not np.isfinite(angles).all():
        return
    farthest = float(np.abs(angles).max()) * 180 / np.pi
    if farthest > FARTHEST:
        yield Finding(
            "error",
            "angle-spread",
            f"Check the unit of the angles, and give the right angles with --angles FILE (degrees, one per line): "
            f"the angles of the projections reach {farthest:.3g} degrees. At most {FARTHEST:g} degrees are allowed, "
            "because larger angles have too large rounding errors.",
        )
        return
    degrees = np.asarray(np.degrees(angles), np.float64)
    span = float(np.ptp(degrees))
    distinct = np.unique(np.round(degrees, 6))
    if distinct.size == 1:
        only_angle = distinct[0]
        yield Finding(
            "error",
            "angle-spread",
            f"All {angles.size} projections have the same angle, {only_angle:g} degrees. Give the right angles with "
            "--angles FILE (degrees, one per line).",
        )
        return
    step = span / (distinct.size - 1)
    if (text := _why_not_degrees(angles, distinct)) is not None:
        # A plan belongs to a scan of this program, whose angles are in degrees.
        yield Finding("warning" if scan.source.plan else "error", "angle-spread", text)
    elif (unseen := degrees_without_projection(angles)) > 0:
        span_text = f"span {span:.2f} degrees, less than 180" if span + step < 180 else "do not cover 180 degrees"
        yield Finding(
            "warning",
            "angle-spread",
            f"The projections {span_text} (limited angle): in {unseen:.4g} of 180 degrees there is no "
            "projection." + (_COUNTED if not scan.source.plan and np.allclose(degrees, np.arange(angles.size)) else ""),
        )
    elif scan.cone is None and (n := directions(angles)) <= min((distinct.size + 1) / 2, scan.source.shape[1] / _FEW):
        n_cols = scan.source.shape[1]
        yield Finding(
            "warning",
            "angle-spread",
            f"Compare with --method fista-tv, because FBP leaves streaks: the {distinct.size} projections show only "
            f"{n} directions, too few for {n_cols} columns. With steps of {step:.4g} degrees many projections are "
            "180 degrees apart, and projections 180 degrees apart measure the same rays. Next time, use a step that "
            "does not divide 180 degrees.",
        )


def directions(angles: NDArray[np.float64]) -> int:
    """The directions of the rays of parallel projections [view], in rad. Projections that are 180 degrees apart have
    the same direction.
    """
    degrees = np.mod(np.degrees(angles), 180.0)
    return int(np.unique(np.round(np.where(degrees > 180.0 - _EQUAL, 0.0, degrees) / _EQUAL)).size)


def degrees_without_projection(angles: NDArray[np.float64]) -> float:
    """How much of the 180 degrees has no projection, beyond the normal spacing of the projections: the largest gap, or
    all gaps together. `angles` are [view], in rad.

    All gaps are added up if `angular_weights` regards them as missing projections and they are together at least a
    twentieth of 180 degrees.

    Projections that are 180 degrees apart see the same rays. If angles are random, the largest gap exceeds the second
    largest by an exponentially distributed amount, whose mean is the mean gap (Rényi 1953). With random angles, the
    allowed gap is exceeded by 2 in 1000 scans with 45 or more projections, and by 1 in 100 scans with ten projections.
    If the angles are evenly spaced, a gap that is larger than the others by half a degree is reported.
    """
    sorted_degrees = np.sort(np.mod(np.degrees(angles), 180.0))
    gaps = np.diff(sorted_degrees, append=sorted_degrees[0] + 180.0)
    gaps = gaps[gaps > _SAME * 180.0 / sorted_degrees.size]  # neighbouring projections count as one
    if gaps.size < 2:
        return 180.0
    *smaller, second, largest = np.sort(gaps)
    mean_gap = float(np.std([*smaller, second])) / _OF_MEAN
    n = len(smaller) + 1
    # 6.9 mean gaps, if the mean gap is known; more if it is estimated from n gaps
    factor = n * (_FALSE_ALARM ** (-1 / n) - 1)
    limit = second + max(_GAP, factor * mean_gap)
    if not np.isclose(largest, 180.0 - np.ptp(np.degrees(angles)), atol=_GAP):
        # only between the first and the last projection: a single lost projection is not a missing wedge
        limit = max(limit, 2 * float(np.median(gaps)) + _GAP)
    without_weight = 180.0 - float(np.degrees(angular_weights(angles).sum()))
    return max(float(largest) if largest > limit else 0.0, without_weight if without_weight > _UNWEIGHED else 0.0)


def _why_not_degrees(angles: NDArray[np.float64], distinct: NDArray[np.float64]) -> str | None:
    """A sentence that says why angles [view], which were read as degrees and converted to rad, cannot have been in
    degrees. None if they can.

    Args:
        distinct: the different angles in degrees, ascending.
    """
    between = float(np.median(np.abs(np.diff(np.degrees(angles)))))
    if look_like_degrees(angles):
        n_turns = np.ptp(distinct) / 360
        span_rad = np.ptp(angles)
        return (
            f"The stated angles of {angles.size} projections span {n_turns:.1f} turns ({span_rad:.5g} rad). These "
            "angles look like degrees that are labelled as radians. If the values are degrees, give the angles with "
            "--angles FILE (degrees, one per line)."
        )
    if between >= 360:
        first_angle = distinct[0]
        last_angle = distinct[-1]
        return (
            f"The projections go from {first_angle:.6g} to {last_angle:.6g} degrees in steps of {between:.4g}, a "
            "whole turn or more. These values look like counts of an encoder or of motor steps. Give the angles in "
            "degrees with --angles FILE (one per line). If the values are degrees, subtract whole turns."
        )
    if (unit_sentence := _smaller_unit(distinct, angles.size)) is not None:
        return (
            f"{angles.size} projections span only {np.ptp(distinct):.4g} degrees, so {unit_sentence} Give the angles "
            "in degrees with --angles FILE (one per line), or add --angles-unit rad."
        )
    return None


def _smaller_unit(degrees: NDArray[np.float64], n: int) -> str | None:
    """The true quantity of n angles that are labelled as degrees (distinct and ascending). None if they can be
    degrees.
    """
    if part := gone_round(degrees, 2 * np.pi):
        return (
            f"the angles look like radians, in which {'180 degrees are' if part < 4 else '360 degrees are'} {part:.5g}."
        )
    return "the angles look like radians or turns." if n > _MANY and np.ptp(degrees) <= 2 * np.pi else None
