"""Reads meshes, STL, PLY or OBJ by the suffix, from text or binary."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import require_regular

MESHES = dict.fromkeys((".stl", ".ply", ".obj"), __name__)
"""Suffix -> the module that reads such a file."""

Reals = NDArray[np.float64]

_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1",
          "char": "i1", "int8": "i1", "short": "<i2", "ushort": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4",
          "uint32": "<u4"}  # fmt: skip
_LARGEST = 2**31  # bytes


def read_mesh(path: Path) -> Reals:
    """Corners [triangle, corner, (x, y, z)] in the file's unit.

    Raises:
        DataError: it cannot be read, or has faces of more than three corners.
    """
    try:
        require_regular(path, _LARGEST)
        triangles = _READERS[path.suffix.lower()](path.read_bytes())
        if not np.isfinite(triangles).all():
            raise ValueError("corners are not finite")
        return triangles
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise DataError(f"{path} cannot be read as a mesh of triangles: {error}. Nothing was written.") from error


def _stl(data: bytes) -> Reals:
    n = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * n:
        return np.frombuffer(data, _STL, n, 84)["corners"].astype(np.float64)
    words = [line.split()[1:4] for line in data.decode().splitlines() if line.strip().startswith("vertex")]
    return np.array(words, np.float64).reshape(-1, 3, 3)


def _obj(data: bytes) -> Reals:
    lines = [line.split() for line in data.decode().splitlines()]
    vertices = np.array([line[1:4] for line in lines if line[:1] == ["v"]], np.float64).reshape(-1, 3)
    faces = np.array([[int(word.split("/")[0]) for word in line[1:]] for line in lines if line[:1] == ["f"]], np.int64)
    return _corners(vertices, np.where(faces < 0, faces + len(vertices), faces - 1))


def _ply(data: bytes) -> Reals:
    head, *rest = re.split(rb"end_header\r?\n", data, maxsplit=1)
    if not rest:
        raise ValueError("its header does not end")
    body = rest[0]
    words = [line.split() for line in head.decode().splitlines()]
    n = {line[1]: int(line[2]) for line in words if line[:1] == ["element"]}
    own = [(line[2], _TYPES[line[1]]) for line in words if line[:1] == ["property"] and line[1] != "list"]
    lists = [line for line in words if line[:2] == ["property", "list"]]
    if not lists:
        raise ValueError("it has no faces")
    count, index = (_TYPES[name] for name in lists[0][2:4])
    if ["format", "ascii", "1.0"] in words:
        lines, at = [line.split() for line in body.decode().splitlines()], [name for name, _ in own]
        rows, faces = np.array(lines[: n["vertex"]], np.float64), lines[n["vertex"] : n["vertex"] + n["face"]]
        return _corners(rows[:, [at.index(axis) for axis in "xyz"]], np.array(faces, np.int64)[:, 1:])
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise ValueError("a PLY is text or binary little-endian")
    face = np.dtype([("n", count), ("corners", index, 3)])
    return _binary_ply(body, np.frombuffer(body, np.dtype(own), n["vertex"]), face, n["face"])


def _binary_ply(body: bytes, vertices: NDArray[Any], face: np.dtype[Any], n: int) -> Reals:
    listed = np.frombuffer(body, face, n, vertices.nbytes)
    if (listed["n"] != 3).any():
        raise ValueError("a face has more than three corners")
    return _corners(np.stack([vertices[axis] for axis in "xyz"], axis=1), listed["corners"])


def _corners(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Reals:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces have shape {faces.shape}; expected three corners each")
    if faces.min(initial=0) < 0:
        raise ValueError("a face names a corner before the first one")
    return vertices[faces].astype(np.float64)


_READERS = {".stl": _stl, ".ply": _ply, ".obj": _obj}
