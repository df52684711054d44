"""Settings files that CT scanners write next to their images: distances, pixel size, angles and white level.

Nikon's .xtekct, SkyScan's .log, GE phoenix's .pca, ScanParameter.xml of YXLON, the .xml of Diondo and
the "data settings XRE.txt" of TESCAN (FleXray), by the keys that public readers use (TIGRE, CIL). A value whose key is
missing is not guessed.
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

_MOST = 20  # files next to a scan that are looked at


@dataclass(frozen=True)
class MakerKeys:
    """Keys of a vendor's file, as "section/key" in lower case; "" for what it does not state.

    Attributes:
        sod, sdd: distances from the source to the axis and to the detector, mm.
        pixel: width of a pixel in mm, times `unit`; at the sample if `at_sample`.
        count: of the projections.
        step, span: degrees between two projections, or of all.
        first, last: degrees of the first projection, and of the last.
        white: counts of the open beam.
        scale: a factor of both distances.
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
_ROUND = {"Diondo": 360.0}  # degrees of the scans of a maker whose file states none


@dataclass(frozen=True, eq=False)
class SideFile:
    """The geometry of a scan stated by a vendor's file; None for what it does not state.

    Attributes:
        cone: mm from the source to the rotation axis and to the detector.
        pixel_mm: width of a pixel on the detector.
        count: of the projections.
        angles: float64 [projection] radians.
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
        """The option that takes the file, for a command line."""
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
    """A scan with the distances and the pixel size of a vendor's file; DataError if that has another number of
    projections.
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
        DataError: the file is of no known vendor, or a distance, the pixel size or the number of projections is
            missing.
    """
    try:
        values = _values(path)
    except (OSError, ValueError, configparser.Error, ElementTree.ParseError, RecursionError) as error:
        why = getattr(error, "strerror", None) or error
        raise DataError(f"{path} cannot be read as a settings file of a CT scanner ({why}).") from error
    for keys in MAKERS:
        if keys.suffix == path.suffix.lower() and keys.sod in values:
            return _side_file(path, keys, values)
    known = ", ".join(f"{keys.maker} {keys.suffix}" for keys in MAKERS)
    raise DataError(f"{path} is not a supported settings file of a CT scanner ({known}).")


def side_of(source: ScanSource) -> SideFile | None:
    """The vendor's file in a folder of images, or next to it or to a TIFF, if exactly one has the same number of
    projections.
    """
    if not source.side_files:
        return None
    views, found = source.table.views.size, []
    for path in _candidates(source.path):
        with suppress(Exception):  # what is only looked at, for an offer, stops no scan, whatever it holds
            found.append(read_side_file(path))
    found = [side for side in found if side.count == views]
    return found[0] if len(found) == 1 else None


def reconstructed_pixel_mm(log: Path) -> float | None:
    """Edge of a voxel in mm by the log that NRecon writes next to its slices; None if it states none."""
    with suppress(Exception):  # whatever the log of another program holds
        edge = float(with_points([_values(log)["reconstruction/pixel size (um)"]])[0]) * 1e-3
        return edge if 0 < edge < _LARGEST else None
    return None


def offered(source: ScanSource) -> tuple[NotUsed, ...]:
    """A sentence on the contents of a vendor's file next to these images."""
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
    """Texts by "section/key" in small letters, of an INI, JSON or XML file."""
    text, values = _text(path), dict[str, str]()
    if path.suffix.lower() == ".xml":
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("the file defines XML entities, which this program does not read")
        _of_element(ElementTree.fromstring(text), "", values)
    elif text.lstrip().startswith("{"):
        _of_json(json.loads(text), "", values)
    else:
        parser = configparser.RawConfigParser(strict=False, allow_no_value=True, delimiters=("=",))
        lines = "\n".join(map(str.strip, text.splitlines()))  # indented ones continue none
        parser.read_string(lines.replace("\n# projections", "\nprojections"))  # a key of TESCAN's, no comment
        values = {
            f"{section}/{key}".lower(): (value or "").strip('"')
            for section in parser
            for key, value in parser[section].items()
        }
    return values


def _text(path: Path) -> str:
    """The content of a small file; numbers and keys are also read if a Windows program wrote its own characters."""
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
    """The number at the beginning of the text of each key, by the names in MakerKeys; None for a text without one."""
    names = ("sod", "sdd", "pixel", "count", "step", "span", "first", "last", "white", "scale")
    texts = [values.get(getattr(keys, name), "") for name in names]
    try:
        numbers = (re.match(rf"\s*[-+]?{NUMBER}", text) for text in with_points(texts))
    except ValueError as error:
        raise DataError(f"{path}: {error}.") from error
    return {name: number and float(number[0]) for name, number in zip(names, numbers, strict=True)}


_NEEDED = "sod", "sdd", "pixel", "count"
_LARGEST = 1e7  # of these numbers: no scan has as many projections, and no distance is as long in mm


def _side_file(path: Path, keys: MakerKeys, values: Mapping[str, str]) -> SideFile:
    number = _numbers(path, keys, values)
    if other := next((key for key in keys.helix if values.get(key, "").lower() == "true"), ""):
        raise DataError(f"{path} states {other}: only scans on a circle are supported.")
    sod, sdd, pixel, count = (number[name] or 0.0 for name in _NEEDED)
    if lacking := [getattr(keys, name) for name in _NEEDED if not 0 < (number[name] or 0) < _LARGEST]:
        raise DataError(f"{path} states no {', '.join(lacking)}; expected positive numbers below {_LARGEST:g}.")
    pixel *= keys.unit * (sdd / sod if keys.at_sample else 1.0)
    n, scale = int(count), number["scale"] or 1.0
    angles = _degrees(path, keys, number, n)
    radians = None if angles is None else np.radians(angles)
    return SideFile(path, keys.maker, (sod * scale, sdd * scale), pixel, n, radians, number["white"])


def _degrees(path: Path, keys: MakerKeys, number: Mapping[str, float | None], n: int) -> NDArray[np.float64] | None:
    """Degrees of each projection: as listed next to the file, or in equal steps; None if nothing is stated."""
    if keys.maker == "Nikon" and (listed := _listed_angles(path, n)) is not None:
        return listed
    step, span = number["step"], number["span"] or _ROUND.get(keys.maker)
    if number["last"] is not None and n > 1:
        step = (number["last"] - (number["first"] or 0.0)) / (n - 1)
    if step is None and span is not None:
        step = span / n
    return None if step is None else (number["first"] or 0.0) + step * np.arange(n, dtype=np.float64)


def _listed_angles(path: Path, n: int) -> NDArray[np.float64] | None:
    """Degrees of each projection in `_ctdata.txt` beside Nikon's file; None if it is missing, or of another scan."""
    files = sorted(path.parent.glob("*_ctdata.txt"))
    if len(files) != 1:
        return None
    try:
        rows = [line.split("\t") for line in _text(files[0]).splitlines()]
        listed = [row[1] for row in rows if len(row) >= 3 and row[0].strip().isdigit()]
        return np.array(with_points(listed), np.float64) if len(listed) == n else None
    except (OSError, ValueError):
        return None
