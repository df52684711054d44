"""Every command reads every file it claims to read: all pairs of files and commands.

Series in time are read in tests/recon/features/joint/test_command.py.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from beamline.page.volume import ShownVolume
from beamline.reconstruct.truth import read_truth
from beamline.simulate import volumes_beside
from beamline.storage.volumes.files import opened_volume
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange, write_flagged

pytestmark = pytest.mark.slow  # half a minute for all pairs

SCENE = """
phantom:
  kind: solids
  solids:
    - {kind: ellipsoid, semi_axes: [0.1, 0.08, 0.06], attenuation: 4.0, centre: [0.05, 0.02, 0.0]}
beam: {photons_per_s: 1.0e+5}
detector: {shape: [12, 32], pixel_size_um: 12.0, exposure_s: 0.02}
scan: {views: 14, darks: 2, flats: 2}
effects: [photon_noise]
"""
SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 12.0)), shape=(10, 40), pixel_size_mm=0.5)
WINDOW = ("--bits", "16", "--window", "-1:6")

SCANS: dict[str, tuple[str, ...]] = {
    "simulated.h5": ("simulate", "scene.yaml", "-o"),
    "ingested.h5": ("ingest", "exchange.h5"),
}
FLOATS: dict[str, tuple[str, ...]] = {
    "fbp.h5": ("recon", "simulated.h5", "-m", "fbp", "--no-report", "-o"),
    "fbp.tif": ("recon", "simulated.h5", "-m", "fbp", "--no-report", "-o"),
    "truth.h5": ("simulate", "scene.yaml", "--truth"),
    **{f"copy{suffix}": ("export", "fbp.h5", "-o") for suffix in (".h5", ".tif", ".npy", ".nrrd", ".zarr", "")},
}
GREYS = {f"grey{suffix}": ("export", "fbp.h5", *WINDOW, "-o") for suffix in (".tif", ".npy", ".nrrd", ".zarr", "")}
FIT = ("recon", "simulated.h5", "-m", "r2", "--steps", "20", "--gaussians", "60", "--no-report", "-o")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current directory, with a file of each kind."""
    folder, before = tmp_path_factory.mktemp("written"), Path.cwd()
    os.chdir(folder)
    try:
        Path("scene.yaml").write_text(SCENE, encoding="utf-8")
        write_exchange(folder / "exchange.h5", SCAN)
        write_flagged(folder / "recorded.h5", frames_of(SCAN), {}, pixel_size_mm=SCAN.pixel_size_mm)
        simulated = {"simulated.h5": SCANS["simulated.h5"], "fit.h5": FIT}
        for name, command in {**simulated, **SCANS, **FLOATS, **GREYS}.items():
            if not Path(name).exists():
                done = beamline(*command, name)
                assert done.exit_code == 0, (name, done.output)
        yield folder
    finally:
        os.chdir(before)


def _command(*words: str) -> Callable[[str, Path], None]:
    """A command on a file; `OUT` in a word is a new name in the test's folder."""

    def run(name: str, out: Path) -> None:
        done = beamline(*(word.replace("FILE", name).replace("OUT", str(out / "out")) for word in words))
        assert done.exit_code == 0, done.output

    return run


SCAN_READERS = {
    "info": _command("info", "FILE"),
    "validate": _command("validate", "FILE", "--deep"),
    "monitor": _command("monitor", "FILE"),
    "ingest": _command("ingest", "FILE", "OUT.h5"),
    "recon": _command("recon", "FILE", "-m", "fbp", "--no-report", "-o", "OUT.h5"),
    "statistics": _command("info", "FILE", "--statistics"),
}


@pytest.mark.parametrize("reader", SCAN_READERS)
@pytest.mark.parametrize("name", [*SCANS, "exchange.h5", "recorded.h5"])
def test_scans(written: Path, tmp_path: Path, name: str, reader: str) -> None:
    SCAN_READERS[reader](name, tmp_path)


def _viewed(name: str, out: Path) -> None:
    ShownVolume(Path(name)).close()


def _as_truth(name: str, out: Path) -> None:
    with opened_volume(Path("fbp.h5")) as record:
        assert read_truth(name).shape == record.volume.grid.shape


def _in_a_scene(name: str, out: Path) -> None:
    stored = volumes_beside(Path.cwd())(name, None)
    assert stored is not None


VOLUME_READERS = {
    "info": _command("info", "FILE"),
    "validate": _command("validate", "FILE"),
    "export": _command("export", "FILE", "-o", "OUT.nrrd"),
    "view": _viewed,
    "truth": _as_truth,
    "scene": _in_a_scene,
}


@pytest.mark.parametrize("reader", VOLUME_READERS)
@pytest.mark.parametrize("name", [*FLOATS, "grey.tif", "grey.npy", "grey.zarr"])
def test_volumes(written: Path, tmp_path: Path, name: str, reader: str) -> None:
    if name in GREYS and not name.endswith(".npy") and reader == "export":
        pytest.skip("refused with its reason: grey values of a window are not the volume")
    VOLUME_READERS[reader](name, tmp_path)


def test_the_voxel_of_every_copy_is_that_of_the_volume(written: Path) -> None:
    with opened_volume(Path("fbp.h5")) as record:
        grid = record.volume.grid
    for name in (*FLOATS, *GREYS):
        if name.startswith("fine") or name.endswith(".npy"):
            continue
        with opened_volume(Path(name)) as record:
            assert record.volume.grid.spacing == pytest.approx(grid.spacing), name
            assert record.volume.grid.centre == pytest.approx(grid.centre, abs=1e-9), name


OTHERS: dict[str, tuple[str, ...]] = {
    "model.ply": ("export", "fit.h5", "--gaussians", "-o"),
    "sheet.png": ("monitor", "simulated.h5", "--sheet"),
    "histogram.png": ("info", "simulated.h5", "--statistics", "-o"),
    "checkpoint.h5": ("recon", "simulated.h5", "-m", "r2", "--steps", "9", "-o", "v.h5", "--no-report", "--checkpoint"),
    "sweep": ("sweep", "simulated.h5", "axis=14:17:1", "-o"),
    "study": ("study", "fixed-views", "simulated.h5", "-o"),
    "tradeoff": ("tradeoff", "simulated.h5", "-o"),
    "batch": ("batch", "simulated.h5", "-o"),
}


@pytest.mark.parametrize("name", [*SCANS, *FLOATS, *GREYS, *OTHERS])
def test_no_output_takes_the_place_of_what_is_there(written: Path, tmp_path: Path, name: str) -> None:
    """Of a file, a folder, or a link, as one to a disk that is not mounted."""
    command = {**SCANS, **FLOATS, **GREYS, **OTHERS}[name]
    there = tmp_path / name
    if name in ("study", "tradeoff", "sweep", "batch"):
        there.mkdir()
        mine = there / "mine"
    else:
        mine = there
    mine.touch()
    done = beamline(*command, str(there))
    assert done.exit_code == 5 and str(there) in done.output, done.output
    assert mine.stat().st_size == 0 and {*tmp_path.rglob("*")} == {there, mine}
    there.rename(tmp_path.with_name(f"{tmp_path.name}_aside"))
    away, link = tmp_path / "away", tmp_path / name
    link.symlink_to(away)
    done = beamline(*command, str(link))
    assert (done.exit_code, link.is_symlink(), [*tmp_path.iterdir()]) == (5, True, [link]), done.output
    assert f"{link} is a link to {away}, which does not exist" in done.output and "deleted" not in done.output
