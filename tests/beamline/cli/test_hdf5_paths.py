"""A scan in another HDF5 layout gives the same result as in ours, if its datasets are named."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.storage.readers.open import open_scan
from beamline.storage.writers.recon_file import read_reconstruction
from tests.beamline.cli.small_scan import SCAN, beamline, succeeds
from tests.beamline.scans import BEAM, DARK, frames_of, write_flagged

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = ("--data-path", "/p/a", "--darks-path", "/p/d", "--flats-path", "/p/f", "--angles-path", "/m/o")
LAYOUT = (*NAMES, "--angles-unit", "rad")
FBP = ("-m", "fbp", "--axis", "20.7", "--pixel-size-um", "500", "--no-report")


@pytest.fixture
def foreign(folder: Path) -> Path:
    """SCAN as another beamline may write it; the same frames in our own file are ours.h5."""
    frames = frames_of(SCAN)
    images = np.array([frame.counts for frame in frames])
    write_flagged(folder / "ours.h5", frames, {}, pixel_size_mm=SCAN.pixel_size_mm)
    with h5py.File(folder / "f.h5", "w") as file:
        file["p/d"], file["p/f"], file["p/a"], file["m/o"] = images[:2], images[2:4], images[4:], SCAN.angles
    return folder / "f.h5"


def _volume(*arguments: str) -> np.ndarray:
    succeeds("recon", *arguments, "-o", "v.h5")
    record = read_reconstruction(Path("v.h5"))
    Path("v.h5").unlink()
    return record.volume.data


def test_recon_by_paths_and_by_a_recipe_of_them(foreign: Path) -> None:
    expected = _volume("ours.h5", *FBP)
    assert np.abs(expected).max() > 0.03
    np.testing.assert_array_equal(_volume("f.h5", *LAYOUT, *FBP), expected)

    succeeds("recon", "f.h5", *LAYOUT, *FBP, "--write-config", "layout.yaml")
    assert 'data-path: "/p/a"' in Path("layout.yaml").read_text()
    np.testing.assert_array_equal(_volume("f.h5", "--config", "layout.yaml", "--no-report"), expected)


@pytest.mark.slow
def test_info_validate_monitor_and_ingest(foreign: Path) -> None:
    info = succeeds("info", "f.h5", *LAYOUT)
    assert "hdf5_stacks" in info.stdout
    succeeds("validate", "f.h5", *LAYOUT)
    looked = beamline("monitor", "f.h5", *LAYOUT)
    assert f"{4 + SCAN.angles.size} frames" in looked.stdout
    succeeds("ingest", "f.h5", "in.h5", *LAYOUT, "--pixel-size-um", "500")
    with open_scan(Path("in.h5")) as ours:
        assert ours.quantity == "counts"
        np.testing.assert_array_equal(ours.table.angles[4:], np.radians(np.degrees(SCAN.angles)))
        assert ours.read([0, 2]).mean(axis=(1, 2)).tolist() == [DARK, DARK + BEAM]
