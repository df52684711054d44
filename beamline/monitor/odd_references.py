"""Frames labelled dark or flat that cannot serve as one: lit, unlit, saturated, never written, or with the sample in.

`beamline.monitor.references` judges groups as they are; here each frame is compared with its group, with the other
groups, and with the views. One such frame would spoil the mean of its group, however good the others are.
"""

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
    JudgedGroup,
    ReferenceFault,
    ReferenceFrame,
    ReferenceLimits,
)
from drivers.base.frame import FrameKind
from recon.base.arrays import MEDIAN, median_deviation

LIT = 0.02  # share of the flats' light from which a dark is lit: 0.02 of transmission, if it were the only dark
BLOCK_SIGMAS = 3.0  # noises of a block that the level of a dark may move beside that: readout drifts with its noise
INVALID = 1e-3  # pixels that are not finite, beyond those of the group's best frame: dead pixels are in all frames
LIKER = 0.5  # a frame is a view rather than a flat if it differs from a view by less than this share of the difference
CLIPPED = 0.2  # percent of the places at either end that a spread does not see: zingers
SAME = 0.1  # noises of a place: two frames of one scene differ by more, however alike they are
BRIGHTER = 0.5  # of the depth of the views, by which places must be brighter than in flats with the sample in

Places = NDArray[np.float32]


def without_odd(
    groups: Sequence[Group], limits: ReferenceLimits | None = None, views: Group = ()
) -> tuple[list[list[ReferenceFrame]], list[JudgedGroup]]:
    """The groups without the frames that cannot serve, without groups that become empty, and what these frames are.

    A group with no good frame at all stays whole where its kind has no other: `judge` tells its fault.

    Args:
        groups: of one kind each, none empty, in the order of the file.
        views: some projections, by which a flat with the sample in the beam is known; they need `cells`.
    """
    limits = limits or ReferenceLimits()
    darks, flats = ([list(g) for g in groups if g[0].kind is kind] for kind in (FrameKind.DARK, FrameKind.FLAT))
    judged: list[JudgedGroup] = []
    darks = _split(darks, _unusable(darks, None, limits), judged)
    darks = _split(darks, _lit_darks(darks, flats), judged)
    flats = _split(flats, _unusable(flats, darks, limits), judged)
    flats = _split(flats, _changed(flats, darks, limits), judged)
    views = lit_views(views, darks)
    if views:
        flats = _split(flats, _with_sample(flats, darks, views, single=True), judged)
        flats = _split(flats, _with_sample(flats, darks, views, single=False), judged)
    return [*darks, *flats], judged


def flats_like_views(flats: Sequence[Group], darks: Sequence[Group], views: Group) -> ReferenceFault | None:
    """The fault of flats that all have the sample in the beam: they look like one view, and others outshine them.

    In a true scan nothing outshines the flats in places, though a view may be empty where a sample leaves the field.
    """
    views = lit_views(views, darks)
    if len(views) < 3 or not flats:
        return None
    base = _base(darks)
    light = np.mean([_cells(frame, base) for group in flats for frame in group], axis=0)
    lit = _lit_places(light)
    through = [_without_drift(_log(_cells(view, base), light, lit), lit) for view in views]
    spreads = np.array([_spread(each) for each in through])
    beyond = np.array([_beyond_noise(each) for each in through])
    nearest, noise = int(np.argmin(spreads)), float(np.median([_noise_of(each) for each in through]))
    if not beyond[nearest] < LIKER * np.median(beyond):
        return None
    level = np.median(through[nearest])
    brighter = float(np.median([np.percentile(each, WORST) - level for each in through]))
    darker = float(np.median([level - np.percentile(each, 100 - WORST) for each in through]))
    limit = max(BRIGHTER * darker, BLOCK_SIGMAS * noise)
    same = spreads[nearest] < SAME * noise
    if not (same or brighter > limit > 0):
        return None
    sentence = (
        f"they look like the view in frame {views[nearest].row}, and in places the views are brighter by "
        f"{brighter:.2g} of line integral (limit {limit:.2g}), though a sample only takes light: "
        "the sample was in the beam."
    )
    return ReferenceFault(FaultKind.SAMPLE_IN, brighter, limit, sentence)


def lit_views(views: Group, darks: Sequence[Group]) -> list[ReferenceFrame]:
    """Those of the views that hold more than the light of a closed shutter, or than one value."""
    base = _base(darks)
    light = [float(np.percentile(_cells(view, base), BRIGHT)) for view in views]
    least = UNLIT * max(light, default=0.0)
    return [view for view, bright in zip(views, light, strict=True) if bright > least and _varies(view)]


@dataclass(frozen=True)
class _Odd:
    """A frame that cannot serve: its fault, the figure, the limit, and a sentence with {figures}."""

    frame: ReferenceFrame
    kind: FaultKind
    score: float
    limit: float
    sentence: str


def _split(
    groups: list[list[ReferenceFrame]], odd: list[_Odd], judged: list[JudgedGroup]
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
                judged.append(JudgedGroup(group[0].kind, tuple(each.frame.row for each in own), (fault,)))
    return [group for group in good if group]


def _unusable(
    groups: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]] | None, limits: ReferenceLimits
) -> list[_Odd]:
    """Darks of zeros, and frames that hold numbers that are not finite, or are saturated, unlike the others."""
    frames = [frame for group in groups for frame in group]
    if not frames:
        return []
    odd: list[_Odd] = []
    zero = [frame for frame in frames if not np.any(frame.blocks)] if darks is None else []
    if 2 * sum(_varies(frame) for frame in frames) > len(frames):
        sentence = "every pixel is 0: never written, or no frame of the camera."
        odd += [_Odd(frame, FaultKind.UNWRITTEN, 0.0, 0.0, sentence) for frame in zero]
    for group in groups:
        least = min(frame.invalid for frame in group)
        hot = 0.0 if not darks else float(np.median([dark.saturated for each in darks for dark in each]))
        some = min(frame.saturated for frame in group) - hot <= limits.saturated  # else `judge` has the fault of all
        for frame in group:
            if frame.invalid > least + INVALID:
                sentence = f"a share of {{figures}} of the pixels is not finite (limit {least + INVALID:.3g})."
                odd.append(_Odd(frame, FaultKind.NOT_FINITE, frame.invalid, least + INVALID, sentence))
            elif darks is not None and some and frame.saturated - hot > limits.saturated:
                sentence = f"a share of {{figures}} of the pixels is saturated (limit {limits.saturated:g})."
                odd.append(_Odd(frame, FaultKind.SATURATED, frame.saturated - hot, limits.saturated, sentence))
    first_of_row = {each.frame.row: each for each in reversed(odd)}
    return list(reversed(first_of_row.values()))


def _varies(frame: ReferenceFrame) -> bool:
    known = frame.blocks[np.isfinite(frame.blocks)]
    return known.size > 0 and bool(np.ptp(known) > 0)


def _lit_darks(darks: list[list[ReferenceFrame]], flats: list[list[ReferenceFrame]]) -> list[_Odd]:
    """Darks above the darkest of their exposure: light only adds to counts."""
    odd = []
    exposures = {_exposure(frame) for group in darks for frame in group}
    for exposure in exposures:
        same = [frame for group in darks for frame in group if _exposure(frame) == exposure]
        base = min(same, key=_level)
        lowest = _level(base)
        levels = [_level(frame) for group in flats for frame in group]
        light = (max(levels) if levels else max(map(_level, same))) - lowest
        limit = max(LIT * light, BLOCK_SIGMAS * _noise_of(base.blocks))
        for frame in same:
            above = _level(frame) - lowest
            if above > limit:
                sentence = (
                    f"there is light in them, or their offset moved: {{figures}} counts above the darkest dark, frame "
                    f"{base.row} with {lowest:.6g} (limit {limit:.3g}, by the {light:.6g} of light in the flats)."
                )
                odd.append(_Odd(frame, FaultKind.LIGHT_IN_DARKS, above, limit, sentence))
    return odd


def _changed(
    flats: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]], limits: ReferenceLimits
) -> list[_Odd]:
    """Flats with other light than most of their group; where half of the group differs, it has no right light."""
    odd = []
    offset = _offset(darks)
    of_all = [[(frame.blocks - offset) / _seconds(frame) for frame in group] for group in flats]
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
        place = np.nan_to_num(np.nanpercentile(local, WORST, axis=1))
        noise = float(np.median(np.nanmedian(local[~np.array(unlit)], axis=1))) / MEDIAN
        uneven = float(np.ptp(levels)) > limits.uneven
        far = np.abs(levels - np.median(levels)) > limits.uneven / 2
        flickers, changed = [], []
        for frame, dark, level, off, other in zip(group, unlit, levels, far, place, strict=True):
            if dark:
                sentence = f"{{figures}} of the light of the group's brightest (limit {UNLIT:g}): no beam in them."
                changed.append(_Odd(frame, FaultKind.NO_BEAM, max(float(level), 0.0), UNLIT, sentence))
            elif uneven and off:
                sentence = (
                    f"{{figures}} times the light of the usual flat of their group (limit 1 +- {limits.uneven:g})."
                )
                flickers.append(_Odd(frame, FaultKind.UNEVEN, float(level), 1 + limits.uneven, sentence))
            elif other > (limit := max(limits.uneven, CHANGE_SIGMAS * noise)):
                sentence = (
                    "in places their light differs from the usual flat of their group by a share of {figures} (limit "
                    f"{limit:.3g}): something was in the beam. Is the sample out?"
                )
                flickers.append(_Odd(frame, FaultKind.UNEVEN, float(other), limit, sentence))
        kept = len(group) - len(changed)
        odd += changed + (flickers if 2 * len(flickers) < kept else [])
    return odd


def _with_sample(
    flats: list[list[ReferenceFrame]], darks: list[list[ReferenceFrame]], views: Group, *, single: bool
) -> list[_Odd]:
    """Flats that differ less from a view than from other flats.

    Args:
        single: each flat beside those of its group; else each group beside the other groups.
    """
    base = _base(darks)
    seen = [_cells(view, base) for view in views]
    light = [[_cells(flat, base) for flat in group] for group in flats]
    means = [np.mean(group, axis=0) for group in light]
    bright = [float(np.percentile(mean, BRIGHT)) for mean in means]
    odd = []
    for at, group in enumerate(flats):
        if not bright[at] > UNLIT * max(bright):
            continue  # without light, which is another fault
        if single:  # of two flats each is the other one's only witness
            own, n = light[at], len(group)
            rest = [own[:i] + own[i + 1 :] for i in range(n)]
            compared = [(own[i], [np.median(rest[i], axis=0)] if n > 2 else rest[i]) for i in range(n)]
        else:
            compared = [(means[at], means[:at] + means[at + 1 :])]
        for i, (image, others) in enumerate(compared):
            if not others:
                continue
            lit = _lit_places(np.maximum.reduce([image, *others]))
            changes = [_log(image, other, lit) for other in others]
            change = min(changes, key=_spread)
            off = _beyond_noise(change)
            if not off > 0:
                continue
            like = [_beyond_noise(_log(image, view, lit)) for view in seen]
            nearest = int(np.argmin(like))
            if like[nearest] < LIKER * off:
                sentence = (
                    f"they differ from the {'others of their group' if single else 'other flats'} by {{figures}} of "
                    f"line integral, and by {like[nearest]:.2g} only from the view in frame {views[nearest].row}: the "
                    "sample was in the beam."
                )
                frames = [group[i]] if single else group
                odd += [_Odd(frame, FaultKind.SAMPLE_IN, off, like[nearest] / LIKER, sentence) for frame in frames]
    return odd


def _base(darks: list[list[ReferenceFrame]] | Sequence[Group]) -> Places | float:
    frames = [_whole(frame) for group in darks for frame in group]
    return 0.0 if not frames else np.asarray(np.mean(frames, axis=0), np.float32)


def _whole(frame: ReferenceFrame) -> Places:
    return frame.blocks if frame.cells is None else frame.cells


def _cells(frame: ReferenceFrame, base: Places | float) -> Places:
    return np.asarray(np.nan_to_num(_whole(frame) - base), np.float32)


def _lit_places(light: Places) -> NDArray[np.bool_]:
    return light > UNLIT * max(float(np.percentile(light, BRIGHT)), 1e-30)


def _log(image: Places, other: Places, lit: NDArray[np.bool_]) -> Places:
    """Logarithm of the one over the other where there is light; what has none counts as a thousandth."""
    least = 1e-3 * float(np.percentile(np.maximum(image, other)[lit], BRIGHT)) if lit.any() else 1.0
    least = max(least, 1e-30)
    return np.asarray(np.log(np.maximum(image[lit], least) / np.maximum(other[lit], least)), np.float32)


def _without_drift(values: Places, lit: NDArray[np.bool_]) -> Places:
    """Less a polynomial of the second order in row and column: so a beam drifts, and a sample has more detail."""
    row, col = (at / max(n, 1) for at, n in zip(np.nonzero(lit), lit.shape, strict=True))
    terms = np.stack([np.ones_like(row), row, col, row * row, row * col, col * col], axis=1)
    return np.asarray(values - terms @ np.linalg.lstsq(terms, values.astype(np.float64), rcond=None)[0], np.float32)


def _spread(values: Places) -> float:
    """Standard deviation without the outermost values."""
    if not values.size:
        return 0.0
    low, high = np.percentile(values, (CLIPPED, 100 - CLIPPED))
    return float(np.clip(values, low, high).std())


def _beyond_noise(values: Places) -> float:
    """Their spread without the noise; 0 where it may all be noise."""
    spread, noise = _spread(values), _noise_of(values)
    chance = 1 + CHANGE_SIGMAS * (2 / max(values.size, 1)) ** 0.5
    return (spread**2 - noise**2) ** 0.5 if spread**2 > chance * noise**2 else 0.0


def _noise_of(values: Places) -> float:
    """Standard deviation of a place by its neighbours along the row: matter and beam change more slowly."""
    change = np.diff(values, 2, axis=-1)
    return median_deviation(change) / 6**0.5


def _level(frame: ReferenceFrame) -> float:
    return float(np.nanpercentile(frame.blocks, BRIGHT))


def _offset(darks: list[list[ReferenceFrame]]) -> Places | float:
    frames = [frame.blocks for group in darks for frame in group]
    return 0.0 if not frames else np.asarray(np.mean(frames, axis=0), np.float32)


def _exposure(frame: ReferenceFrame) -> float:
    return round(frame.exposure, 6) if frame.exposure > 0 else 0.0


def _seconds(frame: ReferenceFrame) -> float:
    return frame.exposure if frame.exposure > 0 else 1.0
