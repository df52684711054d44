"""`beamline ride --reference`: the scan of another program shows a state of a sample that was scanned carefully."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from fake_ioc import FakeIoc, array_value
from ridden import RideProgram, config_of, reread, stored

from beamline.config.load import load_as
from beamline.core.errors import ConfigError
from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import opened_volume, write_volume
from splatline_areadetector.command import ride
from splatline_areadetector.config import RideConfig
from tests.recon.features.reference.scene import N, packed, scanned

VIEWS, FIRST = 24, 20  # projections; of these, before the picture is waited for
DARK, LIGHT = 100, 40000  # counts
PITCH = 0.001  # mm, of a voxel
AFTER = replace(packed(), turn=np.radians(0.8), shift=(1.5, -1.0), slit=4)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("loopback")
def test_the_picture_shows_what_changed_and_the_volume_is_made_with_the_reference(tmp_path: Path) -> None:
    lines, geometry = scanned(AFTER, VIEWS, LIGHT, 2)
    views = np.round(DARK + LIGHT * np.exp(-lines)).astype(np.uint16)
    for name, counts in (("darks", DARK), ("flats", DARK + LIGHT)):
        np.save(tmp_path / f"{name}.npy", np.full((2, *views.shape[1:]), counts, np.uint16))
    good = tmp_path / "good.h5"
    write_volume(good, bare_record(tmp_path / "flats.npy", packed().volume / PITCH, (PITCH,) * 3))
    words = [word for name in ("darks", "flats") for word in (f"--{name}", str(tmp_path / f"{name}.npy"))]
    words += ["--reference", str(good), "--set", f"recon.axis={(N - 1) / 2}"]
    angles = {"from": "plan", "views": VIEWS, "start_deg": 0, "step_deg": 180 / VIEWS}
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, *words, angles=angles) as ride:
        for i, view in enumerate(views):
            if i == FIRST:
                ride.wait_for(lambda: any(tmp_path.glob("runs/*/*.live.png")))
            ioc.post(array_value(view, i + 1))
            time.sleep(0.05)
        assert ride.exit_code() in (0, 7), ride.output
    (file,), (run,) = stored(tmp_path), (tmp_path / "runs").iterdir()
    assert not file.missing and np.allclose(np.radians(file.degrees[file.of(0)]), geometry.angles)
    with opened_volume(run / "recon.h5") as record, h5py.File(run / "recon.h5") as volume:
        assert record.method == "from-reference" and record.settings["reference_used"]
        change, gap = volume["entry/data/change"][:], (AFTER.volume - replace(AFTER, slit=-1).volume) / PITCH
        assert (change * gap).sum() > 0.5 * np.square(gap).sum(), "the slit is in the change"


def test_the_name_of_a_reference_is_relative_to_the_configuration_and_a_missing_one_is_refused(tmp_path: Path) -> None:
    config_of(tmp_path, "pva://T:Pva1:Image")
    path = tmp_path / "my.yaml"
    with path.open("a", encoding="utf-8") as file:
        file.write("recon: {reference: good.h5}\n")
    with pytest.raises(ConfigError, match=r"recon.reference: there is no file .*good.h5; expected a volume"):
        reread(path)
    (tmp_path / "good.h5").touch()
    assert reread(path).recon.reference == str((tmp_path / "good.h5").resolve())


def test_a_missing_reference_is_named_by_the_option_and_its_path_does_not_depend_on_the_folder_of_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config_of(tmp_path, "pva://T:Pva1:Image")
    done = CliRunner().invoke(ride, [str(tmp_path / "my.yaml"), "--reference", "good.h5"])
    assert done.exit_code == 2 and "'--reference': Path 'good.h5' does not exist" in done.output
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.h5").touch()
    read = load_as(RideConfig, Path("my.yaml"), ["recon.reference=good.h5"], printed_by="beamline ride --example")
    assert read.recon.reference == str(tmp_path.resolve() / "good.h5")
