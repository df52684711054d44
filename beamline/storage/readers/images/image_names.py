"""Names of image files: the kind of each frame, and its place in the scan from numbers and angles."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.core.text import count
from beamline.storage.readers.images.image_angles import NamedAngles, angles_in
from drivers.base.frame import FrameKind

_REFERENCE = re.compile(r"(?:^|[^a-z])(dark|flat|white|open[ _-]?beam)")
# Words of neutron imaging (open beam, dark field, dark current) and of TESCAN's XRE (io, di).
_SHORT = re.compile(r"(?:^|[^a-z])(ob|df|dc|io|di)(?![a-z])")
_PLAIN = re.compile(  # words for darks and flats, and words that occur together with them
    r"open[ _-]?beam|dark|flat|white|ob|df|dc|fields?|images?|frames?|pre|post|before|after|s\b|current"
)
# in the names of darks and flats that were taken after the projections
_AFTER = re.compile(r"after|(?<![a-z])post(?![a-z])")
_DEGREES = re.compile(r"(?<!\d)(\d+)[ _-]?deg")  # in the name of a folder
# largest ratio of the range of the numbers to the number of files; with a larger ratio the numbers do not count frames
COUNTED = 100
_DATE = 100_000  # a second number of at least this size is a date or a time, which may be the same in several names


def kinds_of(path: object, names: Sequence[str]) -> dict[str, FrameKind]:
    """The kind of each image of a scan. If there is only one series, its images are the projections, whatever their
    names are.

    Words for darks and flats in the names decide (dark, flat, white, open beam; ob, df, dc as whole words). If every
    name contains such a word, the word is part of the sample's name. The projections are then the only series whose
    name contains another word, or the only series, or the largest series if the other series contain darks and flats.

    Raises:
        DataError: no series can be recognised as the projections.
    """
    within = _without_common_folder(names)
    kinds = {name: _kind_of(short) for name, short in zip(names, within, strict=True)}
    if not names or FrameKind.PROJECTION in kinds.values():
        return kinds
    series: dict[str, list[str]] = {}
    for name, short in zip(names, within, strict=True):
        series.setdefault(re.sub(r"\d+", "", short), []).append(name)
    sample = _sample_of(series, kinds)
    if sample is None:
        numbers = ", ".join(
            f"{count(len(names_of_series), 'image')} like {key!r}" for key, names_of_series in [*series.items()][:6]
        )
        raise DataError(
            f"{path} contains no projections, because all images are named as darks or flats ({numbers}). If the "
            "sample itself has a name like dark or flat, give only the folder of its projections, and the other "
            "images with --darks and --flats."
        )
    return kinds | dict.fromkeys(series[sample], FrameKind.PROJECTION)


def _sample_of(series: dict[str, list[str]], kinds: dict[str, FrameKind]) -> str | None:
    """The series that shows the sample, among several series whose names all contain words for darks or flats."""
    if len(series) == 1:
        return next(iter(series))
    stems = {key: str(PurePosixPath(key).with_suffix("")).lower() for key in series}
    named = [key for key, stem in stems.items() if re.search(r"[a-z]{2}", _PLAIN.sub(" ", stem))]
    if len(named) == 1:
        return named[0]
    largest = max(series, key=lambda key: len(series[key]))
    others = [name for key, names_of_series in series.items() if key != largest for name in names_of_series]
    both = {kinds[name] for name in others} >= {FrameKind.DARK, FrameKind.FLAT}
    return largest if both and len(series[largest]) > len(others) else None


def _kind_of(name: str) -> FrameKind:
    """The kind of an image from its path relative to the scan's folder. The file name has precedence over the names of
    folders.
    """
    for words in (_REFERENCE, _SHORT):
        for part in reversed(name.lower().split("/")):
            match = words.search(part)
            if match is not None:
                return FrameKind.DARK if match[1].startswith("d") else FrameKind.FLAT
    return FrameKind.PROJECTION


def _without_common_folder(names: Sequence[str]) -> list[str]:
    """Names relative to the deepest folder that contains them all, because its name does not distinguish them."""
    parts = [name.split("/") for name in names]
    n = 0
    while parts and all(len(each) > n + 1 and each[n] == parts[0][n] for each in parts):
        n += 1
    return ["/".join(each[n:]) for each in parts]


@dataclass(frozen=True, eq=False)
class NamedImages:
    """The images of a scan in the order of their names: darks, flats, and the projections by number. Then follow the
    darks and flats that were taken afterwards (after or post in the name), and images that are not used.

    Attributes:
        names: names of the files.
        kinds: int32 [file], values of FrameKind.
        angles: float64 [file] radians; NaN if the name states no angle.
        numbers: int64 [file], -1 for darks and flats whose numbers do not belong to the series; None if files are not
            numbered.
        of_series: int64 [projection], number of each projection in its series; None if the numbers do not count images.
        plain: names of the projections, without the angles.
        doubt: why the angles in the names are not used; empty if they are used or the names have none.
        half_turn: images in a separate folder whose name means 180 degrees; they are invalid frames.
    """

    names: list[str]
    kinds: NDArray[np.int32]
    angles: NDArray[np.float64]
    numbers: NDArray[np.int64] | None
    of_series: NDArray[np.int64] | None
    plain: list[str]
    doubt: str
    half_turn: list[str]

    @property
    def references(self) -> list[str]:
        """Names of the darks and flats."""
        return [name for name, kind in zip(self.names, self.kinds, strict=True) if kind in _REFERENCES]

    @property
    def series(self) -> list[str]:
        """Names of the projections."""
        return [name for name, kind in zip(self.names, self.kinds, strict=True) if kind == FrameKind.PROJECTION]


_REFERENCES = FrameKind.DARK, FrameKind.FLAT


def in_order(path: object, images: Sequence[str], *, one_series: bool = False) -> NamedImages:
    """The images of a scan, in order.

    Args:
        one_series: True if all images are one numbered series, whatever kinds the names state.

    Raises:
        DataError: no series can be recognised as the projections, or there are several.
    """
    images = natural_sorted(images)
    kinds = dict.fromkeys(images, FrameKind.PROJECTION) if one_series else kinds_of(path, images)
    series = [name for name in images if kinds[name] is FrameKind.PROJECTION]
    half_turn = [] if one_series else _half_a_turn_on(series)
    series = [name for name in series if name not in {*half_turn}]
    stated = angles_in(series)
    places = _places(path, stated, images, one_series=one_series)
    taken = np.argsort(places, kind="stable") if stated.radians is None else np.lexsort((stated.radians, places))
    references = [name for kind in _REFERENCES for name in images if kinds[name] is kind]
    within = dict(zip(images, _without_common_folder(images), strict=True))
    before = [name for name in references if not _AFTER.search(within[name].lower())]
    behind = [name for name in references if name not in {*before}] + half_turn
    names, plain = [*before, *(series[i] for i in taken), *behind], [stated.plain[i] for i in taken]
    kinds |= dict.fromkeys(half_turn, FrameKind.INVALID)
    of_kinds = np.array([kinds[name] for name in names], np.int32)
    views, of_angles = of_kinds == FrameKind.PROJECTION, np.full(len(names), np.nan)
    if stated.radians is not None:
        of_angles[views] = stated.radians[taken]
    together, of_series = _frame_numbers(names), _frame_numbers(plain)
    if (together is None or half_turn) and of_series is not None:
        together = np.full(len(names), -1)
        together[views] = of_series
    return NamedImages(names, of_kinds, of_angles, together, of_series, plain, stated.doubt, half_turn)


def _half_a_turn_on(series: list[str]) -> list[str]:
    """The images in the only folder whose name means 180 or 360 degrees, if it lies next to all other images."""
    stated = {name: _DEGREES.search(name.lower().rpartition("/")[0]) for name in series}
    named = [name for name, match in stated.items() if match and match[1] in ("180", "360")]
    return named if 2 * len(named) < len(series) and len(named) == sum(map(bool, stated.values())) else []


def _places(path: object, stated: NamedAngles, images: Sequence[str], *, one_series: bool) -> NDArray[np.int64]:
    """The number of each image of a series, from its name without an angle. Raises DataError if there are several
    series.

    If series are numbered separately, for example because their names state their kinds, they follow one another.

    Args:
        images: all images of the scan, including those of other kinds.
    """
    plain = stated.plain
    counted, several = _numbers(plain), len({_template(name, stated.doubt) for name in plain}) > 1
    if counted is not None and several and one_series and np.unique(counted).size < counted.size:
        within = _without_common_folder(plain)
        sorted_numbers = sorted(range(len(plain)), key=lambda i: (_rank(within[i]), _template(plain[i]), counted[i]))
        return np.argsort(sorted_numbers)
    if counted is not None and (one_series or not several):
        return counted
    if len(plain) > 1 and (several or (stated.radians is None and not stated.doubt)):
        raise DataError(_several_series(path, plain, [] if one_series else images))
    ordered = {name: i for i, name in enumerate(natural_sorted(set(plain)))}
    return np.array([ordered[name] for name in plain], np.int64)


def _rank(name: str) -> int:
    """Sort key of an image by its kind: darks, flats, projections, then darks and flats taken afterwards."""
    kind = _kind_of(name)
    return (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION).index(kind) + 3 * (
        kind in _REFERENCES and _AFTER.search(name.lower()) is not None
    )


def _template(name: str, doubt: str = "") -> str:
    """A name without its numbers. If it is unclear whether marks before numbers are signs, the marks are removed,
    too.
    """
    return re.sub(r"[-+_\d]+" if doubt else r"\d+", "", name)


def _numbers(names: Sequence[str]) -> NDArray[np.int64] | None:
    """The number of each image, at any place in the name; None if no number differs from name to name.

    If several numbers differ from name to name, the number whose values are closest to consecutive is used. Any other
    number, such as a date, may only change together with it.
    """
    numbers = np.zeros(len(names), np.int64)
    of_template: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        of_template.setdefault(_template(name), []).append(i)
    for rows in of_template.values():
        column = _counting([names[i] for i in rows])
        if column is None:
            return None
        numbers[rows] = column
    return numbers if np.unique(numbers).size == len(names) or len(of_template) > 1 else None


def _counting(names: list[str]) -> list[int] | None:
    """The number whose values are closest to consecutive, in names that differ only in numbers."""
    digits = [re.findall(r"\d+", name) for name in names]
    columns = [[int(each[-18:]) for each in column] for column in zip(*digits, strict=False)]
    if not columns or len({len(each) for each in digits}) > 1:
        return None
    varying = [n for n, column in enumerate(columns) if len(set(column)) > 1] or [len(columns) - 1]
    counting = [n for n in varying if len(set(columns[n])) == len(names)]
    dates = {n for n in varying if min(columns[n]) >= _DATE}
    if not counting or set(varying) - {*counting} - dates:
        decimals = [re.findall(r"\d+[.,]\d+", name) for name in names]
        values = [float(each[0].replace(",", ".")) for each in decimals if len(each) == 1]
        ranks = np.unique(values, return_inverse=True)[1].tolist()
        return ranks if len({*ranks}) == len(names) else None  # for example angles: they state only the order
    return columns[min(counting, key=lambda n: (max(columns[n]) - min(columns[n]), columns[n], -n))]


def _frame_numbers(names: Sequence[str]) -> NDArray[np.int64] | None:
    """The numbers of the images if they count frames; None if they are, for example, dates."""
    numbers = _numbers(names)
    counts = numbers is not None and np.ptp(numbers) <= COUNTED * np.unique(numbers).size == COUNTED * numbers.size
    return numbers if counts else None


def places_of(names: Sequence[str]) -> str:
    """The rows that the images of each series have in the scan, such as "dark_#.tif 0:5, s_#.tif 5:95"."""
    of_names = groupby(range(len(names)), lambda place: re.sub(r"\d+", "#", names[place]))
    runs = [
        f"{name} {places[0]}:{places[-1] + 1}" for name, numbers_of_name in of_names for places in [[*numbers_of_name]]
    ]
    return ", ".join(runs[:_LISTED]) + ", ..." * (len(runs) > _LISTED)


_LISTED = 6  # largest number of series that a sentence lists


def _several_series(path: object, names: Sequence[str], images: Sequence[str]) -> str:
    templates = [_template(name) for name in names]
    if len(set(templates)) == 1:
        templates = [re.sub(r"\d+(?=\D*$)", "", name) for name in names]
    numbers = ", ".join(
        f"{count(templates.count(kind), 'image')} like {kind!r}" for kind in sorted(set(templates))[:_LISTED]
    )
    places = ""
    with suppress(DataError):  # there is no order if images with the same names are again in several series
        if images:
            places = f", counted from 0 in this order: {places_of(in_order(path, images, one_series=True).names)}"
    return (
        f"{path} contains several series of images: {numbers}. Name darks and flats as such (dark_0001.tif, "
        "flat_0001.tif). Or give the folder of the projections, and the other images separately with --darks and "
        "--flats. Or state which images are which: --frames darks=0:5,flats=5:10, with none=10:12 for images to "
        f"leave out{places}. Angles are read from names such as a_angle-12.5_01.tif."
    )
