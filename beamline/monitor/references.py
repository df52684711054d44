"""Rules for darks and flats: saturated, without beam, uneven, never written, with beam in darks, or with the sample.

Bad darks and flats spoil a volume as surely as bad projections. The same rules check darks and flats in three places:
before the first projection is taken, in `validate`, and before a reconstruction. The rules compare each frame with its
group, with the other groups and with the projections. To add a rule, write a predicate and a row in RULES.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from beamline.core.flag import Finding, Severity
from beamline.core.text import frames_text, spans
from beamline.monitor.digest import LARGEST
from beamline.monitor.evidence import (
    BRIGHT,
    UNLIT,
    BadFrames,
    Evidence,
    level,
    lights_in_turn,
    offset,
    pixel_noise,
    place_noise,
    range_in_words,
)
from beamline.monitor.sample_in_flats import (
    flats_below_views,
    flats_like_views,
    sample_in_all_flats,
    views_brighter,
    views_show_nothing,
)
from drivers.base.frame import FrameKind
from recon.base.arrays import MEDIAN
from recon.base.setting import setting

READOUT = 3.0  # counts: noise of a pixel in a clean dark, from the readout alone
# factor on the noise of the darks; if flats have less intensity, their variance is mostly noise of the darks
FEW = 20.0
CHANGE_SIGMAS = 8.0  # standard deviations; a larger change between two flats is not noise
WORST = 0.01  # share of the places of a flat that may be zingers
ZINGERS = 4  # number of places or pixels of a frame that zingers may hit, however small the frame is
LIT = 0.02  # fraction of the intensity of the flats above which a dark counts as exposed to the beam
LIT_SIGMAS = 3.0  # in units of the noise of a place: the mean of a few places may be wrong by this
# fraction of pixels that are not finite, beyond those of the best frame of the group, because dead pixels are in all
# frames
INVALID = 1e-3


@dataclass(frozen=True)
class ReferenceLimits:
    """Limits for darks and flats, with reasons.

    saturated: the same as for an alarm of the check `saturation`. A cosmic ray hits one or two pixels; if one pixel in
    a thousand is saturated, the exposure is too long.

    light_over_noise: a flat at the level of the darks has no beam. Three times the noise of a pixel is the smallest
    difference that can be detected.

    light_gone: no drift, top-up or decay of the ring current removes half of the intensity. Flats are compared with the
    brightest flats, and with the projections, because no sample makes projections brighter.

    uneven: flats are averaged, and projections are divided by the mean. An error of the intensity by 0.1 is an error of
    the line integral by 0.1.

    unlit: a beam may be narrower than the detector, but most of the detector must get beam.

    light_in_darks: darks that were exposed have a part of the level of the flats and, because of photon noise, a part
    of their variance. An offset raises only the level, and readout noise only the variance. So a fifth of the level
    together with a fifth of the variance cannot come from offset or readout noise.
    """

    saturated: float = setting(1e-3, "largest allowed fraction of saturated pixels in a flat", ge=0, lt=1)
    light_over_noise: float = setting(
        3.0, "least intensity of a flat, in units of the noise of a pixel in a dark", ge=0
    )
    light_gone: float = setting(
        0.5, "largest allowed loss of intensity of a flat, as a fraction of the brightest flats", gt=0, lt=1
    )
    uneven: float = setting(0.1, "largest allowed relative change of the intensity between flats of a group", gt=0)
    unlit: float = setting(0.5, "largest allowed fraction of a flat without beam", gt=0, le=1)
    light_in_darks: float = setting(
        0.2,
        "largest allowed level and variance of darks, as fractions of the level and the variance of flats",
        gt=0,
        lt=1,
    )


DARK, FLAT = FrameKind.DARK, FrameKind.FLAT


def reference_findings(evidence: Evidence, limits: ReferenceLimits | None = None) -> tuple[Finding, ...]:
    """Findings about darks and flats. They are errors if all darks, or all flats, are bad, and warnings if good frames
    remain.

    A rule does not look at frames that earlier rules have found. If earlier rules have found all frames of a kind,
    later rules are not applied. Rules that compare flats with the sample need `cells`.
    """
    judged: list[Finding] = []
    for name, kind, rule in RULES:
        if not (frames := evidence.frames(kind)):
            continue
        bad_groups = list(rule(evidence, limits or ReferenceLimits()))
        rows = {frame.row for each in bad_groups for frame in each.frames}
        none_left = bool(rows) and rows == {frame.row for frame in frames}
        judged += _in_words(name, kind, bad_groups, "error" if none_left else "warning")
        if none_left:
            break
        evidence = evidence.without(rows)
    return tuple(judged)


def _in_words(name: str, kind: FrameKind, groups: list[BadFrames], severity: Severity) -> Iterator[Finding]:
    """One finding for each sentence, with all the frames that it names."""
    for sentence in dict.fromkeys(each.sentence for each in groups):
        alike = [each for each in groups if each.sentence == sentence]
        own = tuple(sorted(frame.row for each in alike for frame in each.frames))
        text = f"{kind.name.capitalize()}s in {frames_text(own)}: {sentence}" if own else sentence
        yield Finding(severity, name, text, own, alike[0].score, alike[0].limit)


def _with_holes(kind: FrameKind) -> Rule:
    """Rule: frames with values that are not finite, although the best frame of their group has fewer; or without any
    valid value."""

    def with_holes(evidence: Evidence, _: ReferenceLimits) -> Iterator[BadFrames]:
        for group in evidence.of_kind(kind):
            limit = min(min(frame.invalid for frame in group) + INVALID, 0.5)
            if bad_frames := [frame for frame in group if frame.invalid > limit or frame.blank]:
                text = range_in_words([frame.invalid for frame in bad_frames])
                sentence = f"a fraction of {text} of the pixels has no valid value (limit {limit:.3g})."
                if all(frame.blank for frame in bad_frames):
                    sentence = f"no pixel has a valid value: all are NaN, infinite or above {LARGEST:g}."
                yield BadFrames(bad_frames, max(frame.invalid for frame in bad_frames), limit, sentence)

    return with_holes


def _unwritten(evidence: Evidence, _: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: darks in which all pixels are 0, although most other darks are not."""
    frames = evidence.frames(DARK)
    zero = [frame for frame in frames if not np.any(frame.blocks)]
    if zero and 2 * sum(not frame.constant for frame in frames) > len(frames):
        yield BadFrames(zero, 0.0, 0.0, "every pixel is 0: the frame was never written, or it is not from the camera.")


def _above_darkest(evidence: Evidence, _: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: darks that are brighter than the darkest dark of the same exposure. (Beam only adds counts.)"""
    darks = evidence.frames(DARK)
    flats = [level([frame]) for frame in evidence.frames(FLAT) if not frame.blank]
    for exposure in {frame.rounded_exposure for frame in darks}:
        same = [frame for frame in darks if frame.rounded_exposure == exposure]
        levels = np.array([level([frame]) for frame in same])
        base, lowest = same[int(levels.argmin())], float(levels.min())
        intensity = (max(flats) if flats else float(levels.max())) - lowest
        limit = max(LIT * intensity, LIT_SIGMAS * place_noise(base.blocks))
        if (above := levels[levels - lowest > limit] - lowest).size:
            bad_frames = [same[index] for index in np.flatnonzero(levels - lowest > limit).tolist()]
            least_dark = f"the darkest dark, frame {base.row} with {lowest:.6g} counts"
            yield BadFrames(bad_frames, float(above.max()), limit, (
                f"these darks were exposed to the beam, or the offset changed: the darks are {range_in_words(above)} "
                f"counts "
                f"above {least_dark} (limit {limit:.3g}, because the flats have {intensity:.6g} counts of beam)."
            ))  # fmt: skip


def _saturated(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats with many saturated pixels, or with the same value in all pixels.

    Flats that a program wrote instead of taking them are allowed: all pixels have a single value that means full
    intensity, such as 65535 with darks of 0.
    """
    darks = evidence.frames(DARK)
    hot = float(np.median([dark.saturated for dark in darks])) if darks else 0.0
    for group in evidence.of_kind(FLAT):
        shares, limit = np.array([flat.saturated - hot for flat in group]), saturation_limit(group[0].pixels, limits)
        is_over, largest_share = shares > limit, float(shares.max())
        if all(frame.constant for frame in (*group, *darks)) and not (is_over.any() and level(darks or group)):
            continue
        if is_over.any():
            finding = (
                f"{largest_share:.2%} of the pixels are saturated (limit {limit:.2%}), so the intensity is not known"
            )
            bad_frames = [group[index] for index in np.flatnonzero(is_over).tolist()]
            yield BadFrames(bad_frames, largest_share, limit, f"{finding}. Shorten the exposure or add a filter.")
        elif all(flat.constant for flat in group):
            finding = f"all pixels are saturated: every pixel is {level(group):g}, although the darks have noise"
            yield BadFrames(group, 1.0, limit, f"{finding}. Shorten the exposure or add a filter.")


def saturation_limit(pixels: int, limits: ReferenceLimits) -> float:
    """Fraction of the pixels of a frame that may be saturated."""
    return max(limits.saturated, (ZINGERS + 0.9) / pixels)


def _without_beam(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats that are at the level of the darks."""
    if not (darks := evidence.darkest):
        return
    noise, limit = max(pixel_noise(darks), darks[0].rounding), limits.light_over_noise
    for group in evidence.of_kind(FLAT):
        intensity = level(group) - level(darks)
        if intensity <= limit * noise:
            yield BadFrames(group, intensity / noise if noise else 0.0, limit, (
                "these flats show no beam. Was the shutter open for the flats, and closed for the darks? The level of "
                f"these flats, {level(group):.6g} counts, minus the level of the darks, {level(darks):.6g} counts, is "
                f"{intensity:.3g} counts; expected more than {limit:g} times the noise of a pixel, {noise:.2g} counts."
            ))  # fmt: skip


def _beam_lost(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats with much less intensity than the brightest group."""
    bright, limit = evidence.brightest, limits.light_gone
    for group in evidence.of_kind(FLAT):
        lost_share = np.array([1 - evidence.intensity_of([flat]) / evidence.intensity_of(bright) for flat in group])
        if (lost_share > limit).any():
            bright_frames, largest_loss = spans([flat.row for flat in bright]), float(lost_share.max())
            sentence = (
                f"the beam was lost: these flats have {largest_loss:.0%} less intensity than the flats in frames "
                f"{bright_frames} (limit {limit:.0%})."
            )
            yield BadFrames(
                [group[place] for place in np.flatnonzero(lost_share > limit).tolist()], largest_loss, limit, sentence
            )


def _dimmer_than_views(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats that are darker than projections, if both exposures are known. (A sample can only absorb.)"""
    views = [view for view in evidence.views if view.saturated <= limits.saturated and view.exposure > 0]
    limit = 1 - limits.light_gone
    for group in evidence.of_kind(FLAT) if views else ():
        share = evidence.intensity_of(group) / evidence.intensity_of(views)
        if share < limit and all(flat.exposure > 0 for flat in group):
            yield BadFrames(group, share, limit, (
                f"these flats have only {share:.2%} of the intensity of the projections (limit {limit:.0%}), but a "
                "sample can only absorb. During these flats the beam was lost or a filter was in the beam, or the "
                "stated exposure is wrong."
            ))  # fmt: skip


def _uneven(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats whose intensity differs from that of most flats of their group, as a whole or locally. If half of the
    flats differ, the finding is about all flats of the group."""
    base, limit = offset(evidence.darkest), limits.uneven
    for group in evidence.of_kind(FLAT):
        intensity = np.stack([(flat.blocks - base) / flat.seconds for flat in group])
        usual = np.median(intensity, axis=0)
        exposed = usual > max(0.0, UNLIT * float(np.nanpercentile(usual, BRIGHT)))
        if len(group) < 2 or not exposed.any():
            continue
        ratio = intensity[:, exposed] / usual[exposed]
        levels = np.nanmedian(ratio, axis=1)
        local = np.sort(np.nan_to_num(np.abs(ratio / levels[:, None] - 1)), axis=1)
        places = local[:, max(0, exposed.sum() - 1 - max(ZINGERS, round(exposed.sum() * WORST)))]
        changed, noise = float(np.ptp(levels)), float(np.median(local)) / MEDIAN
        far = np.abs(levels - np.median(levels)) > limit / 2 if changed > limit else np.zeros(levels.size, np.bool_)
        moved = (places > max(limit, CHANGE_SIGMAS * noise)) & ~far
        bad_frames = [flat for flat, is_odd in zip(group, far | moved, strict=True) if is_odd]
        whole = 2 * len(bad_frames) >= len(group)
        compared_with = "from flat to flat" if whole else "from the usual flat of their group"
        if far.any():
            n = lights_in_turn(levels)
            reason = f"{n} thresholds, exposures or energies were used in turn" if n else "the beam is unstable"
            sentence = (
                f"the intensity of these flats differs by {changed:.0%} {compared_with} (limit {limit:.0%}): {reason}."
            )
            yield BadFrames(group if whole else bad_frames, changed, limit, sentence)
        elif bad_frames:
            yield BadFrames(group if whole else bad_frames, float(places.max()), limit, (
                "something was in the beam. Was the sample out of the beam? The intensity differs locally by "
                f"{places.max():.0%} {compared_with} (limit {limit:.0%})."
            ))  # fmt: skip


def _mostly_unlit(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: flats in which most of the frame gets no beam."""
    for group in evidence.of_kind(FLAT):
        intensity = np.mean([flat.blocks for flat in group], axis=0) - offset(evidence.darkest)
        score, limit = float((intensity < UNLIT * np.nanpercentile(intensity, BRIGHT)).mean()), limits.unlit
        if score > limit:
            yield BadFrames(group, score, limit, (
                f"{score:.0%} of the frame gets no beam (limit {limit:.0%}). Align beam and detector, or read out a "
                "smaller region."
            ))  # fmt: skip


def _beam_in_darks(evidence: Evidence, limits: ReferenceLimits) -> Iterator[BadFrames]:
    """Rule: darks with the level and the noise of an exposed frame."""
    flats = evidence.brightest
    for darks in evidence.of_kind(DARK) if flats else ():
        share = level(darks) / level(flats) if level(flats) > 0 else np.inf
        noise, of_flats = pixel_noise(darks), pixel_noise(flats)
        known = of_flats > 0  # otherwise the frames have no noise, which happens only in simulations
        variance = (noise / of_flats) ** 2 if known else share
        limit = limits.light_in_darks if known else max(limits.light_in_darks, 0.5)
        unsure = known and noise < READOUT and level(flats) - level(darks) < FEW * noise
        if min(share, variance) > limit and level(darks) > 0 and not unsure:
            yield BadFrames(darks, min(share, variance), limit, (
                "these darks were exposed to the beam. Was the shutter closed for the darks, and open for the "
                f"flats? The level of these darks, {level(darks):.6g}, is {share:.0%} of the level of the flats, "
                f"{level(flats):.6g}"
                + (f", and the variance is {variance:.0%}" if known else "")
                + f" (limit {limit:.0%})."
            ))  # fmt: skip


Rule = Callable[[Evidence, ReferenceLimits], Iterator[BadFrames]]
RULES: tuple[tuple[str, FrameKind, Rule], ...] = (
    ("not_finite", DARK, _with_holes(DARK)),
    ("unwritten", DARK, _unwritten),
    ("light_in_darks", DARK, _above_darkest),
    ("not_finite", FLAT, _with_holes(FLAT)),
    ("no_beam", FLAT, _without_beam),
    ("saturated", FLAT, _saturated),
    ("beam_lost", FLAT, _beam_lost),
    ("light_in_darks", DARK, _beam_in_darks),
    ("dimmer_than_views", FLAT, _dimmer_than_views),
    ("uneven", FLAT, _uneven),
    ("mostly_unlit", FLAT, _mostly_unlit),
    ("sample_in", FLAT, flats_like_views(single=True)),
    ("sample_in", FLAT, flats_below_views),
    ("sample_in", FLAT, flats_like_views(single=False)),
    ("sample_in", FLAT, sample_in_all_flats),
    ("views_alike", FLAT, views_show_nothing),
    ("views_brighter", FLAT, views_brighter),
)
"""The rules, in their order: name, kind of frames that the rule checks, and the function that yields its findings."""
