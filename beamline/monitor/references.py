"""Darks and flats judged as groups: saturated, without light, uneven, or lit though they should be dark.

Bad references spoil a volume as surely as bad views. So they are judged before the first projection is taken,
and once more before a file is reconstructed. All functions are pure: values of frames in, faults with figures out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum, auto
from typing import Annotated

import numpy as np
import pydantic
from numpy.typing import NDArray

from beamline.core.text import spans
from beamline.monitor.digest import LARGEST, FrameDigest, thinned
from drivers.base.frame import FrameKind
from recon.base.arrays import median_deviation

LEAST_NOISE = 0.5  # counts: what rounding hides
READOUT = 3.0  # counts: noise of a pixel that readout alone leaves in a clean dark
FEW = 20.0  # noises of the darks: flats with less light have hardly more noise, so that their variance tells nothing
BRIGHT = 90.0  # percentile of a frame's blocks that represents its light
UNLIT = 0.05  # share of the bright part's light: a place with less counts as dark
CHANGE_SIGMAS = 8.0  # standard deviations: a larger change between two flats is not noise
LEAST_BLOCKS = 200  # differences of neighbouring blocks, from which a noise is known to 15 %
ZINGER = 12.0  # times the median change: more is not noise
BY_CHANCE = 20  # pixels that hold the largest count by chance: 2 or 3 of a thousand as of a million, at CLIPPED_NOISE
CLIPPED_NOISE = 2.0  # counts: with more noise a pixel holds one count in two frames by chance in one of seven at most
IN_TURN = 3.0  # times the change to the next frame of the same light: 1 of a drift, less of what is random
WORST = 99.0  # percentile of the changes between two flats that counts, so that zingers do not
ZINGERS = 4  # places or pixels of a frame that they hit, however small it is


@dataclass(frozen=True)
class ReferenceLimits:
    """Limits of the references, each with its reason.

    saturated: as the alarm of the check `saturation`: a cosmic ray hits a pixel or two, one in a thousand is exposure.
    light_over_noise: a flat at the darks' level has no light; three times the noise of a pixel is the least that can
        be told.
    light_gone: half of the light does not go by drift, top-up or decay of the ring's current. Against the brightest
        flats and against the views, which no sample makes brighter.
    uneven: flats are averaged, and views divided by the average; 0.1 of light is 0.1 of line integral.
    unlit: a beam may be narrower than the detector, but not so that most of it is dark.
    light_in_darks: darks that are lit have a share of the flats' level and, since light brings its noise, of their
        variance. An offset has only the former, readout noise only the latter. A fifth of both is neither.
    """

    saturated: Annotated[
        float, pydantic.Field(ge=0, lt=1, description="fraction of the pixels of a flat at their end")
    ] = 1e-3
    light_over_noise: Annotated[
        float, pydantic.Field(ge=0, description="light of a flat over the noise of a dark's pixel")
    ] = 3.0
    light_gone: Annotated[
        float, pydantic.Field(gt=0, lt=1, description="light that is gone, of the brightest flats")
    ] = 0.5
    uneven: Annotated[
        float, pydantic.Field(gt=0, description="relative change of the light between flats of a group")
    ] = 0.1
    unlit: Annotated[float, pydantic.Field(gt=0, le=1, description="fraction of the frame that flats leave dark")] = 0.5
    light_in_darks: Annotated[
        float, pydantic.Field(gt=0, lt=1, description="level and variance of darks over those of flats")
    ] = 0.2


@dataclass(frozen=True, eq=False)
class ReferenceFrame:
    """Statistics of a dark or a flat.

    Attributes:
        row: in the file.
        kind: DARK or FLAT.
        exposure: s, NaN where unknown.
        saturated: fraction of the pixels at or above the saturation value.
        blocks: float32, means of blocks of pixels; a part of the preview where that is large.
        block: pixels a side of a block.
        rounding: noise that the pixels' type may hide; 0 of real numbers.
        invalid: fraction of the pixels that are not finite.
        cells: float32, means of larger blocks that cover the frame; None: not needed.
        largest: the largest count that more than BY_CHANCE pixels hold; at_largest: fraction of the pixels that hold
            it, less those, or, where other pixels have more, less those that hold one count less. NaN and 0 where
            nobody looked.
    """

    row: int
    kind: FrameKind
    exposure: float
    saturated: float
    blocks: NDArray[np.float32]
    block: int
    rounding: float = LEAST_NOISE
    invalid: float = 0.0
    cells: NDArray[np.float32] | None = None
    largest: float = np.nan
    at_largest: float = 0.0

    @classmethod
    def of(cls, row: int, kind: FrameKind, exposure: float, digest: FrameDigest, block: int) -> ReferenceFrame:
        return cls.seen(row, kind, exposure, digest.saturated_fraction, digest.preview, block)

    @classmethod
    def seen(
        cls, row: int, kind: FrameKind, exposure: float, saturated: float, preview: NDArray[np.float32], block: int
    ) -> ReferenceFrame:
        return cls(row, kind, exposure, saturated, np.array(thinned(preview)), block)


class FaultKind(StrEnum):
    """Kinds of faults of darks and flats."""

    SATURATED = auto()
    NO_BEAM = auto()  # flats at the darks' level
    BEAM_LOST = auto()  # flats with much less light than others
    DIMMER_THAN_VIEWS = auto()
    UNEVEN = auto()
    MOSTLY_UNLIT = auto()
    LIGHT_IN_DARKS = auto()
    UNWRITTEN = auto()  # frames of one value
    NOT_FINITE = auto()
    SAMPLE_IN = auto()  # flats that look like views


@dataclass(frozen=True)
class ReferenceFault:
    """A fault of a group."""

    kind: FaultKind  # which fault
    # score, limit: the figure, and the violated limit
    score: float
    limit: float
    message: str  # both in words, with advice


@dataclass(frozen=True)
class GroupVerdict:
    """The result of all checks on a group of references.

    Attributes:
        kind: DARK or FLAT.
        rows: all of them, in the file.
        faults: none for a good group.
    """

    kind: FrameKind
    rows: tuple[int, ...]
    faults: tuple[ReferenceFault, ...]

    @property
    def name(self) -> str:
        return f"{self.kind.name.lower()}s {spans(self.rows)}"

    def described(self) -> str:
        """Name and faults of the group, in words."""
        return f"The {self.name}: {' '.join(fault.message for fault in self.faults)}"


Group = Sequence[ReferenceFrame]


def judge(
    groups: Sequence[Group], limits: ReferenceLimits | None = None, views: Group = ()
) -> tuple[GroupVerdict, ...]:
    """Check groups of darks and flats, each by itself and against the others.

    Args:
        groups: of one kind each, none empty, in the order of the file.
        views: some projections, if there are any.
    """
    limits = limits or ReferenceLimits()
    numbers = [group for group in groups if not is_blank(group)]
    views = [view for view in views if not is_blank([view])]
    base = min((group for group in numbers if group[0].kind is FrameKind.DARK), key=level, default=None)
    flats = [group for group in numbers if group[0].kind is FrameKind.FLAT]
    known = [group for group in flats if _saturated(group, base, limits) is None] or flats
    bright = max(known, key=lambda group: _light(group, base), default=None)
    judged = []
    for group in groups:
        if is_blank(group):
            faults: list[ReferenceFault | None] = [_BLANK]
        elif group[0].kind is FrameKind.DARK:
            faults = [] if bright is None else [_lit(group, bright, base or group, limits)]
        else:
            faults = _of_flats(group, base, bright or group, views, limits)
        rows = tuple(reference.row for reference in group)
        judged.append(GroupVerdict(group[0].kind, rows, tuple(fault for fault in faults if fault is not None)))
    return tuple(judged)


def _of_flats(
    flats: Group, darks: Group | None, bright: Group, views: Group, limits: ReferenceLimits
) -> list[ReferenceFault | None]:
    """The faults of a group of flats; the later ones mean nothing where there is an earlier one."""
    faults = [_saturated(flats, darks, limits), _without_beam(flats, darks, bright, limits)]
    if not any(faults):
        faults = [_outshone(flats, darks, views, limits)]
    return faults if any(faults) else [_uneven(flats, darks, limits), _unlit(flats, darks, limits)]


def is_blank(group: Group) -> bool:
    """Whether no pixel of its frames has a finite value."""
    return all(np.isnan(reference.blocks).all() for reference in group)


_BLANK = ReferenceFault(
    FaultKind.NOT_FINITE, 1.0, 0.0, f"no pixel of them holds a number: all are NaN, infinite or beyond {LARGEST:g}."
)


def photons(flats: Group, darks: Group) -> float | None:
    """Median number of photons in a lit pixel of the flats: light squared over the variance that it adds.

    Photon transfer (Janesick 2007), of what changes from frame to frame between neighbouring blocks: a beam that
    flickers or moves is no noise. None where frames or blocks are too few, or the flats have no noise by their light.
    """
    light = np.mean([flat.blocks for flat in flats], axis=0) - offset(darks)
    lit = light > UNLIT * float(np.nanpercentile(light, BRIGHT))
    beside = lit[:, 1:] & lit[:, :-1]
    if len(flats) < 2 or (len(flats) - 1) * beside.sum() < LEAST_BLOCKS:
        return None
    levels = np.array([np.median((flat.blocks - offset(darks))[lit]) for flat in flats])
    even = np.stack([flat.blocks for flat in flats]) * (levels.mean() / levels)[:, None, None].astype(np.float32)
    change = np.diff(np.diff(even, axis=0), axis=2)[:, beside]
    squares = change.astype(np.float64) ** 2
    variance = float(squares[squares <= ZINGER**2 * np.median(squares)].mean()) / 4 * flats[0].block ** 2
    brought = variance - _noise(darks) ** 2
    return float(np.median(light[lit]) * light[lit].mean()) / brought if brought > 0 else None


def full_scale(largest: float) -> float:
    """The saturation count of a detector, estimated from its largest count: the end of its 8, 10, 12, 14 or 16 bits."""
    return next((2.0**bits - 1 for bits in (8, 10, 12, 14, 16) if 2**bits > largest), np.inf)


def _saturated(flats: Group, darks: Group | None, limits: ReferenceLimits) -> ReferenceFault | None:
    written = all(map(_of_one_number, flats))
    if written and all(map(_of_one_number, darks or ())) and not (flats[0].saturated and level(darks or flats)):
        return None  # not exposed: the number that stands for all light, such as the full scale of 16 bits beside 0
    hot = 0.0 if darks is None else float(np.median([dark.saturated for dark in darks]))
    score, limit = float(np.median([flat.saturated for flat in flats])) - hot, saturation_limit(flats[0], limits)
    if score > limit:
        what = f"{score:.2%} of their pixels are saturated (limit {limit:.2%}), so that their light is not known."
    elif written:
        score, what = (
            1.0,
            f"every pixel of them holds {level(flats):g}, though those of the darks vary: counts end there.",
        )
    else:
        return _clipped(flats, darks, limits)
    sentence = f"{what} Shorten the exposure or add a filter."
    return ReferenceFault(FaultKind.SATURATED, score, limit, sentence)


def saturation_limit(frame: ReferenceFrame, limits: ReferenceLimits) -> float:
    """Fraction of the pixels of a frame that may be saturated."""
    return max(limits.saturated, (ZINGERS + 0.9) / (frame.blocks.size * frame.block**2))  # blocks go beyond the edge


def _of_one_number(frame: ReferenceFrame) -> bool:
    return bool(np.ptp(frame.blocks) == 0)


def _clipped(flats: Group, darks: Group | None, limits: ReferenceLimits) -> ReferenceFault | None:
    """Flats whose counts end below the end of their type. Where pixels vary from frame to frame, few share the largest
    count, and it is not the same in all frames; hot pixels and zingers, which are few, have more."""
    hot = [dark.at_largest for dark in darks or () if dark.largest == flats[0].largest]
    score = float(np.median([flat.at_largest for flat in flats])) - max(hot, default=0.0)
    if len(flats) < 2 or score <= saturation_limit(flats[0], limits) or len({flat.largest for flat in flats}) > 1:
        return None
    blocks = np.stack([flat.blocks for flat in flats])
    change = np.abs(np.diff(blocks, axis=0))
    varied = change[change > 0]  # blocks at the end of the counts do not; a few that differ are damage
    noise = median_deviation(varied) / 2**0.5 * flats[0].block if varied.size > BY_CHANCE else 0.0
    if (
        not max(CLIPPED_NOISE * (flats[0].rounding > 0), 1e-30) <= noise <= limits.uneven * flats[0].largest
    ):  # one that is damaged or moved varies by more
        return None
    sentence = (
        f"{score:.2%} of their pixels hold {flats[0].largest:g}, the largest count but for a few, though pixels vary "
        f"by {noise:.3g} from frame to frame (limit {limits.saturated:.2%}): counts end there, and the light is not "
        "known. Shorten the exposure, or look for what cut the counts off."
    )
    return ReferenceFault(FaultKind.SATURATED, score, limits.saturated, sentence)


def _without_beam(flats: Group, darks: Group | None, bright: Group, limits: ReferenceLimits) -> ReferenceFault | None:
    if darks is None:
        return None
    if not _has_light(flats, darks, limits):
        light, noise = level(flats) - level(darks), max(_noise(darks), darks[0].rounding)
        sentence = (
            f"there is no beam in them: their level {level(flats):.6g} is {light:.3g} above the darks' "
            f"{level(darks):.6g}, and a pixel's noise is {noise:.2g} (limit: {limits.light_over_noise:g} times it). "
            "Was the shutter open for them, and closed for the darks?"
        )
        return ReferenceFault(FaultKind.NO_BEAM, light / noise if noise else 0.0, limits.light_over_noise, sentence)
    most = _light(bright, darks)
    gone = 1 - _light(flats, darks) / most
    if gone <= limits.light_gone:
        return None
    where = spans([reference.row for reference in bright])
    sentence = (
        f"{gone:.0%} of the light of the flats {where} is gone (limit {limits.light_gone:.0%}): the beam was lost."
    )
    return ReferenceFault(FaultKind.BEAM_LOST, gone, limits.light_gone, sentence)


def _outshone(flats: Group, darks: Group | None, views: Group, limits: ReferenceLimits) -> ReferenceFault | None:
    """Faults of flats darker than views, if both exposures are known: a sample only takes light."""
    views = [view for view in views if view.saturated <= limits.saturated and np.isfinite(view.blocks).any()]
    if not views or not all(frame.exposure > 0 for frame in (*flats, *views)):
        return None
    there, most = _light(flats, darks), _light(views, darks)
    if there >= (1 - limits.light_gone) * most:
        return None
    share = there / most
    sentence = (
        f"they have {share:.2%} of the light of the views (limit {1 - limits.light_gone:.0%}), though a sample only "
        f"takes light. The beam was lost or a filter was in for them, or their exposure is not the one stated."
    )
    return ReferenceFault(FaultKind.DIMMER_THAN_VIEWS, share, 1 - limits.light_gone, sentence)


def _uneven(flats: Group, darks: Group | None, limits: ReferenceLimits) -> ReferenceFault | None:
    """The light of each flat against the group's mean, as a whole and place by place."""
    if len(flats) < 2:
        return None
    light = np.stack([(flat.blocks - offset(darks)) / seconds(flat) for flat in flats])
    mean = light.mean(axis=0)
    lit = mean > max(0.0, UNLIT * float(np.nanpercentile(mean, BRIGHT)))
    if not lit.any():
        return None
    ratio = light[:, lit] / mean[lit]
    levels = np.median(ratio, axis=1)
    local = np.abs(ratio / levels[:, None] - 1)
    noise = median_deviation(local)
    changed = float(np.ptp(levels))
    place = float(worst_place(local).max())
    if changed > limits.uneven:
        n = lights_in_turn(levels)
        why = f"{n} thresholds, exposures or energies in turn" if n else "an unstable beam"
        sentence = f"their light changes by {changed:.0%} from flat to flat (limit {limits.uneven:.0%}): {why}."
        return ReferenceFault(FaultKind.UNEVEN, changed, limits.uneven, sentence)
    if place > max(limits.uneven, CHANGE_SIGMAS * noise):
        sentence = (
            f"in places their light changes by {place:.0%} from flat to flat (limit {limits.uneven:.0%}): something "
            "moved in the beam. Is the sample out?"
        )
        return ReferenceFault(FaultKind.UNEVEN, place, limits.uneven, sentence)
    return None


def lights_in_turn(levels: NDArray[np.floating]) -> int:
    """How many lights frames in a row [frame] have in turn, 2 or 3; 0: their light does not change so."""
    for n in range(2, min(3, levels.size // 2) + 1):
        between = float(np.ptp([np.median(levels[first::n]) for first in range(n)]))
        if between > IN_TURN * float(np.abs(levels[n:] - levels[:-n]).max()):
            return n
    return 0


def worst_place(changes: NDArray[np.floating]) -> NDArray[np.floating]:
    """The change [frame] that counts of those of its places [frame, place]: few of these may be zingers."""
    n = changes.shape[1]
    return np.sort(changes, axis=1)[:, max(0, n - 1 - max(ZINGERS, round(n * (1 - WORST / 100))))]


def _unlit(flats: Group, darks: Group | None, limits: ReferenceLimits) -> ReferenceFault | None:
    light = np.mean([flat.blocks - offset(darks) for flat in flats], axis=0)
    score = float((light < UNLIT * np.nanpercentile(light, BRIGHT)).mean())
    if score <= limits.unlit:
        return None
    sentence = (
        f"{score:.0%} of the frame has no light in them (limit {limits.unlit:.0%}): move beam and detector onto one "
        "another, or read fewer pixels."
    )
    return ReferenceFault(FaultKind.MOSTLY_UNLIT, score, limits.unlit, sentence)


def _lit(darks: Group, flats: Group, base: Group, limits: ReferenceLimits) -> ReferenceFault | None:
    if not _has_light(flats, base, limits):
        return None  # both have the same light: the flats' fault reports it, because the wrong one is unknown
    share = level(darks) / level(flats) if level(flats) > 0 else np.inf
    noise, of_flats = _noise(darks), _noise(flats)
    known = of_flats > 0  # otherwise the frames have no noise, as only simulated ones
    variance = (noise / of_flats) ** 2 if known else share
    score = min(share, variance)
    limit = limits.light_in_darks if known else max(limits.light_in_darks, 0.5)
    if known and noise < READOUT and level(flats) - level(darks) < FEW * noise:
        return None
    if score <= limit or level(darks) <= 0:
        return None
    sentence = (
        f"there is light in them: their level {level(darks):.6g} is {share:.0%} of the flats' {level(flats):.6g}"
        + (f" and their variance {variance:.0%}" if known else "")
        + f" (limit {limit:.0%}). Was the shutter closed for them, and open for the flats?"
    )
    return ReferenceFault(FaultKind.LIGHT_IN_DARKS, score, limit, sentence)


def _has_light(flats: Group, darks: Group, limits: ReferenceLimits) -> bool:
    return level(flats) - level(darks) > limits.light_over_noise * max(_noise(darks), darks[0].rounding)


def level(group: Group) -> float:
    """Counts in the bright part of a frame: a beam may be narrower than the detector."""
    return float(np.median([np.nanpercentile(reference.blocks, BRIGHT) for reference in group]))


def offset(darks: Group | None) -> NDArray[np.float32] | float:
    return np.asarray(np.mean([dark.blocks for dark in darks], axis=0)) if darks else 0.0


def seconds(reference: ReferenceFrame) -> float:
    return reference.exposure if reference.exposure > 0 else 1.0


def _light(group: Group, darks: Group | None) -> float:
    """Counts above the darks, a second where the exposure is known."""
    dark = 0.0 if darks is None else level(darks)
    return float(np.median([(np.nanpercentile(flat.blocks, BRIGHT) - dark) / seconds(flat) for flat in group]))


def _noise(group: Group) -> float:
    """Standard deviation of a pixel from frame to frame; of a single frame, from place to place."""
    if len(group) == 1:
        blocks, pairs = group[0].blocks, 1.0
        change = blocks - np.nanmedian(blocks)
    else:
        # Neighbours in time share slow drift and all fixed pattern.
        before, after = (np.stack([r.blocks for r in part]) for part in (group[:-1], group[1:]))
        change, pairs = after - before, 2.0
        change = change - np.nanmedian(change, axis=(1, 2), keepdims=True)
    return median_deviation(change) / pairs**0.5 * group[0].block
