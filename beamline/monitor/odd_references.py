"""Frames labelled dark or flat that cannot be used as one: lit, unlit, saturated, never written, or with the sample.

`beamline.monitor.references` judges groups as they are; here each frame is compared with its group, with the other
groups, and with the views. One such frame would spoil the mean of its group, however good the others are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beamline.monitor.flats_with_sample import (
    BLOCK_SIGMAS,
    OddFrame,
    lit_views,
    noise_of,
    outshone,
    varies,
    with_sample,
)
from beamline.monitor.references import (
    BRIGHT,
    CHANGE_SIGMAS,
    UNLIT,
    FaultKind,
    Group,
    GroupVerdict,
    ReferenceFault,
    ReferenceFrame,
    ReferenceLimits,
    is_blank,
    level,
    offset,
    saturation_limit,
    seconds,
    worst_place,
)
from drivers.base.frame import FrameKind
from recon.base.arrays import MEDIAN

LIT = 0.02  # share of the flats' light from which a dark is lit: 0.02 of transmission, if it were the only dark
INVALID = 1e-3  # pixels that are not finite, beyond those of the group's best frame: dead pixels are in all frames


def without_odd(
    groups: Sequence[Group], limits: ReferenceLimits | None = None, views: Group = ()
) -> tuple[list[list[ReferenceFrame]], list[GroupVerdict]]:
    """The groups without unusable frames and without groups that become empty; and the verdicts on these frames.

    A group with no good frame at all stays whole where its kind has no other: `judge` tells its fault.

    Args:
        groups: of one kind each, none empty, in the order of the file.
        views: some projections, by which a flat with the sample in the beam is known; they need `cells`.
    """
    limits = limits or ReferenceLimits()
    blank, numbers = ([list(g) for g in groups if is_blank(g) is is_so] for is_so in (True, False))
    darks, flats = ([g for g in numbers if g[0].kind is kind] for kind in (FrameKind.DARK, FrameKind.FLAT))
    judged: list[GroupVerdict] = []
    darks = _split(darks, _unusable(darks, None, limits), judged)
    darks = _split(darks, _lit_darks(darks, flats), judged)
    flats = _split(flats, _unusable(flats, darks, limits), judged)
    flats = _split(flats, _changed(flats, darks, limits), judged)
    views = lit_views(views, darks)
    if views:
        flats = _split(flats, with_sample(flats, darks, views, single=True), judged)
        flats = _split(flats, with_sample(flats, darks, views, single=False), judged)
        flats = _split(flats, outshone(flats, darks, views), judged)
    return [*darks, *flats, *blank], judged


def _split(
    groups: list[list[ReferenceFrame]], odd: list[OddFrame], judged: list[GroupVerdict]
) -> list[list[ReferenceFrame]]:
    """The groups without the odd frames, which are added to those judged; all of them, where none would be left."""
    rows = {each.frame.row for each in odd}
    good = [[frame for frame in group if frame.row not in rows] for group in groups]
    if not odd or not any(good):
        return groups
    for group in groups:
        for kind in FaultKind:
            own = [each for each in odd if each.kind is kind and each.frame in group]
            if own:
                scores = sorted(each.score for each in own)
                figures = f"{scores[0]:.3g}" if scores[0] == scores[-1] else f"{scores[0]:.3g} to {scores[-1]:.3g}"
                fault = ReferenceFault(kind, scores[-1], own[0].limit, own[0].sentence.format(figures=figures))
                judged.append(GroupVerdict(group[0].kind, tuple(each.frame.row for each in own), (fault,)))
    return [group for group in good if group]


def _unusable(
    groups: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]] | None, limits: ReferenceLimits
) -> list[OddFrame]:
    """Darks of zeros, and frames that hold numbers that are not finite, or are saturated, unlike the others."""
    frames = [frame for group in groups for frame in group]
    if not frames:
        return []
    odd: list[OddFrame] = []
    zero = [frame for frame in frames if not np.any(frame.blocks)] if darks is None else []
    if 2 * sum(varies(frame) for frame in frames) > len(frames):
        sentence = "every pixel is 0: never written, or no frame of the camera."
        odd += [OddFrame(frame, FaultKind.UNWRITTEN, 0.0, 0.0, sentence) for frame in zero]
    for group in groups:
        least = min(frame.invalid for frame in group)
        hot = 0.0 if not darks else float(np.median([dark.saturated for each in darks for dark in each]))
        limit = saturation_limit(group[0], limits)
        some = min(frame.saturated for frame in group) - hot <= limit  # else `judge` has the fault of all
        for frame in group:
            if frame.invalid > least + INVALID:
                sentence = f"a share of {{figures}} of the pixels is not finite (limit {least + INVALID:.3g})."
                odd.append(OddFrame(frame, FaultKind.NOT_FINITE, frame.invalid, least + INVALID, sentence))
            elif darks is not None and some and frame.saturated - hot > limit:
                sentence = f"a share of {{figures}} of the pixels is saturated (limit {limit:.3g})."
                odd.append(OddFrame(frame, FaultKind.SATURATED, frame.saturated - hot, limit, sentence))
    first_of_row = {each.frame.row: each for each in reversed(odd)}
    return list(reversed(first_of_row.values()))


def _lit_darks(darks: list[list[ReferenceFrame]], flats: list[list[ReferenceFrame]]) -> list[OddFrame]:
    """Darks above the darkest of their exposure: light only adds to counts."""
    odd = []
    exposures = {_exposure(frame) for group in darks for frame in group}
    for exposure in exposures:
        same = [frame for group in darks for frame in group if _exposure(frame) == exposure]
        base = min(same, key=lambda frame: level([frame]))
        lowest = level([base])
        levels = [level([frame]) for group in flats for frame in group if not is_blank([frame])]
        light = (max(levels) if levels else max(level([frame]) for frame in same)) - lowest
        limit = max(LIT * light, BLOCK_SIGMAS * noise_of(base.blocks))
        for frame in same:
            above = level([frame]) - lowest
            if above > limit:
                sentence = (
                    f"there is light in them, or their offset moved: {{figures}} counts above the darkest dark, frame "
                    f"{base.row} with {lowest:.6g} (limit {limit:.3g}, by the {light:.6g} of light in the flats)."
                )
                odd.append(OddFrame(frame, FaultKind.LIGHT_IN_DARKS, above, limit, sentence))
    return odd


def _changed(
    flats: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]], limits: ReferenceLimits
) -> list[OddFrame]:
    """Flats with other light than most of their group; where half of the group differs, it has no right light."""
    odd = []
    base = offset([frame for group in darks for frame in group])
    of_all = [[(frame.blocks - base) / seconds(frame) for frame in group] for group in flats]
    bright = [max(float(np.nanpercentile(each, BRIGHT)) for each in light) for light in of_all]
    for group, light, most in zip(flats, of_all, bright, strict=True):
        if len(group) < 2 or not most > UNLIT * max(0.0, *bright):
            continue  # a group without light is a fault that `judge` tells
        unlit = [float(np.nanpercentile(each, BRIGHT)) < UNLIT * most for each in light]
        usual = np.median([each for each, dark in zip(light, unlit, strict=True) if not dark], axis=0)
        lit = usual > UNLIT * np.nanpercentile(usual, BRIGHT)
        ratio = np.stack([each[lit] / usual[lit] for each in light])
        levels = np.nanmedian(ratio, axis=1)
        local = np.abs(ratio / np.where(levels > 0, levels, np.inf)[:, None] - 1)  # 1 where there is no light
        place = worst_place(np.nan_to_num(local))
        noise = float(np.median(np.nanmedian(local[~np.array(unlit)], axis=1))) / MEDIAN
        uneven = float(np.ptp(levels)) > limits.uneven
        far = np.abs(levels - np.median(levels)) > limits.uneven / 2
        flickers, changed = [], []
        for frame, dark, share, off, other in zip(group, unlit, levels, far, place, strict=True):
            if dark:
                sentence = f"{{figures}} of the light of the group's brightest (limit {UNLIT:g}): no beam in them."
                changed.append(OddFrame(frame, FaultKind.NO_BEAM, max(float(share), 0.0), UNLIT, sentence))
            elif uneven and off:
                sentence = (
                    f"{{figures}} times the light of the usual flat of their group (limit 1 +- {limits.uneven:g})."
                )
                flickers.append(OddFrame(frame, FaultKind.UNEVEN, float(share), 1 + limits.uneven, sentence))
            elif other > (limit := max(limits.uneven, CHANGE_SIGMAS * noise)):
                sentence = (
                    "in places their light differs from the usual flat of their group by a share of {figures} (limit "
                    f"{limit:.3g}): something was in the beam. Is the sample out?"
                )
                flickers.append(OddFrame(frame, FaultKind.UNEVEN, float(other), limit, sentence))
        kept = len(group) - len(changed)
        odd += changed + (flickers if 2 * len(flickers) < kept else [])
    return odd


def _exposure(frame: ReferenceFrame) -> float:
    return round(frame.exposure, 6) if frame.exposure > 0 else 0.0
