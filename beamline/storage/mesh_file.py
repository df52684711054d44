"""Meshes as files, STL, PLY or OBJ by the suffix: read from text or binary, written as binary with their unit."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import require_regular, whole_file

if TYPE_CHECKING:
    from recon.post.surface import Mesh  # imports scipy, and help reads the suffixes here

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
        triangles = READERS[path.suffix.lower()](path.read_bytes())
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
        lines = body.decode().splitlines()
        at = [name for name, _ in own]
        rows = np.array([line.split() for line in lines[: n["vertex"]]], np.float64)
        faces = np.array([line.split() for line in lines[n["vertex"] : n["vertex"] + n["face"]]], np.int64)
        return _corners(rows[:, [at.index(axis) for axis in "xyz"]], faces[:, 1:])
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise ValueError("a PLY is text or binary little-endian")
    vertices = np.frombuffer(body, np.dtype(own), n["vertex"])
    listed = np.frombuffer(body, np.dtype([("n", count), ("corners", index, 3)]), n["face"], vertices.nbytes)
    if (listed["n"] != 3).any():
        raise ValueError("a face has more than three corners")
    return _corners(np.stack([vertices[axis] for axis in "xyz"], axis=1), listed["corners"])


def _corners(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Reals:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces have shape {faces.shape}; expected three corners each")
    if faces.min(initial=0) < 0:
        raise ValueError("a face names a corner before the first one")
    return vertices[faces].astype(np.float64)


READERS = {".stl": _stl, ".ply": _ply, ".obj": _obj}

_TOGETHER = 2**16  # triangles or vertices


def _stl_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    """Header of 80 bytes, count, then of each triangle normal, corners and a spare number (little-endian)."""
    yield f"binary STL by splatline, lengths in {unit}".encode().ljust(80)
    yield np.uint32(len(mesh.faces)).astype("<u4").tobytes()
    for first in range(0, len(mesh.faces), _TOGETHER):
        corners = mesh.vertices[mesh.faces[first : first + _TOGETHER]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        rows = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
        rows["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        rows["corners"] = corners
        yield rows.tobytes()


def _ply_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    yield (
        f"ply\nformat binary_little_endian 1.0\ncomment splatline, lengths in {unit}\nelement vertex "
        f"{len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\nelement face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    yield mesh.vertices.astype("<f4").tobytes()
    for first in range(0, len(mesh.faces), _TOGETHER):
        corners = mesh.faces[first : first + _TOGETHER]
        rows = np.full(len(corners), 3, [("n", "u1"), ("corners", "<i4", 3)])
        rows["corners"] = corners
        yield rows.tobytes()


def _obj_bytes(mesh: Mesh, unit: str) -> Iterator[bytes]:
    yield f"# splatline, lengths in {unit}\n".encode()
    for first in range(0, len(mesh.vertices), _TOGETHER):
        yield b"".join(b"v %.9g %.9g %.9g\n" % tuple(v) for v in mesh.vertices[first : first + _TOGETHER].tolist())
    for first in range(0, len(mesh.faces), _TOGETHER):
        yield b"".join(b"f %d %d %d\n" % tuple(f) for f in (mesh.faces[first : first + _TOGETHER] + 1).tolist())


MESHES = {".stl": _stl_bytes, ".ply": _ply_bytes, ".obj": _obj_bytes}


def write_mesh(path: Path, mesh: Mesh, unit: str) -> None:
    """Write a mesh in the format that the suffix names, one of MESHES.

    Raises:
        DataError: `path` exists, or the disk refuses; nothing is left.
    """
    with whole_file(path) as partial, partial.open("wb") as file:
        for part in MESHES[path.suffix.lower()](mesh, unit):
            file.write(part)
