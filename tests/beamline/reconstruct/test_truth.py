"""Ground truth: reading it, matching it to a volume, and measuring volume files with it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import ConfigError, DataError
from beamline.reconstruct.truth import fit_truth, measured_file, read_truth
from recon.assess.metrics import ssim_of_whole_slices
from recon.base.volume import Grid
from tests.messages import refused

DATA = np.arange(4 * 6 * 8, dtype=np.float32).reshape(4, 6, 8)


@pytest.mark.parametrize("name", ["truth.npz", "truth.npy", "recon.h5", "plain.h5"])
@pytest.mark.parametrize(("slices", "expected"), [("", slice(0, 4)), (":1:3", slice(1, 3)), (":2:", slice(2, 4))])
def test_truths_in_every_form(tmp_path: Path, name: str, slices: str, expected: slice) -> None:
    path = tmp_path / name
    if path.suffix == ".npz":
        np.savez(path, volume=DATA.astype(np.float16), voxel_mm=np.float32(0.1))
    elif path.suffix == ".npy":
        np.save(path, DATA)
    else:
        with h5py.File(path, "w") as file:
            file["entry/data/data" if name == "recon.h5" else "volume"] = DATA
    read = read_truth(f"{path}{slices}")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, DATA[expected])


def test_truths_that_are_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", a=DATA, b=DATA)
    np.savez(tmp_path / "flat.npz", a=DATA[0])
    (tmp_path / "text.npz").write_text("no archive")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["something"] = DATA
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name in ("two.npz", "flat.npz", "text.npz", "other.h5", "objects.npy"):
        with pytest.raises(DataError, match="readable volume"):
            read_truth(str(tmp_path / name))
    with refused(DataError):
        read_truth(str(tmp_path / "text.npz"))
    np.save(tmp_path / "good.npy", DATA)
    with refused(ConfigError):
        read_truth(f"{tmp_path / 'good.npy'}:2:9")
    with refused(ConfigError):
        read_truth(str(tmp_path / "missing.npy"))


def test_a_finer_truth_is_averaged_onto_the_grid() -> None:
    grid = Grid((2, 3, 4), 1.0)
    fitted = fit_truth(DATA, grid, 2)
    assert fitted.grid is grid
    for z, y, x in np.ndindex(2, 3, 4):
        block = DATA[2 * z : 2 * z + 2, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        assert fitted.data[z, y, x] == pytest.approx(block.mean())
    np.testing.assert_array_equal(fit_truth(DATA, Grid(DATA.shape), 1).data, DATA)
    with refused(ConfigError):
        fit_truth(DATA, Grid((4, 6, 9)), 1)


def test_a_constant_truth_is_refused() -> None:
    for value in (1.0, np.nan):
        with refused(ConfigError):
            fit_truth(np.full((4, 8, 8), value, np.float32), Grid((4, 8, 8)), 1)


def test_a_volume_file_is_measured_by_masks_that_somebody_drew(tmp_path: Path, rng: np.random.Generator) -> None:
    volume = rng.normal(0, 0.1, (4, 6, 8)).astype(np.float32)
    labels = np.zeros(volume.shape, np.uint8)
    labels[:, :2], labels[:, 4:] = 1, 2
    volume[labels == 1] += 1
    np.save(tmp_path / "v.npy", volume)
    tifffile.imwrite(tmp_path / "m.tif", labels, photometric="minisblack")
    found = measured_file(tmp_path / "v.npy", None, tmp_path / "m.tif")
    dense, empty = volume[labels == 1].astype(float), volume[labels == 2].astype(float)
    assert found == {
        "snr": pytest.approx(20 * np.log10(dense.mean() / empty.std()), abs=1e-4),
        "cnr": pytest.approx(20 * np.log10((dense.mean() - empty.mean()) / empty.std()), abs=1e-4),
    }
    for wrong, said in {"3": labels + 2, "shape": labels[:3]}.items():
        tifffile.imwrite(tmp_path / f"{wrong}.tif", said, photometric="minisblack")
        with refused(DataError):
            measured_file(tmp_path / "v.npy", None, tmp_path / f"{wrong}.tif")


def test_a_volume_file_is_measured_against_a_truth(tmp_path: Path, rng: np.random.Generator) -> None:
    truth = rng.random((14, 16, 18), np.float32)
    np.save(tmp_path / "t.npy", truth)
    np.save(tmp_path / "v.npy", truth / 2)
    found = measured_file(tmp_path / "v.npy", str(tmp_path / "t.npy"), None)
    assert set(found) == {"psnr", "nrmse", "ssim3d", "ssim_slices"}
    assert found["ssim_slices"] == pytest.approx(ssim_of_whole_slices(truth, truth / 2))
    with refused(DataError):
        measured_file(tmp_path / "v.npy", f"{tmp_path / 't.npy'}:0:7", None)
