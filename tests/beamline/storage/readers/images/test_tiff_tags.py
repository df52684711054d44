"""TIFF tags: orientation, reduced-resolution copies, sets of OME files and their axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.frame import FrameKind
from tests.messages import refused

SHAPE, N = (6, 8), 4
STORED = {  # the image as a file with this tag 274 holds it, by TIFF 6.0
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.T,
    6: lambda image: np.rot90(image),
    7: lambda image: image.T[::-1, ::-1],
    8: lambda image: np.rot90(image, -1),
}


@pytest.fixture
def stack(rng: np.random.Generator) -> NDArray[np.uint16]:
    return rng.integers(0, 60_000, (N, *SHAPE)).astype(np.uint16)


def _write(path: Path, images: NDArray[np.uint16], **how: object) -> None:
    tifffile.imwrite(path, images, photometric="minisblack", **how)


@pytest.mark.parametrize("tag", STORED)
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_images_are_turned_upright(
    tmp_path: Path, stack: NDArray[np.uint16], tag: int, compression: str | None
) -> None:
    stored = np.stack([np.ascontiguousarray(STORED[tag](image)) for image in stack])
    how = {"metadata": None, "extratags": [(274, 3, 1, tag, True)], "compression": compression}
    _write(tmp_path / "stack.tif", stored, **how)
    (tmp_path / "s").mkdir()
    for i, image in enumerate(stored):
        _write(tmp_path / f"s/s_{i}.tif", image, **how)
    for place in ("stack.tif", "s"):
        with open_scan(tmp_path / place) as source:
            assert source.shape == SHAPE
            np.testing.assert_array_equal(source.read(slice(None)), stack)
            np.testing.assert_array_equal(source.read([2, 1], slice(1, 5)), stack[[2, 1], 1:5])
            np.testing.assert_array_equal(source.read([2], slice(0, 6, 2)), stack[[2], 0:6:2])
        np.testing.assert_array_equal(load_images(tmp_path / place, FrameKind.FLAT), stack)


@pytest.mark.parametrize("axes", ["TYX", "ZYX", "CYX"])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_an_ome_stack_along_any_axis(
    tmp_path: Path, stack: NDArray[np.uint16], axes: str, compression: str | None
) -> None:
    _write(tmp_path / "s.ome.tif", stack, ome=True, metadata={"axes": axes}, compression=compression)
    with open_scan(tmp_path / "s.ome.tif") as source:
        np.testing.assert_array_equal(source.read(slice(None)), stack)
        assert source.not_used == ()


def test_an_ome_stack_of_two_axes_is_refused_by_name(tmp_path: Path, stack: NDArray[np.uint16]) -> None:
    _write(tmp_path / "c.ome.tif", np.stack([stack, stack], 1), ome=True, metadata={"axes": "TCYX"})
    with refused(DataError):
        open_scan(tmp_path / "c.ome.tif")
    tifffile.imwrite(tmp_path / "ij.tif", np.stack([stack, stack], 1), imagej=True, metadata={"axes": "TCYX"})
    with refused(DataError):
        open_scan(tmp_path / "ij.tif")


def _set_of(names: list[str], pages: int, own: int) -> str:
    """OME metadata of a set of files, each of which lists the pages of all."""
    data = "".join(
        f'<TiffData FirstT="{pages * i + page}" IFD="{page}" PlaneCount="1"><UUID FileName="{name}">urn:uuid:'
        f"00000000-0000-0000-0000-{i:012d}</UUID></TiffData>"
        for i, name in enumerate(names)
        for page in range(pages)
    )
    return (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:'
        f'00000000-0000-0000-0000-{own:012d}"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" '
        f'Type="uint16" SizeX="{SHAPE[1]}" SizeY="{SHAPE[0]}" SizeZ="1" SizeC="1" SizeT="{pages * len(names)}">'
        f"{data}</Pixels></Image></OME>"
    )


@pytest.mark.parametrize("pages", [1, 2])
def test_a_file_of_an_ome_set_has_its_own_pages_alone(tmp_path: Path, stack: NDArray[np.uint16], pages: int) -> None:
    names = [f"s_{i}.ome.tif" for i in range(N // pages)]
    for i, name in enumerate(names):
        part = stack[pages * i : pages * (i + 1)]
        _write(tmp_path / name, part, metadata=None, description=_set_of(names, pages, i))
    for i, name in enumerate(names):
        with open_scan(tmp_path / name) as source:
            np.testing.assert_array_equal(source.read(slice(None)), stack[pages * i : pages * (i + 1)])
            (field,) = source.not_used
            assert (field.where, field.value) == ("images of an OME set in other files", str(N - pages))
    with open_scan(tmp_path) as source:
        np.testing.assert_array_equal(source.read(slice(None)), stack)
        assert source.not_used == () or pages > 1
    if pages > 1:
        with pytest.raises(DataError, match=rf"other files contain {N - pages} images: add the other files with"):
            open_scan(SourceOptions(tmp_path / names[0], angles=np.arange(N + 1.0)))


def _pyramid(path: Path, stack: NDArray[np.uint16], kind: str) -> None:
    with tifffile.TiffWriter(path, ome=kind == "ome") as file:
        if kind in ("ome", "end"):
            file.write(
                stack, subifds=int(kind == "ome"), photometric="minisblack", metadata=None if kind == "end" else {}
            )
            file.write(stack[:, ::2, ::2], subfiletype=1, photometric="minisblack", metadata=None)
        for image in stack if kind in ("sub", "beside", "first") else ():
            reduced = {"data": image[::2, ::2], "subfiletype": 1, "photometric": "minisblack", "metadata": None}
            if kind == "first":
                file.write(**reduced)
            file.write(image, subifds=int(kind == "sub"), photometric="minisblack", contiguous=False, metadata=None)
            if kind != "first":
                file.write(**reduced)


@pytest.mark.parametrize("kind", ["sub", "beside", "end", "ome", "first"])
def test_pyramids_are_read_in_full_resolution(tmp_path: Path, stack: NDArray[np.uint16], kind: str) -> None:
    _pyramid(tmp_path / "p.tif", stack, kind)
    (tmp_path / "s").mkdir()
    for i in range(N):
        _pyramid(tmp_path / f"s/s_{i}.tif", stack[i : i + 1], kind)
    for place in ("p.tif", "s"):
        with open_scan(tmp_path / place) as source:
            np.testing.assert_array_equal(source.read(slice(None)), stack)
            assert [field.where for field in source.not_used] == ["pages of other resolutions or masks"]


def test_a_colour_image_is_no_stack(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", np.zeros((5, 4, 3), np.uint8), photometric="rgb")
    with refused(DataError):
        open_scan(tmp_path / "s.tif")
