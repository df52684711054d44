"""The sample's name does not make an image a dark or flat; angles in names are read; hidden files are ignored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.images.image_names import _half_a_turn_on, kinds_of
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.frame import FrameKind
from tests.messages import refused

SHAPE, VIEWS = (4, 6), 12
DARK, FLAT, VIEW = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION
SAMPLES = (
    "white_flower", "dark_chocolate", "flatworm", "flat_screen", "inflated", "white", "dark", "flat", "whiteboard",
    "ob", "open_beam", "df_01_b", "sample",
)  # fmt: skip
REFERENCES = (
    {"dark_{}": DARK, "flat_{}": FLAT}, {"df/{}": DARK, "ob/{}": FLAT}, {"DF_{}": DARK, "OB_{}": FLAT},
    {"Scan3_Dark_{}": DARK, "Scan3-white-{}": FLAT}, {"darkroom/x_dark_{}": DARK, "darkroom/x_flat_{}": FLAT},
)  # fmt: skip


@given(
    sample=st.sampled_from(SAMPLES), references=st.sampled_from(REFERENCES), folder=st.sampled_from(["", "run_white/"]),
    apart=st.booleans(), n=st.integers(1, 5),
)  # fmt: skip
def test_any_sample_is_told_from_its_references(
    sample: str, references: dict[str, FrameKind], folder: str, apart: bool, n: int
) -> None:
    views = f"{sample}/{sample}_{{}}" if apart else f"{sample}_{{}}"
    if views.lower() in {name.lower() for name in references}:
        return  # the same names: one series
    expected = {f"{folder}{views.format(f'{i:04d}')}.tif": VIEW for i in range(VIEWS)}
    for name, kind in references.items():
        expected |= {f"{folder}{name.format(f'{i:03d}')}.tif": kind for i in range(n)}
    assert kinds_of("scan", sorted(expected)) == dict(sorted(expected.items()))


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_series_alone_is_the_scan_that_was_given(sample: str) -> None:
    names = [f"{sample}_{i:03d}.tif" for i in range(VIEWS)]
    assert set(kinds_of("scan", names).values()) == {VIEW}


def test_references_alone_are_no_scan() -> None:
    names = [f"{name}_{i}.tif" for name in ("flat_before", "flat_after", "dark") for i in range(3)]
    with refused(DataError):
        kinds_of("scan", names)


def _written(folder: Path, names: list[str]) -> None:
    for i, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / name, np.full(SHAPE, i, np.uint16))


@pytest.mark.parametrize(
    "pattern",
    [
        "20191030_sample_{whole:03d}_{thousandths:03d}_{i:04d}.tiff",  # ORNL
        "sample_{i:04d}_angle_{degrees:.3f}.tif",
        "sample_{i:04d}_{degrees:.3f}deg.tif",
        "theta={degrees:.3f}_{i}.tif",
    ],
)
def test_angles_in_names_go_with_their_frames_in_the_order_of_numbers(tmp_path: Path, pattern: str) -> None:
    degrees = np.round((np.arange(VIEWS) * 111.246) % 180, 3)  # golden: the order of angles is another
    facts = [{"whole": int(a), "thousandths": round(a % 1 * 1000), "degrees": a, "i": i} for i, a in enumerate(degrees)]
    _written(tmp_path, [pattern.format(**fact) for fact in facts])
    with open_scan(tmp_path) as source:
        np.testing.assert_allclose(np.degrees(source.table.angles), degrees, atol=1e-9)
        assert source.read(range(VIEWS))[:, 0, 0].tolist() == list(range(VIEWS))
        assert source.attributes["angles_from"] == "the names of the files"
    with open_scan(SourceOptions(tmp_path, angles=np.radians(degrees[::-1]))) as source:  # those given go first
        np.testing.assert_allclose(np.degrees(source.table.angles), degrees[::-1])


@pytest.mark.parametrize(
    "pattern",
    [
        "s_{i:06d}_img.tif", "scan_{i:04d}.ome.tif", "{i:04d}_scan.tif", "scan_{i:04d}_20keV.tif",
        "scan_{i:04d}(1).tif", "scan ({i}).tif", "scan_{i}_20240101_1200{i:02d}.tif", "run2_{i:04d}_{date}.tif",
        "sub3/{i}_bin2.tif",
    ],
)  # fmt: skip
def test_the_number_of_an_image_stands_anywhere_in_its_name(tmp_path: Path, pattern: str) -> None:
    names = [pattern.format(i=i, date=20240101 + i // 5) for i in range(8, 8 + VIEWS) if i != 12]
    _written(tmp_path, names)
    with open_scan(tmp_path) as source:
        assert source.read(range(VIEWS - 1))[:, 0, 0].tolist() == list(range(VIEWS - 1))
        assert source.attributes["missing_numbers"] == "12"
        assert source.ending.missing == (4,)


@pytest.mark.parametrize("pattern", ["tile{tile}_{i:04d}.tif", "{i:04d}_{tile}keV.tif", "tile{tile}_{of_tile:04d}.tif"])
def test_two_numbers_that_do_not_go_along_are_several_series(tmp_path: Path, pattern: str) -> None:
    _written(tmp_path, [pattern.format(tile=i // 6, i=i, of_tile=i % 6) for i in range(VIEWS)])
    with refused(DataError):
        open_scan(tmp_path)


def test_hidden_files_beside_images_are_no_images(tmp_path: Path) -> None:
    names = [f"a_{i}.tif" for i in range(3)] + [f"dark_{i}.tif" for i in range(2)]
    _written(tmp_path, names)
    for name in names:
        (tmp_path / f"._{name}").write_bytes(b"\0\5\26\7" + bytes(100))
    (tmp_path / "._angles.txt").write_bytes(b"\0\5\26\7")
    (tmp_path / "angles.txt").write_text("0\n1\n2\n")
    with open_scan(tmp_path) as source:
        assert source.table.kinds.tolist() == [2, 2, 0, 0, 0]
        np.testing.assert_allclose(np.degrees(source.table.angles[2:]), [0, 1, 2])
    assert len(load_images(tmp_path, DARK)) == 5


@pytest.mark.parametrize(
    ("before", "after", "beside"),
    [
        ("Flat_Before", "Flat_After", "180deg"), ("flats_before", "Flats_after", "Proj_180deg"),
        ("OB_pre", "OB_post", "180_deg_after"), ("FlatBefore", "FlatAfter", "tomo_180deg"),
    ],
)  # fmt: skip
def test_references_named_after_the_views_come_after_them(tmp_path: Path, before: str, after: str, beside: str) -> None:
    """As folders of IMAT are called, with numbers of their own; a view at 180 degrees apart is no frame of the scan."""
    for number, (folder, n) in enumerate({"Tomo": 12, before: 2, after: 2, "Dark_Before": 3, beside: 1}.items()):
        (tmp_path / folder).mkdir()
        for i in range(n):
            image = np.full(SHAPE, number, np.uint16)
            tifffile.imwrite(tmp_path / folder / f"IMAT0002673{number}_bone_{folder}_{i:04d}.tif", image)
    with open_scan(tmp_path) as source:
        assert source.table.kinds.tolist() == [2] * 3 + [1] * 2 + [0] * 12 + [1] * 2 + [3]
        assert source.read(slice(None))[:, 0, 0].tolist() == [3] * 3 + [1] * 2 + [0] * 12 + [2] * 2 + [4]
        assert [field.value for field in source.not_used] == ["1 image"] and source.ending.missing == ()


def test_a_scan_with_a_folder_for_each_angle_is_whole() -> None:
    names = [f"{angle}deg/image.tif" for angle in range(0, 361, 20)]
    assert _half_a_turn_on(names) == [] == _half_a_turn_on([f"run_180deg/{i}.tif" for i in range(9)])


def test_images_that_are_not_read_are_named_with_a_way(tmp_path: Path) -> None:
    for suffix, picture in (("jpg", np.zeros(SHAPE, np.uint8)), ("png", np.zeros((*SHAPE, 3), np.uint8))):
        (tmp_path / suffix).mkdir()
        Image.fromarray(picture).save(tmp_path / suffix / f"p_1.{suffix}")
    np.savez(tmp_path / "s.npz", a=picture, settings=np.array({"mode": "cone"}, object))
    (tmp_path / "s.pickle").write_bytes(b"cos\nsystem\n(S'exit 1'\ntR.")
    for name, message in {
        "jpg": r"pictures such as p_1.jpg .* 8 bits.*PNG.*PIL.*\*\.jpg",
        "png": "the image has 6 x 4 pixels of kind RGB; expected grey pixels",
        "s.npz": "numpy.savez.*Python objects among its arrays.*pickles",
        "s.pickle": "is a pickle, which this program never opens.*np.save",
    }.items():
        with pytest.raises(DataError, match=message):
            open_scan(tmp_path / name)


def test_references_in_folders_beside_the_views_are_taken_for_counts(tmp_path: Path) -> None:
    for name in ("Tomo", "Flat_Before", "Dark_After"):
        _written(tmp_path / name, [f"IMAT_{name}_{i}.tif" for i in range(4)])
    views, angles = tmp_path / "Tomo", np.arange(4.0)
    for scan, kinds in (
        (SourceOptions(views, "counts", angles), [1] * 4 + [0] * 4 + [2] * 4),
        (SourceOptions(views, "counts", angles, flats=views), [1] * 4 + [0] * 4),
        (SourceOptions(views, "line_integrals", angles), [0] * 4),
    ):
        with open_scan(scan) as source:
            assert source.table.kinds.tolist() == kinds
    said = _of_references(SourceOptions(views, "counts", angles))
    assert said == "The darks and flats next to the projections are used: Dark_After, Flat_Before."
    _written(tmp_path / "Tomo_2", [f"IMAT_other_{i}.tif" for i in range(4)])  # whose flats are they?
    assert "flats are missing. Give --flats with a file" in _of_references(SourceOptions(views, "counts", angles))


def test_a_defect_while_looking_beside_the_views_is_no_scan_without_references(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("Tomo", "Flat_Before"):
        _written(tmp_path / name, [f"IMAT_{name}_{i}.tif" for i in range(4)])

    def fails(names: object) -> str:
        raise MemoryError

    monkeypatch.setattr("beamline.storage.readers.images.tiff_series.sorted", fails, raising=False)
    with pytest.raises(MemoryError):
        open_scan(SourceOptions(tmp_path / "Tomo", "counts", np.arange(4.0))).close()


def _of_references(scan: SourceOptions) -> str:
    return " ".join(each.message for each in validate(scan) if each.rule == "references")


def test_other_images_beside_tiffs_are_no_frames(tmp_path: Path) -> None:
    _written(tmp_path, [f"p_{i}.tif" for i in range(4)])
    np.save(tmp_path / "theta.npy", np.arange(4.0))
    Image.fromarray(np.zeros(SHAPE, np.uint8)).save(tmp_path / "preview.png")
    with open_scan(tmp_path) as source:
        assert source.table.kinds.tolist() == [0] * 4


_XRE = ["di000000.tif", "io000000.tif", "io000001.tif", *(f"scan_{i:06d}.tif" for i in range(VIEWS))]


def test_series_that_each_count_anew_stay_apart_and_say_their_places(tmp_path: Path) -> None:
    """As of TESCAN and FleXray (io, di), and of names that are not known, whose kinds the caller says."""
    for names, scan in ((_XRE, "xre"), ([name.replace("io", "bl").replace("di", "a") for name in _XRE], "others")):
        _written(tmp_path / scan, names)
        with open_scan(SourceOptions(tmp_path / scan, frames="darks=0:1,flats=1:3")) as source:
            assert source.table.kinds.tolist() == [DARK, FLAT, FLAT, *[VIEW] * VIEWS]
            assert source.read(slice(None))[:, 0, 0].tolist() == list(range(VIEWS + 3))
            assert f"scan_#.tif 3:{VIEWS + 3}" in str(source.attributes["places"])
    with open_scan(tmp_path / "xre") as source:
        assert source.table.kinds.tolist() == [DARK, FLAT, FLAT, *[VIEW] * VIEWS]
    with pytest.raises(
        DataError, match=rf"several series.*none=10:12.*a#\.tif 0:1, bl#\.tif 1:3, scan_#\.tif 3:{VIEWS + 3}"
    ):
        open_scan(tmp_path / "others")


@pytest.mark.parametrize("pattern", ["p_{a:.1f}.tif", "p_{a:07.3f}.tif", "{a:.1f}_{i:04d}.tif"])
def test_decimals_in_names_tell_the_order(tmp_path: Path, pattern: str) -> None:
    _written(tmp_path, [pattern.format(a=1.5 * i, i=i) for i in range(VIEWS)])
    angles = np.arange(VIEWS) * 15.0
    np.savetxt(tmp_path / "angles.txt", angles)
    with open_scan(tmp_path) as source:
        assert source.read(range(VIEWS))[:, 0, 0].tolist() == list(range(VIEWS))
        np.testing.assert_allclose(np.degrees(source.table.angles), angles)


@pytest.mark.parametrize("suffix", ["tif", "npy"])
def test_a_folder_of_stacks_is_one_scan(tmp_path: Path, suffix: str) -> None:
    stacks = {"tomo": (VIEWS, 7), "flat": (6, 90), "dark": (5, 1)}
    for name, (n, counts) in stacks.items():
        frames = np.arange(n)[:, None, None] + np.full(SHAPE, counts, np.uint16)
        write = {"tif": tifffile.imwrite, "npy": np.save}[suffix]
        write(tmp_path / f"{name}.{suffix}", frames.astype(np.uint16))
    np.save(tmp_path / "theta.npy", np.arange(VIEWS) * 15.0)
    with open_scan(SourceOptions(tmp_path, quantity="counts")) as source:
        assert source.table.kinds.tolist() == [DARK] * 5 + [FLAT] * 6 + [VIEW] * VIEWS
        assert source.read([4, 5, 11, -1])[:, 0, 0].tolist() == [5, 90, 7, 7 + VIEWS - 1]
        np.testing.assert_allclose(np.degrees(source.table.angles[source.table.views]), np.arange(VIEWS) * 15.0)
