"""The demo on a small scene: scan, live volume in its own process, ground truth, report."""

from __future__ import annotations

from pathlib import Path

import pytest

from beamline.config.load import Config, config_folder, load
from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.core.stop import StopRequest
from beamline.features.demo.command import run_demo
from beamline.storage.writers.recon_file import read_reconstruction

pytestmark = pytest.mark.usefixtures("one_thread")

ROOT = Path(__file__).parents[4]
SCENE = (
    "{phantom: {kind: solids, solids: ["
    "{kind: cylinder, radius: 0.05, height: 0.1, attenuation: 3.0},"
    "{kind: ellipsoid, semi_axes: [0.02, 0.02, 0.02], attenuation: 8.0, centre: [0.02, 0.01, 0.0]}]},"
    "beam: {photons_per_s: 1.0e+5}, axis_offset_px: 1.5, effects: [photon_noise]}"
)


def _small(*more: str) -> Config:
    overrides = (
        f"simulation.scene={SCENE}",
        "simulation.clock={speed: 10.0}",
        "devices.camera.roi=[1140, 2032, 24, 32]",
        "devices.stage.low_deg=-90",
        "scan.angles.views=24",
        "scan.period_s=0.3",
        "scan.darks.count=2",
        "scan.flats.count=2",
        "recon.seconds=1.5",
    )
    return load(config_folder() / "demo.yaml", (*overrides, *more))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory; the live reconstruction's process finds the packages of this checkout."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return tmp_path


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("real_pictures")
def test_from_trigger_to_judged_volume(here: Path) -> None:
    events: list[Event] = []
    run_demo(_small(), here / "runs", [events.append], StopRequest(), "beamline demo")
    names = [event.event for event in events]
    assert names[0] in ("state", "run_started")
    assert names.count("done") == 1
    assert names[-1] == "done"
    assert {"frame", "scan_done", "recon_started", "recon_done"} <= set(names)
    done = events[-1].data
    (folder,) = (here / "runs").iterdir()
    assert done["output"] == folder / "recon.h5"
    assert {"scan.h5", "recon.h5", "report.html", "events.jsonl", "user.log", "config.resolved.yaml"} <= {
        path.name for path in folder.iterdir()
    }
    assert done["axis_col"] == pytest.approx(15.5 + 1.5, abs=0.3)
    assert done["psnr"] > 20
    assert done["fbp"]["psnr"] > 20
    record = read_reconstruction(folder / "recon.h5")
    assert record.metrics["psnr"] == done["psnr"]
    assert record.parameters["command"] == "beamline demo"
    assert len(record.model["densities"]) == record.parameters["gaussians"]  # `beamline voxelise` takes it
    assert {"ssim_weight", "tv_weight", "rates", "policy_every", "seconds_after_scan", "finish"} <= set(
        record.parameters
    )
    page = (folder / "report.html").read_text(encoding="utf-8")
    for said in ("PSNR", "FBP", "R²-Gaussian", "30/30", "24 of 24 views", "Rotation axis"):
        assert said in page
    late = ">Flagged frames</summary>" in page  # on a busy machine frames of the real clock may come late
    stray = ">Stray mass</summary>" in page  # a few voxels of so small a volume, or none
    assert page.count("data:image/png;base64,") == 9 + late + stray


def test_a_live_volume_that_fails_leaves_the_scan_and_says_where_to_look(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BEAMLINE_PYTHON", str(here / "no-python"))
    with pytest.raises(DataError, match=r"recon\.log"):
        run_demo(_small("scan.angles.views=4", "scan.period_s=2"), here / "runs", [], StopRequest(), "beamline demo")
    (folder,) = (here / "runs").iterdir()
    assert (folder / "scan.h5").is_file()
