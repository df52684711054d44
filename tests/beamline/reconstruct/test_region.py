"""A region of the volume: the voxels, and their places, of the whole volume."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.projections import prepare
from beamline.reconstruct.region import Region
from beamline.storage.writers.recon_file import ReconRecord, read_reconstruction
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange

BOX = np.s_[38:60, 10:40, 4:29]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Path:
    """A noisy scan of 96 rows of a sample that is thinner with every row, scan.h5."""
    monkeypatch.chdir(tmp_path)
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 4.0)), shape=(96, 48), axis_col=23.2)
    thinner = scan.line_integrals() * np.linspace(1, 0.6, 96)[:, None]
    counts = 100 + rng.poisson(20000 * np.exp(-thinner))
    write_exchange(Path("scan.h5"), scan, {"data": counts.astype(np.uint16)})
    return tmp_path


def made(*options: str) -> ReconRecord:
    result = beamline("recon", "scan.h5", "--air", "none", *options)
    assert result.exit_code == 0, result.output
    return read_reconstruction(Path(options[-1]))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("method", "near"),
    [
        (("-m", "fbp"), 1e-5),
        (("-m", "fbp", "--memory", "2.7M"), 1e-5),
        (("-m", "sirt", "--iterations", "3"), 1e-5),
        (("-m", "fista-tv", "--iterations", "5", "--tv-weight", "0.002"), 2e-3),
    ],
    ids=["fbp", "fbp in slabs", "sirt", "fista-tv"],
)
def test_voxels_and_places_are_those_of_the_whole_volume(method: tuple[str, ...], near: float) -> None:
    """Where total variation takes its weight from the rows around, it differs as slabs do."""
    whole = made(*method[:2], *method[2:4] * ("fbp" not in method), "--no-report", *method[4:], "-o", "whole.h5")
    part = made(*method, "--roi", "38:60,10:40,4:29", "--no-report", "-o", "part.h5")
    assert part.volume.data.shape == (22, 30, 25)
    assert np.abs(part.volume.data - whole.volume.data[BOX]).max() < near * whole.volume.data.max()
    for mine, its, box in zip(part.volume.grid.coordinates(), whole.volume.grid.coordinates(), BOX, strict=True):
        np.testing.assert_allclose(mine, its[box], atol=1e-9)
    assert part.parameters["roi"] == "38:60,10:40,4:29"
    assert part.parameters["axis_col"] == whole.parameters["axis_col"]


@pytest.mark.usefixtures("folder")
def test_the_box_around_the_sample_is_that_of_the_record() -> None:
    found = made("-m", "fbp", "--roi", "auto", "--no-report", "-o", "auto.h5")
    given = made("-m", "fbp", "--roi", str(found.parameters["roi"]), "--no-report", "-o", "given.h5")
    np.testing.assert_array_equal(found.volume.data, given.volume.data)
    assert str(found.parameters["roi_found"]).startswith("The sample lies in voxels")


@pytest.mark.usefixtures("folder")
def test_fbp_of_a_region_reports_no_residual() -> None:
    """A part of the volume cannot be compared with the views."""
    record = made("-m", "fbp", "--roi", "38:60,10:40,4:29", "-o", "part.h5")
    assert "residual" not in record.metrics and "snr" in record.metrics
    assert "the region 38:60,10:40,4:29" in Path("part.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (("--roi", "38:60,10:40"), 2, "is not Z0:Z1,Y0:Y1,X0:X1"),
        (("--roi", "38:97,10:40,4:29"), 2, "slices 38:97"),
        (("--roi", "38:60,10:40,4:49"), 2, "x 4:49 does not lie in the volume's 0:48"),
        (("--roi", "38:60,10:40,4:29", "--cone", "50:70"), 2, "is a cone"),
        (
            ("--roi", "38:60,10:40,4:29", "--calibrate", "axis,shifts,roll"),
            2,
            "--calibrate roll and --calibrate shift",
        ),
        (("--roi", "38:60,10:40,4:29", "--follow"), 2, "does not go with --follow"),
        (("--roi", "38:60,10:40,4:29", "--max-residual", "1"), 2, "needs the whole volume"),
    ],
)
def test_refused_with_nothing_written(folder: Path, options: tuple[str, ...], code: int, said: str) -> None:
    method = () if "--follow" in options else ("-m", "fbp")
    result = beamline("recon", "scan.h5", *method, *options, "-o", "out.h5")
    assert result.exit_code == code and said in result.stderr, result.output
    assert left(folder) == {"scan.h5"}


@pytest.mark.parametrize(
    ("options", "step", "said"),
    [
        (("--roi", "38:60,10:40,4:49", "--axis", "23.2"), "ScanCorrection", "x 4:49 does not lie"),
        (("--roi", "38:60,10:97,4:29"), "ScanCorrection", "y 10:97 does not lie in the widest volume's 0:96"),
        (("--roi", "38:60,10:40,4:49"), "assemble", "x 4:49 does not lie in the volume's 0:48"),
    ],
    ids=["by the axis given", "by the detector", "by the axis found"],
)
def test_beyond_the_width_is_refused_before(
    folder: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], step: str, said: str
) -> None:
    """Before anything is read; where only the axis that is found tells, before all views are corrected."""
    monkeypatch.setattr(prepare, step, lambda *_: pytest.fail("too late"))
    result = beamline("recon", "scan.h5", "-m", "fbp", *options, "-o", "out.h5")
    assert result.exit_code == 2 and said in result.stderr, result.output
    assert left(folder) == {"scan.h5"}


def test_a_wide_field_has_regions_beyond_the_detector(folder: Path) -> None:
    """Its volume is as wide as a full turn sees: 77 voxels of 48 columns."""
    assert made("-m", "fbp", "--axis", "9", "--roi", "38:60,10:40,50:77", "-o", "out.h5").volume.data.shape[2] == 27


def test_a_region_says_what_it_was_parsed_from() -> None:
    assert str(Region.parse("3:5,0:7,10:11")) == "3:5,0:7,10:11"
    for wrong in ("", "3:5,0:7,10:11,", "3:5,0:7,11:10", "a:b,0:1,0:1", "-1:5,0:7,1:2", "3:5,0:7,10:11x"):
        with pytest.raises(ValueError, match="whole numbers"):
            Region.parse(wrong)
