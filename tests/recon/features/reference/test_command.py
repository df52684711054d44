"""`beamline recon --reference`: a state with the volume, or with the scan, of the sample before it changed."""

from __future__ import annotations

import re
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from scipy import ndimage as ndi

import recon
from beamline.cli.recon import recon as command
from beamline.config.load import config_folder
from beamline.core.errors import ScanStopped
from beamline.core.events import Sink
from beamline.page.tiles import TileRegion
from beamline.page.volume import moved_reference
from beamline.projections.selection import Selection
from beamline.reconstruct import live_reference
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.reference import with_reference
from beamline.report.live_picture import PictureRow, reference_row
from beamline.storage.readers.open import SourceOptions
from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import opened_volume, write_volume
from beamline.storage.writers.partial_volume import PartialVolume
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from recon.base.method import Preview
from recon.features.reference.methods import FromReference
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import BEAM, DARK, TwoCylinders, frames_of, write_flagged
from tests.recon.features.reference.scene import LEVEL, Discs, N, balls_near_one_end, packed, psnr, scanned

QUICK = "--axis", str((N - 1) / 2), "--quality", "preview"
AFTER = replace(packed(), turn=np.radians(0.8), shift=(1.5, -1.0), slit=4)


def written(path: Path, scene: Discs, views: int, seed: int) -> Path:
    """A scan of the scene, with flats and darks."""
    lines, geometry = scanned(scene, views, 1e4, seed)
    frames = frames_of(TwoCylinders(geometry.angles, geometry.detector_shape, axis_col=(N - 1) / 2))
    counts = np.round(DARK + BEAM * np.exp(-lines)).astype(np.uint16)
    return write_flagged(
        path, frames[:4] + [replace(frame, counts=image) for frame, image in zip(frames[4:], counts, strict=True)], {}
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scans good.h5 and state.h5, and the volume good_volume.h5."""
    folder = tmp_path_factory.mktemp("states")
    good, _ = written(folder / "good.h5", packed(), 60, 1), written(folder / "state.h5", AFTER, 24, 2)
    done = beamline(
        "recon", str(good), "-m", "fista-tv", *QUICK[:2], "--no-report", "-o", str(folder / "good_volume.h5")
    )
    assert done.exit_code == 0, done.output
    return folder


def test_the_result_says_that_the_reference_was_used_and_shows_the_change(folder: Path) -> None:
    out = folder / "out.h5"
    done = beamline("recon", str(folder / "state.h5"), "--reference", str(folder / "good_volume.h5"), *QUICK, "-o",
                    str(out))  # fmt: skip
    assert done.exit_code == 0, done.output
    assert f"{'chosen':<10}from-reference: The reference was used: root mean square residual" in done.output
    with opened_volume(out) as record, h5py.File(out) as file:
        data = file["entry/data"]
        assert record.method == "from-reference" and data["change"].shape == record.grid.shape
        assert data["change"].attrs["units"] == data["data"].attrs["units"]
        moved = record.volume.data[:] - data["change"][:]
        gap = replace(AFTER, slit=-1).volume - AFTER.volume
        missing = -(data["change"][:] / moved.max() * gap).sum() / (gap**2).sum() * gap.max()
        assert missing > 0.3, "the slit is in the change"
        shifts = [data[f"displacement_{axis}"] for axis in "zyx"]
        assert all(each.shape == record.grid.shape and each.attrs["units"] == record.length_unit for each in shifts)
    page = out.with_suffix(".html").read_text()
    assert "Change since the reference" in page and "divided by its standard error" in page
    median = float(re.findall(r"displaced by ([0-9.]+) voxels", page)[0])
    assert abs(median - np.hypot(*AFTER.shift)) < 0.5


def test_the_viewer_shows_the_moved_reference_above_the_state(folder: Path) -> None:
    with ExitStack() as opened:
        before = moved_reference(folder / "out.h5", opened)
        assert before is not None and before.facts()["name"] == "out.h5::moved reference"
        with h5py.File(folder / "out.h5") as file, closing(before):
            expected = file["entry/data/data"][1] - file["entry/data/change"][1]
            tile = before.cut(0, 1, TileRegion(0, N, 0, N))
            np.testing.assert_allclose(tile.values, expected)
        assert moved_reference(folder / "good_volume.h5", opened) is None


def test_a_scan_as_the_reference_is_reconstructed_once(folder: Path) -> None:
    scan, made = folder / "good.h5", folder / "good_reference.h5"
    for name in ("first.h5", "second.h5"):
        done = beamline("recon", str(folder / "state.h5"), "--reference", str(scan), *QUICK, "--no-report", "-o",
                        str(folder / name))  # fmt: skip
        assert done.exit_code == 0, done.output
        assert made.exists() and ("is reconstructed first" in done.output) == (name == "first.h5")
        assert "The reference was used" in done.output
    with opened_volume(folder / "first.h5") as one, opened_volume(folder / "second.h5") as other:
        np.testing.assert_array_equal(one.volume.data[:], other.volume.data[:])
    twin = written(folder / "other" / "good.h5", packed(), 24, 3) if (folder / "other").mkdir() is None else scan
    done = beamline("recon", str(folder / "state.h5"), "--reference", str(twin), *QUICK, "-o", str(folder / "x.h5"))
    assert done.exit_code != 0 and "was made from" in done.output and "Nothing was changed." in done.output
    assert not (folder / "x.h5").exists()


def test_the_picture_of_a_followed_scan_shows_the_moved_reference_and_the_slit(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = list[Preview]()

    def row(shown: Preview, n_views: int, unit: str) -> PictureRow:
        assert n_views == 24
        drawn.append(shown)
        return reference_row(shown, n_views, unit)

    monkeypatch.setattr(live_reference, "reference_row", row)
    out = tmp_path / "out.h5"
    words = "--reference", str(folder / "good_volume.h5"), *QUICK[:2], "--follow", "-o", str(out)
    done = beamline("recon", str(folder / "state.h5"), *words)
    assert done.exit_code == 0, done.output
    assert out.exists() and out.with_name("out.live.png").exists()
    (shown,) = drawn
    gap = (replace(AFTER, slit=-1).volume - AFTER.volume)[0]
    change = (shown.volume.data - shown.moved.data)[len(shown.moved.data) // 2]
    slit = -float((change * gap).sum() / np.square(gap).sum()) * LEVEL / np.percentile(shown.moved.data, 99)
    assert slit > 0.4, "the slit is in FBP of the rest"
    assert abs(change[gap == 0]).mean() < 0.1 * abs(change[gap > 0.5 * gap.max()]).mean()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--reference", "none.h5"), "none.h5 does not exist"),
        (("--reference", "good_volume.h5", "-m", "fbp"), "--reference works only with from-reference"),
        (("-m", "from-reference"), "--method from-reference needs --reference GOOD"),
        (("--reference", "good_volume.h5", "--uncertainty"), "error bars are not calibrated for it"),
    ],
)
def test_what_cannot_be_done_is_refused(options: tuple[str, ...], error: str, folder: Path) -> None:
    named = [str(folder / word) if word.endswith(".h5") else word for word in options]
    done = beamline("recon", str(folder / "state.h5"), *named, "-o", str(folder / "refused.h5"))
    assert done.exit_code != 0 and error in " ".join(done.output.split())
    assert not (folder / "refused.h5").exists()


@pytest.mark.parametrize("words", [("recon", "state.h5"), ("scan", str(config_folder() / "demo.yaml"))])
def test_a_missing_reference_is_named_with_its_option(words: tuple[str, str], folder: Path) -> None:
    done = beamline(words[0], str(folder / words[1]), "--reference", str(folder / "none.h5"))
    assert done.exit_code != 0 and "--reference" in done.output and "none.h5" in done.output
    assert "does not exist" in done.output and "--set" not in done.output


def test_a_reference_with_a_voxel_that_is_not_finite_is_refused(folder: Path) -> None:
    spoilt = folder / "spoilt.h5"
    spoilt.write_bytes((folder / "good_volume.h5").read_bytes())
    with h5py.File(spoilt, "r+") as file:
        file["entry/data/data"][1, 30, 30] = np.nan
    done = beamline("recon", str(folder / "state.h5"), "--reference", str(spoilt), *QUICK, "-o", str(folder / "y.h5"))
    assert done.exit_code != 0 and "1 of 16384 voxels of the reference are not finite" in done.output
    assert not (folder / "y.h5").exists()


def test_a_scan_is_not_reconstructed_in_vain_for_too_few_projections(folder: Path, tmp_path: Path) -> None:
    done = beamline("recon", str(folder / "state.h5"), "--reference", str(folder / "good.h5"), *QUICK, "--views",
                    "every:2", "--no-report", "-o", str(tmp_path / "few.h5"))  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "The reference was not used: whether it helps cannot be tested" in " ".join(done.output.split())
    assert not (tmp_path / "good_reference.h5").exists()


def test_an_output_with_the_name_of_the_volume_of_the_reference_is_refused_at_once(folder: Path) -> None:
    scan = written(folder / "careful.h5", packed(), 24, 3)
    out = folder / "careful_reference.h5"
    done = beamline("recon", str(folder / "state.h5"), "--reference", str(scan), *QUICK, "-o", str(out))
    assert done.exit_code != 0 and "would have the same name" in " ".join(done.output.split())
    assert not out.exists()


def test_a_reference_whose_reconstruction_was_stopped_is_not_kept(folder: Path, tmp_path: Path) -> None:
    made = tmp_path / "good_reference.h5"

    def stopped(options: ReconOptions, sink: Sink) -> Any:
        options.target.output.write_bytes(b"a volume so far")
        return SimpleNamespace(ended_early=True)

    options = ReconOptions(SourceOptions(folder / "state.h5"), OutputPaths(tmp_path / "out.h5", None), Selection(),
                           FromReference())  # fmt: skip
    with pytest.raises(ScanStopped, match=r"good.h5 was stopped, so its volume .* was removed"):
        with_reference(options, folder / "good.h5", stopped, lambda event: None, SystemClock())
    assert not made.exists()


@pytest.mark.slow
def test_slabs_with_a_reference_are_the_whole_volume(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Balls that moved along the axis by 0.1 to 0.9 voxels; each slab finds the reference at its height."""
    monkeypatch.setattr(FromReference, "halo", 6)  # 24 would need a larger scene
    truth = balls_near_one_end(rng)
    truth = np.maximum(truth, truth[::-1])
    geometry = recon.Geometry.parallel(np.pi * np.arange(24) / 24, (40, 48))
    grid = recon.Grid.matching(geometry)
    good, state = tmp_path / "good.h5", tmp_path / "state.h5"
    np.save(tmp_path / "volume.npy", truth)
    write_volume(good, bare_record(tmp_path / "volume.npy", truth, (1.0, 1.0, 1.0)))
    z = (np.arange(40) - 19.5) * 1.02 + 19.5 + 0.5
    after = ndi.map_coordinates(truth, np.meshgrid(z, np.arange(48), np.arange(48), indexing="ij"), order=1)
    lines = recon.Projector(geometry, grid).forward(after.astype(np.float32))
    lines = -np.log(np.maximum(rng.poisson(1e4 * np.exp(-lines)), 1) / 1e4).astype(np.float32)
    with h5py.File(state, "w") as file:
        file["exchange/data"], file["exchange/theta"] = lines, np.degrees(geometry.angles)
        file["exchange/data"].attrs["units"], file["exchange/theta"].attrs["units"] = "line_integrals", "deg"
        file.attrs["pixel_size_mm"] = 1.0
    for name, memory in (("whole.h5", "1G"), ("parts.h5", "16M")):
        done = beamline("recon", str(state), "--reference", str(good), "--axis", "23.5", "--quality", "preview",
                        "--memory", memory, "-o", str(tmp_path / name))  # fmt: skip
        assert done.exit_code == 0, done.output
        assert "The reference was used" in done.output
    whole, parts = (read_reconstruction(tmp_path / name) for name in ("whole.h5", "parts.h5"))
    assert int(str(parts.parameters["slabs"])) > 1
    changes, moved = [], []
    for name, record in (("whole.h5", whole), ("parts.h5", parts)):
        with h5py.File(tmp_path / name) as file:
            changes.append(file["entry/data/change"][()])
            assert ("displacement_z" in file["entry/data"]) is (name == "whole.h5")
            assert file["entry/data/change"].attrs["units"] == "1/mm"
        moved.append(record.volume.data - changes[-1])
        assert "Change since the reference" in (tmp_path / name).with_suffix(".html").read_text()
    np.testing.assert_allclose(moved[1], moved[0], atol=0.1 * float(truth.max()))
    assert psnr(moved[1], after) > psnr(truth, after) + 3, "the reference is moved in each slab"
    add, added = PartialVolume.add, list[int]()

    def stopped_within_the_second(self: PartialVolume, n: int, data: np.ndarray | None, **more: Any) -> None:
        add(self, n, data, **more)
        added.append(n)
        if len(added) == 2:
            self._maps["state"][n] = 1  # the slab counts as added in part
            raise KeyboardInterrupt

    arguments = ("recon", str(state), "--reference", str(good), "--axis", "23.5", "--quality", "preview", "--no-report",
                 "--memory", "16M", "-o", str(tmp_path / "again.h5"))  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(PartialVolume, "add", stopped_within_the_second)
        assert beamline(*arguments).exit_code == 4
    resumed = beamline(*arguments, "--resume", str(tmp_path / "again.partial.h5"))
    assert resumed.exit_code == 0, resumed.output
    with h5py.File(tmp_path / "again.h5") as file:
        np.testing.assert_array_equal(file["entry/data/data"][()], parts.volume.data)
        np.testing.assert_array_equal(file["entry/data/change"][()], changes[1])
    assert psnr(parts.volume.data, after) > psnr(whole.volume.data, after) - 0.1
    between = np.square(parts.volume.data - whole.volume.data).mean()
    assert between < 0.3 * np.square(whole.volume.data - after).mean(), "they differ by less than the error"


def test_the_disk_space_counts_the_change_and_the_displacement(tmp_path: Path) -> None:
    options = ReconOptions(SourceOptions(tmp_path / "state.h5"), OutputPaths(tmp_path / "out.h5", None), Selection(),
                           FromReference(), reference=tmp_path / "good.h5")  # fmt: skip
    assert options.disk_needs(100, in_slabs=False) == (500, 0)
    assert options.disk_needs(100, in_slabs=True) == (200, 200)
    tiff = replace(options, target=OutputPaths(tmp_path / "out.tif", None))  # holds only the volume
    assert tiff.disk_needs(100, in_slabs=False) == (100, 0) and tiff.disk_needs(100, in_slabs=True) == (100, 200)
    assert replace(options, reference=None).disk_needs(100, in_slabs=True) == (100, 100)


def test_help_states_the_option() -> None:
    assert "--reference" in {name for param in command.params for name in param.opts}
