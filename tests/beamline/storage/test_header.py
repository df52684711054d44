"""Headers that somebody has changed are refused in words, whatever their numbers are, and no pipe or link is read."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import describe
from beamline.storage.structure import dtype_of, require_held, shape_of
from beamline.storage.volume_file import read_volume
from beamline.storage.volumes.files import opened_volume, write_volume
from tests.beamline.storage.volumes.test_files import RECORD

NUMBERS: tuple[Any, ...] = (
    0, -1, 1.5, "abc", None, True, [], {}, 2**31, 2**62, 10**4000, -(10**400), 1e300, "9" * 5000,
)  # fmt: skip


@pytest.mark.parametrize("n", NUMBERS, ids=range(len(NUMBERS)))
def test_a_side_is_a_whole_number_of_a_volume_that_can_be(n: Any) -> None:
    for said in ([n, 2, 2], [2, n, 2], [2, 2, n], [n], n, (2**30, 2**30, 2**30)):
        with pytest.raises(ValueError, match=r"^.{1,200}$"):
            shape_of(said)


@pytest.mark.parametrize("said", ["O", "S8", "U2", "V3", "c8", "f16", "M8[s]", "no", None, 7, ["f4"], "f4,f4", "bool"])
def test_voxels_are_real_numbers(said: Any) -> None:
    with pytest.raises((ValueError, TypeError)):
        dtype_of(said)


def test_voxels_are_within_the_file() -> None:
    require_held((2, 3, 4), np.dtype("u2"), 100, 148)
    for begin, stored in ((100, 147), (101, 148), (-1, 1000), (2**62, 148)):
        with pytest.raises(ValueError, match="bytes"):
            require_held((2, 3, 4), np.dtype("u2"), begin, stored)


def _read_all(path: Path) -> None:
    with opened_volume(path) as record:
        np.asarray(record.volume.data[:])
        for scale in getattr(record.volume.data, "coarser", ()):
            scale.box((0, 0, 0), scale.shape)


def _refused(path: Path) -> None:
    """Each way to read it ends with a sentence."""
    for work in (_read_all, describe, read_volume):
        try:
            work(path)
        except DataError:
            continue
        assert work is not _read_all, "read"


def _place(said: Any, where: str) -> tuple[Any, Any]:
    *way, last = [int(key) if key.isdecimal() else key for key in where.split("/")]
    for key in way:
        said = said[key]
    return said, last


@pytest.mark.parametrize(
    "where", ["shape", "chunk_grid/configuration/chunk_shape", "data_type", "codecs", "codecs/0",
              "chunk_grid/configuration/chunk_shape/1", "codecs/0/name", "chunk_grid"],
)  # fmt: skip
def test_ome_zarr(tmp_path: Path, where: str) -> None:
    write_volume(tmp_path / "v.ome.zarr", RECORD)
    head = tmp_path / "v.ome.zarr/0/zarr.json"
    good = head.read_text()
    for n in NUMBERS:
        said = json.loads(good)
        group, key = _place(said, where)
        group[key] = n
        head.write_text(json.dumps(said))
        _refused(tmp_path / "v.ome.zarr")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *((rb"sizes: \d+", b"sizes: %s" % n) for n in (b"0", b"-1", b"1.5", b"a", b"", b"4294967296", b"9" * 5000)),
        (rb"type: \w+", b"type: block"), (rb"splatline:=.*", b""), (rb"splatline:=", b"splatline :="),
        (rb"splatline:=", b"splatline:=x"), (rb"splatline:=", b"splatline:=[]\nsplatline:="),
        (rb"(splatline:=).*", b"splatline:={splatline volume}"), (rb"sizes.*\n", b""), (rb"\n\n", b"\n"),
        (rb"splatline:=.*", b'splatline:={"format": "splatline volume"}'), (rb"\x00", b""),
    ],
)  # fmt: skip
def test_nrrd(tmp_path: Path, old: bytes, new: bytes) -> None:
    write_volume(tmp_path / "v.nrrd", RECORD)
    content = re.sub(old, lambda match: new, (tmp_path / "v.nrrd").read_bytes(), count=1)
    (tmp_path / "v.nrrd").write_bytes(content)
    _refused(tmp_path / "v.nrrd")


@pytest.mark.parametrize(
    "shape", ["(-1, 2, 2)", "(0, 2, 2)", "(2**40, 2, 2)", "(1.5, 2, 2)", f"({2**62}, 4, 4)", f"({'9' * 5000},)"]
)
def test_npy(tmp_path: Path, shape: str) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(64)
    (tmp_path / "v.npy").write_bytes(content if len(header) < 2**16 else b"")
    _refused(tmp_path / "v.npy")
