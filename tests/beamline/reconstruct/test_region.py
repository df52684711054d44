"""A region of the volume: its voxels and their positions are those of the whole volume."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from beamline.projections import prepare
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import read_reconstruction
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.slow_cases import others_slow

BOX = np.s_[38:60, 10:40, 4:29]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Noisy views of 96 rows of a sample that is thinner with every row, scan.h5."""
    cylinders = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(96, 48), axis_col=23.2)
    thinner = cylinders.line_integrals() * np.linspace(1, 0.6, 96)[:, None]
    counts = 100 + np.random.default_rng(20261120).poisson(20000 * np.exp(-thinner))
    folder = tmp_path_factory.mktemp("made")
    write_exchange(folder / "scan.h5", cylinders, {"data": counts.astype(np.uint16)})
    return folder


def volume(*options: str, scan: Path = Path("scan.h5")) -> ReconRecord:
    result = beamline("recon", str(scan), "--air", "none", *options)
    assert result.exit_code == 0, result.output
    return read_reconstruction(Path(options[-1]))


@pytest.fixture(scope="module")
def whole(made: Path) -> Callable[..., ReconRecord]:
    """The whole volume by a method, which is made once."""
    return cache(lambda *way: volume(*way, "--no-report", "-o", str(made / f"{way[1]}.h5"), scan=made / "scan.h5"))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("method", "near"),
    others_slow(
        [
            (("-m", "fbp", "--memory", "2.5M"), 1e-5),
            (("-m", "fbp"), 1e-5),
            (("-m", "sirt", "--iterations", "3"), 1e-5),
            (("-m", "fista-tv", "--iterations", "5", "--tv-weight", "0.002"), 2e-3),
        ]
    ),
    ids=["fbp in slabs", "fbp", "sirt", "fista-tv"],
)
def test_voxels_and_places_are_those_of_the_whole_volume(
    whole: Callable[..., ReconRecord], method: tuple[str, ...], near: float
) -> None:
    """Where total variation takes its weight from the rows around, it differs as slabs do."""
    every = whole(*method[: 2 if "fbp" in method else None])
    part = volume(*method, "--roi", "38:60,10:40,4:29", "--no-report", "-o", "part.h5")
    assert part.volume.data.shape == (22, 30, 25) and ("slabs" in part.parameters) is ("--memory" in method)
    assert np.abs(part.volume.data - every.volume.data[BOX]).max() < near * every.volume.data.max()
    for mine, its, box in zip(part.volume.grid.coordinates(), every.volume.grid.coordinates(), BOX, strict=True):
        np.testing.assert_allclose(mine, its[box], atol=1e-9)
    assert part.parameters["roi"] == "38:60,10:40,4:29"
    assert part.parameters["axis_col"] == every.parameters["axis_col"]


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_the_box_around_the_sample_is_that_of_the_record(whole: Callable[..., ReconRecord]) -> None:
    found, every = volume("-m", "fbp", "--roi", "auto", "--no-report", "-o", "auto.h5"), whole("-m", "fbp").volume.data
    z, y, x = (slice(*map(int, side.split(":"))) for side in str(found.parameters["roi"]).split(","))
    np.testing.assert_allclose(found.volume.data, every[z, y, x], atol=1e-5 * every.max())
    assert str(found.parameters["roi_found"]).startswith("The sample, with a margin, is in the voxels")


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_fbp_of_a_region_reports_no_residual() -> None:
    """A part of the volume cannot be compared with the views."""
    record = volume("-m", "fbp", "--roi", "38:60,10:40,4:29", "-o", "part.h5")
    assert "residual" not in record.metrics and "snr" in record.metrics
    assert "the region 38:60,10:40,4:29" in Path("part.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "step", "said"),
    [
        ("38:60,10:40,4:49 --axis 23.2", "survey", "x 4:49 does not lie"),
        ("38:60,10:97,4:29", "survey", "y 10:97 does not lie within the widest volume's range 0:96"),
        ("38:60,10:40,4:49", "assemble", "x 4:49 does not lie within the volume's range 0:48"),
    ],
    ids=["by the axis given", "by the detector", "by the axis found"],
)
def test_beyond_the_width_is_refused_before(
    folder: Path, monkeypatch: pytest.MonkeyPatch, options: str, step: str, said: str
) -> None:
    """Before anything is read; where only the axis that is found tells, before all views are corrected."""
    monkeypatch.setattr(prepare, step, lambda *_: pytest.fail("too late"))
    result = beamline("recon", "scan.h5", "-m", "fbp", "-o", "out.h5", "--roi", *options.split())
    assert result.exit_code == 2 and said in result.stderr, result.output
    assert left(folder) == {"scan.h5"}
