"""Angles in the names of image files, and why a number in a name may not be an angle."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import are_a_count

_NUMBER = re.compile(
    r"(?P<word>(?<![a-z])(?:angle|theta|ang|deg)(?:[ _=(]|-(?=[-+\u2212]))?)?"
    # the characters are a hyphen, an en dash and a minus sign
    r"(?P<mark>(?:minus|plus|neg|pos)[ _]?|[-+\u2013\u2212mnp])?"
    r"(?P<value>(?P<whole>\d+)(?:[.,p](?P<part>\d+))?(?:e[-+]\d+)?)"
    r"(?P<unit>[ _]?(?:deg|°|tilt))?",
    re.IGNORECASE,
)
_MINUS = re.compile(r"minus|neg|[-\u2013\u2212mn]", re.IGNORECASE)
_THOUSANDTHS = re.compile(r"_(?P<mark>)(?P<value>(?P<whole>\d{3})_(?P<part>\d{3}))(?=_\d+$)")
_FOLLOWING = re.compile(r"[-_ ]?(\d{1,4})(?!\d)")  # a number with more digits is a date or a time
_PRECEDING = re.compile(r"(?<!\d)(\d{1,4})[-_ ]?$")
_LEAST_SPAN = 90.0  # degrees; tile numbers or times of day cover a smaller range
_FARTHEST = 3600.0  # degrees; no scan rotates farther
_TURN = 360.0  # degrees; largest angle written as a number with a sign but without a word
# least share of steps that are alike, and how far these may differ from the typical step, because images may be missing
# and angles are rounded
_EVEN, _ALIKE = 0.8, 0.3
# least share of angles that are different: if signs are lost, each angle occurs twice; a scan may repeat some
# projections at its end
_DISTINCT = 0.97


class NamedAngles(NamedTuple):
    """The angles in the file names of a series.

    Attributes:
        plain: the names without the angles.
        radians: float64 [file]; None if the names state no angles, or if they can be read in two ways.
        doubt: a description of these two ways; "" if there is no doubt.
    """

    plain: list[str]
    radians: NDArray[np.float64] | None = None
    doubt: str = ""


def angles_in(names: Sequence[str]) -> NamedAngles:
    """Find the angles in file names. An angle is written in one of three ways. (1) A number next to `angle`, `theta`,
    `ang` or `deg`, or before `tilt`. (2) The only number that has a minus in some names and not in others. (3) Three
    digits of degrees and three digits of thousandths before the number of the frame (MARS and VENUS of ORNL:
    sample_012_500_0003.tiff).

    Decimals follow a point, a comma or the letter p. The texts n, m, neg and minus mean a negative sign, as a hyphen
    does.
    """
    stems = [name.rpartition("/")[2].rpartition(".")[0] for name in names]
    numbers = [[*_NUMBER.finditer(stem)] for stem in stems]
    chosen, words = _chosen(stems, numbers)
    if not chosen or len(chosen) != len(stems):
        return NamedAngles([*names])
    degrees, doubt = _read(chosen)
    if np.ptp(degrees) < _LEAST_SPAN or np.abs(degrees).max() > _FARTHEST:
        return NamedAngles([*names])
    others = [[each["value"] for each in row if each is not its] for row, its in zip(numbers, chosen, strict=True)]
    another = any(len({*each}) > 1 and not are_a_count(each) for each in zip(*others, strict=False))
    doubt = _doubt_of_series(chosen, np.unique(degrees), doubt, words=words, another=another)
    if doubt:
        example = stems[-1]
        doubt = f"angles in names such as {example} are not used, because {doubt}"
    plain = [_without(name, match) for name, match in zip(names, chosen, strict=True)]
    return NamedAngles(plain, None if doubt else np.radians(degrees), doubt)


def _chosen(stems: list[str], numbers: list[list[re.Match[str]]]) -> tuple[list[re.Match[str]], bool]:
    """The number in each name that may be an angle, and whether a word marks it. Names without such a number are left
    out.
    """
    worded = [[number for number in row if number["word"] or number["unit"]] for row in numbers]
    if any(worded):
        return [row[0] for row in worded if len(row) == 1], True
    return [match for stem in stems if (match := _THOUSANDTHS.search(stem))] or _with_signs(numbers), False


def _doubt_of_series(
    chosen: list[re.Match[str]], distinct: NDArray[np.float64], doubt: str, *, words: bool, another: bool
) -> str:
    """The reason why the numbers of a series may not be angles; "" if they certainly are.

    Args:
        distinct: the different angles in degrees, ascending.
        doubt: what is unclear about signs and decimals.
        words: True if a word for angles stands next to the numbers.
        another: True if another number differs from name to name and does not count images.
    """
    counted = are_a_count([each["value"] for each in chosen]) and (another or len(chosen[0]["value"]) > 3)
    uneven = chosen[0].re is _NUMBER and (np.abs(distinct).max() > _TURN or not _in_even_steps(distinct))
    if words and counted:
        return "the number next to the word for the angle only counts the images"
    if not words and uneven:
        return doubt or "the numbers with signs are not evenly spaced within 360 degrees"
    if distinct.size < _DISTINCT * len(chosen):
        return (
            doubt or f"{len(chosen)} names give only {distinct.size} different angles. Are signs or decimals missing?"
        )
    return doubt


def _without(name: str, angle: re.Match[str]) -> str:
    folder, slash, stem = name.rpartition("/")
    stem, dot, suffix = stem.rpartition(".")
    return f"{folder}{slash}{(stem[: angle.start()] + stem[angle.end() :]).rstrip('_- =()')}{dot}{suffix}"


def _with_signs(numbers: list[list[re.Match[str]]]) -> list[re.Match[str]]:
    """The only number that has a minus in some names and not in others; empty if there is no such number, or
    several.
    """
    alike = len({len(row) for row in numbers}) == 1
    columns = [[*column] for column in zip(*numbers, strict=True)] if alike else []
    signed = [column for column in columns if 0 < sum(map(_is_minus, column)) < len(column)]
    return signed[0] if len(signed) == 1 else []


def _is_minus(number: re.Match[str]) -> bool:
    return _MINUS.match(number["mark"] or "") is not None


def _read(chosen: list[re.Match[str]]) -> tuple[NDArray[np.float64], str]:
    """The angles in degrees, and the reason why they may be read in another way; "" if they are certain."""
    degrees = np.array([float(re.sub("[,p_]", ".", each["value"].lower())) for each in chosen])
    before = [each.string[: each.start("mark" if each["mark"] else "value")] for each in chosen]
    minus = np.array([*map(_is_minus, chosen)])
    if minus.all():
        if _separates(chosen, before, zero=0 in degrees):
            minus[:] = False
        elif (mark := _mark(chosen[0])) in "mn-\u2013":
            character = mark if mark in "mn" else "hyphen"
            return degrees, f"the {character} before the number may be a minus sign or a separator"
    if doubt := _doubt_of_decimals(chosen, before):
        return degrees, doubt
    if len({re.sub(r"\d+", "", text) for text in before}) > 1:
        return degrees, "the names differ before the angle, for example because a sign was replaced"
    return np.where(minus, -degrees, degrees), ""


def _mark(number: re.Match[str]) -> str:
    return number["mark"].rstrip("_ ").lower()


def _separates(chosen: list[re.Match[str]], before: list[str], *, zero: bool) -> bool:
    """True if the mark before the numbers is a separator and not a sign. It is a separator if it stands before all
    numbers, these have the same width, and one of them is 0, because 0 has no sign. A hyphen in only some names is a
    sign.
    """
    wholes = [each["whole"] for each in chosen]
    padded = {len(whole) for whole in wholes} == {max(2, len(wholes[0]))}
    return all(text[-1:].isalnum() for text in before) and (_mark(chosen[0]) in "mn" or (zero and padded))


def _doubt_of_decimals(chosen: list[re.Match[str]], before: list[str]) -> str:
    """The reason why it is unclear whether the digits after a point, or next to the number, are decimals; "" if it is
    clear.
    """
    parts, wholes = [each["part"] or "" for each in chosen], [each["whole"] for each in chosen]
    if are_a_count(parts) or (are_a_count(wholes) and len({*parts}) > 1):
        return "the digits before or after the decimal mark only count the images"
    following = [_FOLLOWING.match(each.string[each.end() :]) for each in chosen]
    for matches in (following, [_PRECEDING.search(text) for text in before]):
        halves = np.sort([int(each[1]) for each in matches if each])
        if not any(parts) and halves.size == len(chosen) and np.ptp(halves) and not _in_even_steps(halves):
            return (
                "the number next to each angle does not count the images. Are the two numbers the integer part and "
                "the decimals of one angle?"
            )
    return ""


def _in_even_steps(ascending: NDArray[Any]) -> bool:
    """True if the steps of all numbers but a few are alike; some images may be lost."""
    steps = np.diff(ascending)
    return bool(steps.all() and np.mean(np.abs(steps - np.median(steps)) < _ALIKE * np.median(steps)) > _EVEN)
