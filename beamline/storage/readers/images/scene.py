"""Scenes of the published R²-Gaussian: a folder with meta_data.json and an .npy of line integrals for each view.

Zha et al. 2024, NeurIPS, github.com/Ruyi-Zha/r2_gaussian. Its scanner has no unit of length: one of its units counts as
1 mm, so that densities are those of its volume. Views and angles are taken as they stand. There the first row of a view
is the highest z, and the source stands at (DSO cos θ, DSO sin θ, 0): a volume [z, y, x] of ours shows the same as
`vol_gt.transpose(2, 0, 1)[::-1, ::-1]` of its volume [x, y, z].
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import DataError
from beamline.core.files import is_below, text_in
from beamline.storage.readers.base import NotUsed, Opening, ScanFormat, ScanSource
from beamline.storage.readers.images.tiff_series import TiffSeriesSource
from beamline.storage.readers.nexus import differing

_META = "meta_data.json"
_TEST = "views that its authors keep to judge by; they are left out"
_AXES = "volume[z, y, x] is vol_gt.transpose(2, 0, 1)[::-1, ::-1]; lengths in mm are units of the scene"


def _folder(path: Path) -> Path | None:
    """The folder of a scene, by itself or by its file; None for another path."""
    folder = path.parent if path.name == _META else path
    file = folder / _META
    return folder if file.is_file() and '"proj_train"' in text_in(file) else None


def _open(path: Path, opening: Opening) -> ScanSource:
    folder = _folder(path)
    assert folder is not None
    meta: dict[str, Any] = json.loads(text_in(folder / _META))
    scanner, angles = meta["scanner"], {str(view["file_path"]): float(view["angle"]) for view in meta["proj_train"]}
    beams = {"cone": (float(scanner["DSO"]), float(scanner["DSD"])), "parallel": None}
    if (mode := scanner["mode"]) not in beams or not angles:
        raise DataError(f"{folder / _META} states {len(angles)} views in the mode {mode!r}; expected cone or parallel.")
    if lost := [name for name in angles if not is_below(folder, name)]:
        raise DataError(
            f"{folder / _META} names {len(angles)} views, of which {len(lost)} are not there, such as {lost[0]}. Fetch "
            "them, or take them out of its list. Nothing was read."
        )
    source = TiffSeriesSource(folder, listed=[*angles])
    source.format, source.quantity = "r2_gaussian_scene", "line_integrals"
    source.angles = np.array([angles[name] for name in source.names])
    source.cone = beams[mode]
    size, n = np.broadcast_to(scanner.get("sDetector", 0), 2), np.broadcast_to(scanner["nDetector"], 2)
    height, width = map(float, np.broadcast_to(scanner.get("dDetector", size / n), 2))
    source.pixel_size_mm, source.row_pitch_mm = width, differing(height, width)
    moved = {name: scanner[name] for name in ("offDetector", "offOrigin") if np.any(scanner.get(name, 0))}
    source.axis_col = None if "offDetector" in moved else (source.shape[1] - 1) / 2
    source.facts = {**source.facts, "axes": _AXES}
    source.not_used += tuple(NotUsed(f"scanner/{name}", str(value), _MOVED, True) for name, value in moved.items())
    if test := meta.get("proj_test"):
        source.not_used += (NotUsed("proj_test", f"{len(test)} views", _TEST, False),)
    return source


_MOVED = "the axis is searched, and the central ray meets the middle row; --axis states the axis"
FORMAT = ScanFormat("a scene of R²-Gaussian (meta_data.json)", lambda path, _: _folder(path) is not None, _open)
