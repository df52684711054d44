"""Writes meshes, STL, PLY or OBJ by the suffix, as binary with their unit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beamline.core.files import whole_file

if TYPE_CHECKING:
    from recon.features.surfaces.mesh import Mesh

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
