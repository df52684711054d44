"""Files of scanner makers next to images: offered if they fit, used if named, never guessed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.side_files import read_side_file
from tests.messages import refused

N, SHAPE = 6, (4, 8)
NIKON = f"""[XTekCT]
Name=s
Projections={N}
DetectorPixelSizeX=0.2
SrcToObject=60
SrcToDetector=300
WhiteLevel=60000
AngularStep=60
InitialAngle=10
"""
SKYSCAN = f"""[System]
Scanner=SkyScan1172
Camera Pixel Size (um)=      11.32
[Acquisition]
Number of Files=  {N}
Object to Source (mm)=60.000
Camera to Source (mm)=300.000
Image Pixel Size (um)=40.00
Rotation Step (deg)=60.000
Filter=Al 0.5 mm, 20 °C
"""
PHOENIX = f"""[Geometry]
FDD=300
FOD=60
VoxelSizeX=0.04
[CT]
NumberImages={N}
RotationSector=360.00000000
"""
PHOENIX_2 = f"""{{"Geometry": {{"FDD": 300.0, "FOD": 60.0, "VoxelSizeX": 0.04}},
"CT": {{"NumberImages": {N}, "RotationSector": 360.0}}}}"""
YXLON = f"""<?xml version="1.0"?>
<ScanParameter xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"><ConeBeamScanParameter>
<PixelSize><Width>0.2</Width><Height>0.2</Height></PixelSize>
<ScanTrajectory xsi:type="CircleTrajectory"><PixelPitch>0.2</PixelPitch><Fdd>1500</Fdd><Fod>300</Fod>
<NumberOfProjections>{N}</NumberOfProjections><StartAngle>10</StartAngle><Rotation>360</Rotation></ScanTrajectory>
</ConeBeamScanParameter></ScanParameter>"""
DIONDO = f"""<Scan><ScanParameter><HelixMode>false</HelixMode><Laminography>false</Laminography></ScanParameter>
<Geometrie><SourceDetectorDist>300</SourceDetectorDist><SourceObjectDist>60</SourceObjectDist></Geometrie>
<Recon><ProjectionPixelSizeX>0.2</ProjectionPixelSizeX><ProjectionCount>{N}</ProjectionCount></Recon></Scan>"""
TESCAN = f"""[General]
Project = "walnut"
[CT-parameters IN]
SOD = "60.000000"
SDD = "300.000000"
Pixel size = "0.200000"
Start angle = "10.000000"
Last angle = "310.000000"
# projections = "{N}"
"""
FILES = {
    "data settings XRE.txt": (TESCAN, 10.0),
    "s.xtekct": (NIKON, 10.0),
    "s.log": (SKYSCAN, 0.0),
    "s.pca": (PHOENIX, 0.0),
    "s2.pca": (PHOENIX_2, 0.0),
    "ScanParameter.xml": (YXLON, 10.0),
    "diondo.xml": (DIONDO, 0.0),
}


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "s"
    folder.mkdir()
    for i in range(N):
        tifffile.imwrite(folder / f"s_{i:04d}.tif", np.full(SHAPE, 50_000 + i, np.uint16))
    return folder


_OF_A_SCRIPT = """[2026-05-03 10:12:01] scan begins
exposure 0.1 s
Traceback (most recent call last):
  File "scan.py", line 212, in take
TimeoutError: no frame
"""
TEXTS = {
    "s.log": _OF_A_SCRIPT.encode(),
    "settings.log": b"[Scan]\nSample\n  name: cell\n  mounted by: AB\n",
    "s.xtekct": b"\xff\xfe[\x00X\x00",
    "x.pca": b"[\x00\x01]\n\x02\n  \x03\n",
    "y.pca": b'{"a": [1, {"b": 2}], "geometry": 3}',
    "deep.pca": b'{"a":' * 3000 + b"1" + b"}" * 3000,
    "deep.xml": b"<a>" * 3000 + b"</a>" * 3000,
    "empty.log": b"",
    "endless.pca": PHOENIX.replace(f"={N}", "=1e999").encode(),
    "many.pca": PHOENIX.replace(f"={N}", "=9e11").encode(),
}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("above", [False, True])
def test_any_text_beside_images_stops_no_scan(images: Path, name: str, above: bool) -> None:
    (images.parent / name if above else images / name).write_bytes(TEXTS[name])
    with open_scan(images) as source:
        assert len(source.table) == N
        assert source.not_used == ()


@pytest.mark.parametrize("name", TEXTS)
def test_any_text_that_is_named_is_refused_in_a_sentence(images: Path, name: str) -> None:
    (images / name).write_bytes(TEXTS[name])
    with pytest.raises(DataError, match=r"cannot be read as|is not a supported settings file|states no"):
        read_side_file(images / name)


@pytest.mark.parametrize("name", ["s.log", "s.xtekct", "s.pca"])
def test_decimal_commas_are_read(images: Path, name: str) -> None:
    text = FILES[name][0].replace("=60\n", "=60.5\n").replace("60.000", "60.500").replace("=0.04", "=0.0417")
    (images / name).write_text(text)
    expected = read_side_file(images / name)
    (images / name).write_text(text.replace(".", ","))
    side = read_side_file(images / name)
    assert (side.cone, side.pixel_mm, side.white) == (expected.cone, expected.pixel_mm, expected.white)
    assert side.cone[0] == 60.5
    np.testing.assert_array_equal(side.angles, expected.angles)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("60.000", "60,000", "60,000 has a comma next to 300.000 with a point"),
        ("=60.000", "=1,165.25", "1,165.25 has a comma"),
        (".000", ",000", "60,000 has a comma next to 40.00 with a point"),
    ],
)
def test_commas_that_may_be_of_thousands_are_refused(images: Path, old: str, new: str, why: str) -> None:
    (images / "s.log").write_text(SKYSCAN.replace(old, new))
    with pytest.raises(DataError, match=why):
        read_side_file(images / "s.log")
    (images / "s.log").write_text(SKYSCAN.replace(".000", ",000").replace("40.00", "40"))
    with refused(DataError):
        read_side_file(images / "s.log")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_distances_pixels_and_angles_are_taken(images: Path, name: str, encoding: str) -> None:
    text, first = FILES[name]
    side = images / name
    side.write_text(text, encoding=encoding)
    with open_scan(images) as source:  # not named: nothing of it is used
        assert (source.cone, source.pixel_size_mm) == (None, None)
        assert np.isnan(source.table.angles).all()
        assert [field.where for field in source.not_used] == [name]
    named = f'"{side}"' if " " in name else side
    assert [f.message for f in validate(images) if f"--scanner-file {named}" in f.message]
    with open_scan(SourceOptions(images, side_file=side, quantity="counts")) as source:
        assert source.cone == pytest.approx((60, 300))
        assert source.pixel_size_mm == pytest.approx(0.2)
        np.testing.assert_allclose(np.degrees(source.table.angles[-N:]), first + 60 * np.arange(N))
        assert source.not_used == ()
        white = [FILES[name][0] == NIKON and each for each in source.read(slice(None))[:, 0, 0].tolist()]
        assert white[:2] == ([0, 60_000] if FILES[name][0] == NIKON else [False, False])


def test_nikons_list_of_angles_goes_before_its_step(images: Path) -> None:
    (images / "s.xtekct").write_text(NIKON)
    rows = "".join(f"{i + 1}\t{i * 59.5:.4f}\t{i}\n" for i in range(N))
    (images / "_ctdata.txt").write_text(f"CT data\nParameters\n{N}\t0\nProj\tAngle(deg)\tTime(s)\n{rows}")
    side = read_side_file(images / "s.xtekct")
    assert side.angles is not None
    np.testing.assert_allclose(np.degrees(side.angles), 59.5 * np.arange(N))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.xtekct", NIKON.replace("SrcToDetector", "Other"), "states no xtekct/srctodetector"),
        ("s.xtekct", NIKON.replace("=60\nSrc", "=-60\nSrc"), "states no xtekct/srctoobject"),
        ("s.xtekct", "no section\n", "cannot be read as a settings file of a CT scanner"),
        ("s.xtekct", NIKON.replace(f"Projections={N}", "Projections=7"), "7 projections, but .* has 6"),
        ("diondo.xml", DIONDO.replace("HelixMode>false", "HelixMode>true"), "helixmode"),
        ("s.xml", "<a><b></a>", "cannot be read as a settings file of a CT scanner"),
        ("s.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "defines XML entities"),
        ("s.log", "[System]\nuser=root\n", "file of a CT scanner"),
    ],
)
def test_a_file_that_does_not_say_enough_is_refused_and_not_offered(
    images: Path, name: str, text: str, message: str
) -> None:
    (images / name).write_text(text)
    with pytest.raises(DataError, match=message):
        open_scan(SourceOptions(images, side_file=images / name))
    with open_scan(images) as source:
        assert source.not_used == ()
