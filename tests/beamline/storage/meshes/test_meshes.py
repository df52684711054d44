"""Meshes from files: those that we write, text by hand, and a round trip from a mesh by its scan to a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.meshes import read_mesh

TEXT = {
    "a.stl": "solid a\n facet normal 0 0 1\n  outer loop\n   vertex 0 0 0\n   vertex 1 0 0\n   vertex 0 2 0\n"
    "  endloop\n endfacet\nendsolid a\n",
    "a.obj": "# text\nv 0 0 0\nv 1 0 0 \nv 0 2 0\nvn 0 0 1\nf 1//1 2//1 3//1\n",
    "b.obj": "v 0 0 0\nv 1 0 0\nv 0 2 0\nf -3 -2 -1\n",
    "a.ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2\n",
}


@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["unix", "windows"])
@pytest.mark.parametrize("name", TEXT)
def test_text(tmp_path: Path, name: str, end: str) -> None:
    (tmp_path / name).write_bytes(TEXT[name].replace("\n", end).encode())
    np.testing.assert_array_equal(read_mesh(tmp_path / name), [[[0, 0, 0], [1, 0, 0], [0, 2, 0]]])


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("points.ply", TEXT["a.ply"].split("element face")[0] + "end_header\n0 0 0\n1 0 0\n0 2 0\n", "it has no faces"),
        ("head.ply", TEXT["a.ply"].split("end_header")[0], "its header does not end"),
        ("a.obj", TEXT["a.obj"].replace("1//1", "0//1"), "a corner before the first one"),
        ("a.obj", TEXT["a.obj"].replace("3//1", "3//1 1//1"), "expected three corners each"),
        ("a.obj", TEXT["a.obj"].replace("3//1", "4//1"), "out of bounds"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text, "utf-8")
    with pytest.raises(DataError, match=said):
        read_mesh(tmp_path / name)
