"""Names of image files: the kind of each frame, and the angle where the name says it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from drivers.base.frame import FrameKind

_REFERENCE = re.compile(r"(?:^|[^a-z])(dark|flat|white|open[ _-]?beam)")
_SHORT = re.compile(r"(?:^|[^a-z])(ob|df|dc)(?![a-z])")  # of neutron imaging: open beam, dark field, dark current
_PLAIN = re.compile(  # words of references, and those that go with them
    r"open[ _-]?beam|dark|flat|white|ob|df|dc|fields?|images?|frames?|pre|post|before|after|s\b|current"
)
_NUMBER = r"[-+]?\d+(?:\.\d+)?"
_TAGGED = re.compile(rf"(?<![a-z])(?:angle|theta|ang|deg)[ _=-]?({_NUMBER})|({_NUMBER})[ _]?(?:deg|°)", re.IGNORECASE)
_DEGREES_AND_THOUSANDTHS = re.compile(r"_(\d{3})_(\d{3})(?=_\d+$)")
_LEAST_SPAN = 90.0  # degrees; numbers of tiles or of a time of day do not go so far from view to view
_FARTHEST = 3600.0  # degrees


def kind_of(name: str) -> FrameKind:
    """The kind that a file's name relative to the scan's folder says; the name itself goes before folders above it."""
    return _by(_REFERENCE, name)


def kinds_of(path: object, names: Sequence[str]) -> dict[str, FrameKind]:
    """The kind of each image of a scan. One series is the projections, whatever the sample is called.

    Words for references (dark, flat, white, open beam; ob, df, dc as whole words) tell. If they leave no projection,
    the sample is named by such a word: it is the one series with another word in its name, or the only series, or the
    largest, where both kinds of references are there without it.

    Raises:
        DataError: no series can be told to be the projections.
    """
    within = _without_common_folder(names)
    kinds = {name: kind_of(short) for name, short in zip(names, within, strict=True)}
    if not names:
        return kinds
    kinds |= {
        name: _by(_SHORT, short)
        for name, short in zip(names, within, strict=True)
        if kinds[name] is FrameKind.PROJECTION
    }
    if FrameKind.PROJECTION in kinds.values():
        return kinds
    series: dict[str, list[str]] = {}
    for name, short in zip(names, within, strict=True):
        series.setdefault(re.sub(r"\d+", "", short), []).append(name)
    sample = _sample_of(series, kinds)
    if sample is None:
        numbers = ", ".join(f"{len(some)} of {key!r}" for key, some in [*series.items()][:6])
        raise DataError(
            f"{path} holds no projections: all images are named as darks or flats ({numbers}). If a sample is called "
            "so, give the folder of its projections, and the others with --darks and --flats."
        )
    return kinds | dict.fromkeys(series[sample], FrameKind.PROJECTION)


def _sample_of(series: dict[str, list[str]], kinds: dict[str, FrameKind]) -> str | None:
    """The one of several series, all named as references, that is the sample."""
    if len(series) == 1:
        return next(iter(series))
    stems = {key: str(PurePosixPath(key).with_suffix("")).lower() for key in series}
    named = [key for key, stem in stems.items() if re.search(r"[a-z]{2}", _PLAIN.sub(" ", stem))]
    if len(named) == 1:
        return named[0]
    largest = max(series, key=lambda key: len(series[key]))
    others = [name for key, some in series.items() if key != largest for name in some]
    both = {kinds[name] for name in others} >= {FrameKind.DARK, FrameKind.FLAT}
    return largest if both and len(series[largest]) > len(others) else None


def _by(words: re.Pattern[str], name: str) -> FrameKind:
    for part in reversed(name.lower().split("/")):
        match = words.search(part)
        if match is not None:
            return FrameKind.DARK if match[1].startswith("d") else FrameKind.FLAT
    return FrameKind.PROJECTION


def _without_common_folder(names: Sequence[str]) -> list[str]:
    """Names relative to the deepest folder that holds them all: what it is called says nothing of one of them."""
    parts = [name.split("/") for name in names]
    n = 0
    while parts and all(len(each) > n + 1 and each[n] == parts[0][n] for each in parts):
        n += 1
    return ["/".join(each[n:]) for each in parts]


def without_angle(name: str) -> str:
    """A file's name without the angle in it, which is another in each file of one series."""
    stem, dot, suffix = name.rpartition(".")
    stem = _DEGREES_AND_THOUSANDTHS.sub("", stem)
    return _TAGGED.sub("", stem).rstrip("_- =") + dot + suffix


def angles_of(names: Sequence[str]) -> NDArray[np.float64] | None:
    """Radians [file] where each name states its angle; None where not all do, or they are no angles of a scan.

    As a number beside `angle`, `theta`, `ang` or `deg`, or by three digits of degrees and three of their thousandths
    before the number of the frame (MARS and VENUS of ORNL: sample_012_500_0003.tiff).
    """
    degrees = []
    for name in names:
        stem = name.rpartition("/")[2].rpartition(".")[0]
        tagged, plain = _TAGGED.findall(stem), _DEGREES_AND_THOUSANDTHS.findall(stem)
        if len(tagged) == 1:
            degrees.append(float(tagged[0][0] or tagged[0][1]))
        elif len(plain) == 1 and not tagged:
            degrees.append(int(plain[0][0]) + int(plain[0][1]) / 1000)
        else:
            return None
    angles = np.array(degrees)
    if not angles.size or np.ptp(angles) < _LEAST_SPAN or np.abs(angles).max() > _FARTHEST:
        return None
    return np.radians(angles) if 2 * np.unique(angles).size > angles.size else None
