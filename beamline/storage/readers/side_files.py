"""Reads the settings files that CT scanners write next to their images: distances, pixel size, angles and white level.

Nikon's .xtekct, SkyScan's .log, GE phoenix's .pca, ScanParameter.xml of YXLON, the .xml of Diondo and
the "data settings XRE.txt" of TESCAN (FleXray), by the keys that public readers use (TIGRE, CIL). If a key is missing,
its value is not guessed.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import SETTINGS, decoded, require_regular
from beamline.core.text import NUMBER, with_points
from beamline.storage.readers.base import NotUsed, ScanSource
from beamline.storage.readers.frames import Frames

_MOST = 20  # largest number of files next to a scan that are examined


@dataclass(frozen=True)
class MakerKeys:
    """Keys in a vendor's file, as "section/key" in lower case; "" for a value that the file does not contain.

    Attributes:
        sod, sdd: distances in mm from the source to the rotation axis and to the detector.
        pixel: width of a pixel; its value times `unit` is in mm. It is measured at the sample if `at_sample` is True,
            otherwise on the detector.
        count: of the projections.
        step, span: angle in degrees between two projections, and of the whole scan.
        first, last: angles in degrees of the first and of the last projection.
        white: counts of the open beam.
        scale: factor on both distances.
        helix: keys that are "true" if the source moves on another path than a circle.
    """

    maker: str
    suffix: str
    sod: str
    sdd: str
    pixel: str
    count: str
    unit: float = 1.0
    at_sample: bool = False
    step: str = ""
    span: str = ""
    first: str = ""
    last: str = ""
    white: str = ""
    scale: str = ""
    helix: tuple[str, ...] = ()


_XRE = "ct-parameters in/"
_YXLON = "conebeamscanparameter/scantrajectory/"
MAKERS = (
    MakerKeys(
        "Nikon", ".xtekct", "xtekct/srctoobject", "xtekct/srctodetector", "xtekct/detectorpixelsizex",
        "xtekct/projections", step="xtekct/angularstep", first="xtekct/initialangle", white="xtekct/whitelevel",
    ),
    MakerKeys(
        "SkyScan", ".log", "acquisition/object to source (mm)", "acquisition/camera to source (mm)",
        "acquisition/image pixel size (um)", "acquisition/number of files", unit=1e-3, at_sample=True,
        step="acquisition/rotation step (deg)",
    ),
    MakerKeys(
        "GE phoenix", ".pca", "geometry/fod", "geometry/fdd", "geometry/voxelsizex", "ct/numberimages", at_sample=True,
        span="ct/rotationsector",
    ),
    MakerKeys(
        "YXLON", ".xml", f"{_YXLON}fod", f"{_YXLON}fdd", "conebeamscanparameter/pixelsize/width",
        f"{_YXLON}numberofprojections", span=f"{_YXLON}rotation", first=f"{_YXLON}startangle",
        scale=f"{_YXLON}pixelpitch",
    ),
    MakerKeys(
        "Diondo", ".xml", "geometrie/sourceobjectdist", "geometrie/sourcedetectordist", "recon/projectionpixelsizex",
        "recon/projectioncount", helix=("scanparameter/helixmode", "scanparameter/laminography"),
    ),
    MakerKeys(
        "TESCAN", ".txt", f"{_XRE}sod", f"{_XRE}sdd", f"{_XRE}pixel size", f"{_XRE}projections",
        first=f"{_XRE}start angle", last=f"{_XRE}last angle",
    ),
)  # fmt: skip
_ROUND = {"Diondo": 360.0}  # total angle in degrees, for a maker whose files do not state it


@dataclass(frozen=True, eq=False)
class SideFile:
    """The geometry of a scan according to a vendor's file; None for values that the file does not state.

    Attributes:
        cone: mm from the source to the rotation axis and to the detector.
        pixel_mm: width of a pixel on the detector.
        count: number of projections. angles: float64 [projection] radians.
        white: counts of the open beam.
    """

    path: Path
    maker: str
    cone: tuple[float, float]
    pixel_mm: float
    count: int
    angles: NDArray[np.float64] | None
    white: float | None

    @property
    def option(self) -> str:
        """The command line option that selects this file."""
        return f'--scanner-file "{self.path}"' if " " in str(self.path) else f"--scanner-file {self.path}"

    def __str__(self) -> str:
        sod, sdd = self.cone
        angles = "" if self.angles is None else f", angles from {np.degrees(self.angles[0]):.6g} to "
        angles += "" if self.angles is None else f"{np.degrees(self.angles[-1]):.6g} degrees"
        white = "" if self.white is None else f", white level {self.white:g}"
        return (
            f"{self.maker}: {self.count} projections, source {sod:g} mm from the axis and {sdd:g} mm from the "
            f"detector, pixels of {self.pixel_mm:g} mm{angles}{white}"
        )


def with_side_file(base: ScanSource, side: SideFile) -> ScanSource:
    """A scan with the distances and the pixel size of a vendor's file. Raises DataError if the file states another
    number of projections.
    """
    views = base.table.views.size
    if views != side.count:
        raise DataError(f"{side.path} describes {side.count} projections, but {base.path} has {views}.")
    return Frames(
        base,
        cone=side.cone,
        pixel_size_mm=side.pixel_mm,
        row_pitch_mm=None,
        not_used=tuple(field for field in base.not_used if field.where != side.path.name),
        attributes=lambda known: {**known, "from": f"{side.path.name}, {side}"},
    )


def read_side_file(path: Path) -> SideFile:
    """Read a vendor's file.

    Raises:
        DataError: the file is not of a known vendor, or a distance, the pixel size or the number of projections is
            missing.
    """
    try:
        values = _values(path)
    except (OSError, ValueError, configparser.Error, ElementTree.ParseError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"{path} cannot be read as a settings file of a CT scanner ({reason}).") from error
    for keys in MAKERS:
        if keys.suffix == path.suffix.lower() and keys.sod in values:
            return _side_file(path, keys, values)
    known = ", ".join(f"{keys.maker} {keys.suffix}" for keys in MAKERS)
    raise DataError(f"{path} is not a supported settings file of a CT scanner ({known}).")


def side_of(source: ScanSource) -> SideFile | None:
    """The vendor's file in a folder of images, next to the folder, or next to a TIFF. None unless exactly one file
    states the same number of projections.
    """
    if not source.side_files:
        return None
    views, sides = source.table.views.size, []
    for path in _candidates(source.path):
        # these files are only read to make a suggestion, so no content of theirs may raise an error
        with suppress(Exception):
            sides.append(read_side_file(path))
    sides = [side for side in sides if side.count == views]
    return sides[0] if len(sides) == 1 else None


def reconstructed_pixel_mm(log: Path) -> float | None:
    """Voxel size in mm from the log that NRecon writes next to its slices; None if the log does not state it."""
    with suppress(Exception):  # the log of another program may contain anything
        edge = float(with_points([_values(log)["reconstruction/pixel size (um)"]])[0]) * 1e-3
        return edge if 0 < edge < _LARGEST else None
    return None


def offered(source: ScanSource) -> tuple[NotUsed, ...]:
    """A sentence that says what a vendor's file next to these images contains."""
    side = side_of(source)
    return () if side is None else (NotUsed(side.path.name, str(side), f"{side.option} uses it", True),)


def _candidates(scan: Path) -> Iterator[Path]:
    suffixes, n = {keys.suffix for keys in MAKERS}, 0
    for folder in (scan, scan.parent) if scan.is_dir() else (scan.parent,):
        for path in sorted(folder.glob("*.*")):
            if path.suffix.lower() in suffixes and n < _MOST:
                n += 1
                yield path


def _values(path: Path) -> dict[str, str]:
    """The values in an INI, JSON or XML file, as text, by "section/key" in lower case."""
    text, values = _text(path), dict[str, str]()
    if path.suffix.lower() == ".xml":
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("the file defines XML entities, which this program does not read")
        _of_element(ElementTree.fromstring(text), "", values)
    elif text.lstrip().startswith("{"):
        _of_json(json.loads(text), "", values)
    else:
        parser = configparser.RawConfigParser(strict=False, allow_no_value=True, delimiters=("=",))
        lines = "\n".join(map(str.strip, text.splitlines()))  # an indented line does not continue the line before
        # TESCAN's files have a key that begins like a comment
        parser.read_string(lines.replace("\n# projections", "\nprojections"))
        values = {
            f"{section}/{key}".lower(): (value or "").strip('"')
            for section in parser
            for key, value in parser[section].items()
        }
    return values


def _text(path: Path) -> str:
    """The content of a small file. Characters of a Windows code page do not matter, because numbers and keys are
    ASCII.
    """
    require_regular(path, SETTINGS)
    return decoded(path.read_bytes(), "replace")


def _of_element(element: ElementTree.Element, path: str, values: dict[str, str]) -> None:
    for child in element:
        name = f"{path}{child.tag.rpartition('}')[2].lower()}"
        values.setdefault(name, (child.text or "").strip())
        _of_element(child, f"{name}/", values)


def _of_json(item: Any, path: str, values: dict[str, str]) -> None:
    for key, value in item.items():
        if isinstance(value, dict):
            _of_json(value, f"{path}{key.lower()}/", values)
        else:
            values[f"{path}{key.lower()}"] = str(value)


def _numbers(path: Path, keys: MakerKeys, values: Mapping[str, str]) -> dict[str, float | None]:
    """The number at the beginning of the text of each key, by the names in MakerKeys; None if the text does not begin
    with a number.
    """
    names = ("sod", "sdd", "pixel", "count", "step", "span", "first", "last", "white", "scale")
    texts = [values.get(getattr(keys, name), "") for name in names]
    try:
        numbers = (re.match(rf"\s*[-+]?{NUMBER}", text) for text in with_points(texts))
    except ValueError as error:
        raise DataError(f"{path}: {error}.") from error
    return {name: number and float(number[0]) for name, number in zip(names, numbers, strict=True)}


_NEEDED = "sod", "sdd", "pixel", "count"
_LARGEST = 1e7  # largest number accepted: no scan has as many projections, and no distance is as long in mm


def _side_file(path: Path, keys: MakerKeys, values: Mapping[str, str]) -> SideFile:
    number = _numbers(path, keys, values)
    if other := next((key for key in keys.helix if values.get(key, "").lower() == "true"), ""):
        raise DataError(f"{path} states {other}: only scans on a circle are supported.")
    sod, sdd, pixel, count = (number[name] or 0.0 for name in _NEEDED)
    if lacking := [getattr(keys, name) for name in _NEEDED if not 0 < (number[name] or 0) < _LARGEST]:
        missing_values = ", ".join(lacking)
        raise DataError(f"{path} states no {missing_values}; expected positive numbers below {_LARGEST:g}.")
    pixel *= keys.unit * (sdd / sod if keys.at_sample else 1.0)
    n, scale = int(count), number["scale"] or 1.0
    angles = _degrees(path, keys, number, n)
    radians = None if angles is None else np.radians(angles)
    return SideFile(path, keys.maker, (sod * scale, sdd * scale), pixel, n, radians, number["white"])


def _degrees(path: Path, keys: MakerKeys, number: Mapping[str, float | None], n: int) -> NDArray[np.float64] | None:
    """The angle of each projection in degrees: as listed in a file next to it, or in equal steps. None if neither is
    stated.
    """
    if keys.maker == "Nikon" and (listed := _listed_angles(path, n)) is not None:
        return listed
    step, span = number["step"], number["span"] or _ROUND.get(keys.maker)
    if number["last"] is not None and n > 1:
        step = (number["last"] - (number["first"] or 0.0)) / (n - 1)
    if step is None and span is not None:
        step = span / n
    return None if step is None else (number["first"] or 0.0) + step * np.arange(n, dtype=np.float64)


def _listed_angles(path: Path, n: int) -> NDArray[np.float64] | None:
    """The angle of each projection in degrees, from `_ctdata.txt` next to Nikon's file. None if that file is missing or
    belongs to another scan.
    """
    files = sorted(path.parent.glob("*_ctdata.txt"))
    if len(files) != 1:
        return None
    try:
        rows = [line.split("\t") for line in _text(files[0]).splitlines()]
        listed = [row[1] for row in rows if len(row) >= 3 and row[0].strip().isdigit()]
        return np.array(with_points(listed), np.float64) if len(listed) == n else None
    except (OSError, ValueError):
        return None
