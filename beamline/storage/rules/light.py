"""Rules on intensity: flats and darks must be usable and match the projections; otherwise, what else may explain
their counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import Finding
from beamline.monitor.evidence import BRIGHT, DRIFT, lights_in_turn, lit_places, place_noise
from beamline.monitor.references import LIT, LIT_SIGMAS, ReferenceLimits
from beamline.storage.readers.base import read_known
from beamline.storage.readers.no_data import counts_photons
from beamline.storage.readers.transforms import frames_by_energy, in_words, selected
from beamline.storage.rules.evidence import EXPOSURE_TOLERANCE, ScanEvidence
from recon.base.arrays import F32, F64, I64
from recon.base.noise import deviation_between_frames
from recon.base.views import spread

VIEWS = 8  # frames that are examined
# largest share of a projection's pixels that have its smallest, and its largest, value, if projections were rescaled
# one by one
AT_THE_ENDS = 1e-3
ALIKE = 6  # most pixels that have the same count by chance before the rescaling
SPREAD = 16  # fewest grey values between smallest and largest value, if values are integers
# line integral of air: the beam of Diamond 24737 lost 0.39 between its flats and its projections, other scans 0.02
WARN = 0.45
REFUSE = 0.65  # half of the intensity; drift, decay and top-up do not change it so much; see ReferenceLimits.light_gone
BRIGHTER = 0.2  # line integral: a refill of the storage ring makes projections brighter than their flats by this much
# ratio of the noise; 67 random scans have 0.3 to 0.98, because structure of the sample adds to the noise of projections
NOISIER = 1.5
ROWS, LEAST_FLATS = 128, 3  # frames whose noise is examined
TILE, QUIET = 8, 20.0  # side of a tile in pixels, with which the variance is known to a fifth; percentile of the tiles
BELOW, OF_VIEWS = (
    0.005,
    0.25,
    # shares of the places with beam, and of the projections, that lie below the darks; smaller shares may be zingers or
    # lost rows
)
# errors of flats and darks, as shares of the intensity, whose effect a message states if no air is visible
BRIGHTER_FLATS, HIGHER = 0.1, 0.01
"""Limits and their reasons."""


def references_usable(scan: ScanEvidence) -> Iterator[Finding]:
    """Flats have beam, and are complete and even. Darks are dark. A faulty group is left out if there is a good group.

    The finding is an error if all groups of a kind have a fault and the user has not accepted them. Otherwise it is a
    warning.
    """
    for finding in scan.findings:
        message = finding.message
        if finding.frames:
            name = f"{scan.table.kind(finding.frames[0]).name.lower()}s"
            if scan.request.accepted:
                message = f"--references accept: {message}"
            elif finding.severity == "error":
                message += (
                    f" Do not reconstruct the scan with these {name}: take new {name}, or give other {name} with "
                    f"--{name}. `beamline recon --references accept` uses the faulty {name} as they are."
                )
            else:
                message += f" The other {name} are used instead."
        severity = "warning" if scan.request.accepted else finding.severity
        yield replace(finding, severity=severity, rule="bad-references", message=message)


def views_scaled(scan: ScanEvidence) -> Iterator[Finding]:
    """Finds projections that were rescaled one by one: all of them have the same smallest value and the same largest
    value, at different pixels.
    """
    rows = scan.table.views
    if rows.size < VIEWS:
        return
    extremes, extreme_pixels = set(), (set[int](), set[int]())
    for row in spread(rows, VIEWS).tolist():
        view = read_known(scan.source, [row])[0]
        low, high = float(view.min()), float(view.max())
        extremes.add((low, high))
        integers = view.dtype.kind in "ui"
        if len(extremes) > 1 or not high - low >= (SPREAD if integers else 1e-30):
            return
        if max(np.count_nonzero(view == low), np.count_nonzero(view == high)) > max(ALIKE, AT_THE_ENDS * view.size):
            return
        extreme_pixels[0].add(int(view.argmin()))
        extreme_pixels[1].add(int(view.argmax()))
    if min(map(len, extreme_pixels)) == 1:  # a dead or a hot pixel
        return
    low, high = extremes.pop()
    yield Finding(
        "error",
        "light",
        "Use the images as the camera wrote them, or scale all images by the same factor. Here each image seems to "
        "be scaled by a factor of its own, as some programs do when they save pictures. The same grey value then "
        f"means a different attenuation in each projection. The pixels show this: in each of {VIEWS} projections "
        f"checked, the darkest pixel is {low:g} and the brightest {high:g}, but these pixels are at different places "
        "in each projection.",
    )


def check_air_level(scan: ScanEvidence, level: float, air: bool, accepted: bool = False) -> Iterator[Finding]:
    """The air in projections is as bright as in their flats, apart from the usual drift of the beam during a scan.

    Args:
        level: line integral of the air, median over the projections. If there is no air: line integral of the place
            that absorbs least.
        air: True if air columns were found and their line integral was subtracted.
        accepted: True if a fault is only a warning.
    """
    darker = level > WARN and air
    if darker or level < -BRIGHTER:
        place_text = "The air next to the sample" if air else "The least absorbing place in the projections"
        use_text = (
            "this difference is subtracted as a change of the beam"
            if air
            else "this difference is not subtracted, because it is not known which pixels next to the sample show air"
        )
        factor = math.exp(abs(level))
        dark_or_bright = "dark" if level > 0 else "bright"
        sentence = (
            f"{place_text} is {factor:.3g} times as {dark_or_bright} as the flats ({level:+.2f} in line integral; "
            f"{use_text}). During one scan a beam changes by a factor of up to {math.exp(WARN):.2g}, and a sample can "
            "only absorb. Were the projections, flats and darks taken with the same settings and stored in the same "
            f"way? {_counts_in_words(scan)}"
        )
        refused = abs(level) > REFUSE
        if darker:
            sentence += " If the sample is wider than the field of view and covers these columns, give --air none."
        if refused and not accepted:
            sentence += (
                " Give flats and darks with the settings of the projections, or --references accept, which uses the "
                "flats and darks as they are."
            )
        yield Finding("error" if refused and not accepted else "warning", "light", sentence)
    elif not air and (ratio := _noise_ratio(scan)) > NOISIER:
        yield Finding(
            "warning",
            "light",
            f"The flats have {ratio:.2g} times the noise of the projections (relative to their counts), but in "
            "images of one camera this ratio is 1. No air next to the sample shows whether the flats or the "
            f"projections are right. Were the flats and darks multiplied (by about {ratio:.2g}), or are the "
            f"projections means of several frames? {_counts_in_words(scan)}",
        )


def darks_beside_views(scan: ScanEvidence) -> Iterator[Finding]:
    """Darks are measured images, they are nowhere brighter than the projections, and air is not saturated."""
    if scan.dark_and_flat is None:
        return
    # there are zingers in single darks
    dark, mean_flat = np.min(scan.cells(np.concatenate(scan.used_references.darks)), axis=0), scan.dark_and_flat[1]
    same_group = max(scan.used_references.flats, key=len)[:2] if not dark.any() else np.zeros(0, np.int64)
    flats = read_known(scan.source, same_group).astype(np.float64)  # identical if one image was written for all of them
    if len(flats) > 1 and deviation_between_frames(flats) and not counts_photons(scan.source):
        yield Finding(
            "warning",
            "light",
            "All darks are 0, but the flats vary like flats that a camera recorded. Darks of 0 are right if the "
            "darks were already subtracted from the frames. Otherwise projections and flats include the camera's "
            "offset, which makes line integrals too small: give --darks.",
        )
    exposed = lit_places(mean_flat - dark)
    if not exposed.any():
        return
    intensity = float(np.percentile((mean_flat - dark)[exposed], BRIGHT))
    limit = max(LIT * intensity, LIT_SIGMAS * place_noise(dark))
    views = spread(scan.table.views, VIEWS)
    below_dark = [(dark - view)[exposed] for view in scan.cells(views)]
    depths = [float(np.percentile(each, 100 * (1 - BELOW))) for each in below_dark if np.isfinite(each).all()]
    if np.count_nonzero(np.array(depths) > limit) > OF_VIEWS * VIEWS:
        sentence = (
            f"The darks are too high: in places the projections have {max(depths):.3g} counts less than the "
            f"darks (limit {limit:.3g}; the beam gives {intensity:.4g} counts in the flats), but the beam can "
            "only add counts. Were the darks taken with beam, with another gain or exposure, or stored "
            "as sums of frames? Give --darks with the settings of the projections."
        )
        sentence += "" if scan.request.accepted else " --references accept uses the darks as they are."
        yield Finding("warning" if scan.request.accepted else "error", "light", sentence)


def _counts_in_words(scan: ScanEvidence) -> str:
    """Sentences about counts and exposures of flats and projections, at the place where projections are brightest."""
    views = spread(scan.table.views, VIEWS)
    darks, flats = (np.concatenate(groups) for groups in scan.used_references)
    view, flat, dark = (scan.mean_cells(rows) for rows in (views, flats, darks))
    exposed = lit_places(flat - dark)
    brightest = exposed & (view >= np.percentile(view[exposed], BRIGHT)) if exposed.any() else np.ones_like(exposed)
    counts = float(np.median(flat[brightest])), float(np.median(view[brightest]))
    flat_counts = counts[0]
    view_counts = counts[1]
    counts_text = f"Counts in these places: {flat_counts:.6g} in the flats, {view_counts:.6g} in the projections."
    return f"{counts_text} {_exposures_in_words(scan, flats, views)}"


def _exposures_in_words(scan: ScanEvidence, *rows: NDArray[np.int64]) -> str:
    """A sentence about the exposures that the file states for some flats and projections."""
    exposures = [scan.table.exposures[rows_of_kind] for rows_of_kind in rows]
    if all(np.isfinite(each).all() for each in exposures):
        words = [f"{np.median(each):g} s" for each in exposures]
        return f"Stated exposures: flats {words[0]}, projections {words[1]}."
    return (
        "Check whether flats and projections had the same exposure time: the file does not state both exposure times. "
        "If the exposure times differ, the line integrals are wrong."
    )


def without_air(scan: ScanEvidence, mean: float) -> str:
    """Sentences about the effect of wrong flats and darks on the mean line integral of projections, if no column shows
    air.

    A wrong factor in the intensity adds the same constant to every line integral. Material beyond the field of view may
    have the same effect. In cans 1.5 to 3 times as wide as the field of view, the densities of FBP change by 0.4 to 0.8
    times the relative change of the line integrals, and those of FISTA-TV by 0.9 times.
    """
    flats, views = scan.table.flats, scan.table.views
    more = math.log1p(BRIGHTER_FLATS)
    error = HIGHER * math.expm1(mean)
    relative_error = more / mean
    return (
        "Compare a density that you know: flats and darks cannot be checked, because no detector column shows air. "
        f"If the flats are {BRIGHTER_FLATS:.0%} too bright, every line integral is {more:.3f} too large "
        f"({relative_error:.0%} of the mean), and densities are too large by up to the same fraction. If the darks "
        f"are too high by {HIGHER:.0%} of the intensity, the mean line integral is about {error:.2g} too large. "
        f"{_exposures_in_words(scan, flats, views)}"
    )


def _noise_ratio(scan: ScanEvidence) -> float:
    """Variance divided by intensity, for the flats relative to the projections; 0 if it is not known.

    By photon transfer (Janesick 2007), variance divided by intensity is the same in all images of a camera. Structure
    of the sample adds to the variance of projections, so only their quietest tiles are used.
    """
    views = spread(scan.table.views, VIEWS)
    rows_of_kinds = [
        np.concatenate(scan.used_references.darks),
        spread(max(scan.used_references.flats, key=len), VIEWS),
        views,
    ]
    middle = scan.source.shape[0] // 2
    middle_rows = slice(max(middle - ROWS // 2, 0), middle + ROWS // 2)
    darks, flats, view_images = (
        read_known(scan.source, rows_of_kind, middle_rows).astype(np.float32) for rows_of_kind in rows_of_kinds
    )
    if len(flats) < LEAST_FLATS:
        return 0.0
    intensity = flats.mean(axis=0) - darks.mean(axis=0)
    intensity[~lit_places(intensity)] = np.nan
    flat_ratio, view_ratio = (
        np.median([_variance_per_count(image - darks.mean(axis=0), intensity) for image in kind])
        for kind in (flats, view_images)
    )
    ratio = float(flat_ratio / view_ratio) * len(flats) / (len(flats) - 1) if view_ratio > 0 else 0.0
    return ratio if math.isfinite(ratio) else 0.0


def _variance_per_count(net: F32, intensity: F32) -> float:
    """Variance of the counts divided by the counts, in the quietest tiles of an image; NaN if there are no such
    tiles.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.diff(np.diff(net / intensity, axis=0), axis=1)
        ratios = np.where(net > 0, intensity**2 / net, np.nan)[1:, 1:] * change**2 / 4
    rows, cols = (n // TILE for n in ratios.shape)
    if not rows or not cols:
        return math.nan
    tiles = ratios[: rows * TILE, : cols * TILE].reshape(rows, TILE, cols, TILE).mean(axis=(1, 3))
    known = tiles[np.isfinite(tiles)]
    return float(np.percentile(known, QUIET)) if known.size else math.nan


def exposures_agree(scan: ScanEvidence) -> Iterator[Finding]:
    """Darks have the exposure of the projections; or they have two exposures, from which the dark of any other exposure
    can be computed.
    """
    if not scan.in_counts:
        return
    usual = scan.usual_exposure
    darks, flats = (scan.table.exposures[rows] for rows in (scan.table.darks, scan.table.flats))
    if scan.views_differ:
        views = scan.table.exposures[scan.table.views]
        flats_stated = bool((flats > 0).all())
        flat_exposures = scan.exposures[scan.table.flats]
        assumed_exposure = np.nan_to_num(flat_exposures, nan=usual).max(initial=0.0)
        scaling = f"scaled to {usual:g} s" + (
            "."
            if flats_stated
            else f". The file does not state the exposure of the flats. The program assumes {assumed_exposure:g} s, "
            "because with this exposure no projection is brighter than the flats. If the sample fills the field of "
            "view, this exposure may be wrong. In that case all line integrals are wrong by the same amount."
        )
        yield Finding(
            "info" if flats_stated else "warning",
            "exposures",
            f"The projections were exposed for {views.min():g} to {views.max():g} s; the intensity of each projection "
            f"is {scaling}",
        )
    darks = darks[darks > 0]
    if darks.size and np.ptp(darks) <= EXPOSURE_TOLERANCE * usual < np.abs(darks - usual).max():  # never true for NaN
        dark_exposure = darks[0]
        yield Finding(
            "warning",
            "exposures",
            f"Take darks with the exposure of the projections: the darks were exposed for {dark_exposure:g} s and "
            f"the projections for {usual:g} s, so hot pixels and dark current differ.",
        )


# projections that are examined; largest step between them, because a wide sample looks different from other sides
_IN_A_ROW, _BESIDE = 12, np.radians(20.0)
# share of the intensity of the best step next to its flats; the sample absorbs the same in the other steps
_AS_GOOD = 0.8


def one_intensity(scan: ScanEvidence) -> Iterator[Finding]:
    """Consecutive projections have the same intensity, except for a drift. Otherwise the finding says with which step
    one can select the projections of one intensity and their flats.
    """
    flats, views = scan.table.flats, scan.table.views
    ends = views[:_IN_A_ROW], views[-_IN_A_ROW:]
    if (
        not scan.in_counts
        or not flats.size
        or views.size < _IN_A_ROW
        or any(np.ptp(part) != _IN_A_ROW - 1 for part in ends)
    ):
        return
    levels = [_log_intensities(scan, part) for part in ends]
    n, change, limit = lights_in_turn(levels[0]), np.ptp(levels[0]), ReferenceLimits().uneven
    small_steps = np.median(np.abs(np.diff(scan.table.angles[ends[0]]))) <= _BESIDE
    if not (small_steps and n and n == lights_in_turn(levels[1]) and change >= limit):
        return
    difference = np.expm1(change)
    first_frame = views[0]
    yield Finding(
        "error" if lights_in_turn(_log_intensities(scan, flats[:_IN_A_ROW])) else "warning",
        "light",
        f"The projections alternate between {n} intensities from frame to frame (from frame {first_frame} on; "
        f"{difference:.0%} apart), because thresholds, exposures or energies alternate. A volume can use only one of "
        f"these intensities. {_advice_on_steps(scan, n, limit)}",
    )


def _advice_on_steps(scan: ScanEvidence, n: int, most: float) -> str:
    """The step through the projections that selects one of `n` intensities together with its flats."""
    shares = np.array([_share_of_flats(scan, slice(first, None, n), most) for first in range(n)])
    steps = [f"--frames {first}::{n}" for first in range(n) if 0 < shares[first] >= _AS_GOOD * shares.max()]
    if not steps:
        return (
            f"Choose the projections of one intensity with --frames, for example --frames 0::{n}. Also give --darks "
            "and --flats, because no such choice contains flats of the same intensity."
        )
    return (
        f"{' or '.join(steps)} selects projections of one intensity, with their darks and flats (projections "
        "are counted from 0)."
    )


def _log_intensities(scan: ScanEvidence, rows: I64) -> F64:
    """[frame] logarithm of the intensity of each frame."""
    darks = scan.table.darks
    dark = scan.mean_cells(darks) if darks.size else 0.0
    intensity = [np.percentile(np.nan_to_num(cells) - dark, BRIGHT) for cells in scan.cells(rows)]
    return np.asarray(np.log(np.maximum(intensity, 1e-30)), np.float64)


def _share_of_flats(scan: ScanEvidence, step: slice, most: float) -> float:
    """Intensity of the projections of a step relative to its flats; 0 if its flats differ from each other, or are
    darker.
    """
    table = selected(scan.source, step).table
    flats, views = (_log_intensities(scan, rows[:_IN_A_ROW]) for rows in (table.flats, table.views))
    share = math.exp(np.median(views) - np.median(flats))
    return share if np.ptp(flats) < most and share <= 1 + DRIFT else 0.0


def several_energies(scan: ScanEvidence) -> str:
    """All projections were taken at one energy, as a volume requires. Otherwise the finding lists the energies."""
    energies = np.zeros(0) if scan.table.energies is None else scan.table.energies[scan.table.views]
    parts = frames_by_energy(energies)
    if len(parts) < 2:
        return ""
    first_energy = parts[0][0]
    return (
        f"The projections were taken at {len(parts)} energies: {in_words(energies)}. A volume needs one energy. "
        f"Choose an energy, for example with --frames energy={first_energy:.6g}, which leaves out all other frames."
    )
