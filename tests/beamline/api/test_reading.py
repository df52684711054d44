"""Scans and volumes from Python: verdict, frames, the live volume, and a reconstruction without files."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import h5py
import numpy as np
import pytest

import recon
from beamline import api
from beamline.core.events import Event
from beamline.storage.recon_record import ReconRecord
from beamline.storage.run_record import RecordFile, RunRecord
from beamline.storage.volumes.files import write_volume
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from tests.beamline.cli.small_scan import SCAN, beamline
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran
from tests.beamline.scans import write_exchange


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path / "scan.h5"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run of 19 frames."""
    ran = Ran(tmp_path / "runs", FakeInstrument())
    return ran.folder


def test_the_verdict_is_that_of_the_command(run: Path) -> None:
    said = json.loads(beamline("monitor", str(run / "scan.h5"), "--json").stdout.splitlines()[-1])
    verdict = api.monitor(run)
    assert (verdict.n_frames, len(verdict.alarmed)) == (said["n_frames"], said["alarmed_frames"])
    assert verdict.flags == said["flags"]
    assert list(verdict.references) == said["references"] and list(verdict.aside) == said["aside"]
    assert verdict.clean is (not verdict.alarmed and not verdict.references)


def test_frames_of_a_file_in_order(run: Path) -> None:
    frames = list(api.stream(run))
    assert [frame.index for frame in frames] == list(range(19))
    assert [frame.kind for frame in frames][:3] == [FrameKind.DARK] * 3
    assert frames[0].counts.dtype == np.uint16 and frames[5].counts.shape == (8, 12)


def test_frames_come_to_another_program_while_the_scan_runs(tmp_path: Path) -> None:
    """The scan takes its eighth frame when the fifth has come out of the stream; the stream ends with the scan."""
    code = "import sys; from beamline import api\nfor f in api.stream(sys.argv[1]): print(f.index, flush=True)"
    came: list[int] = []
    readers: list[subprocess.Popen[str]] = []

    def begin(event: Event) -> None:
        if event.event == "run_started":
            command = [sys.executable, "-c", code, str(event.data["folder"])]
            readers.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))

    def indices() -> Iterator[int]:
        assert readers[0].stdout is not None
        return map(int, readers[0].stdout)

    instrument = FakeInstrument(at={8: lambda: came.extend(islice(indices(), 5))})
    ran = Ran(tmp_path / "runs", instrument, heard=begin)
    assert ran.error is None
    with readers[0]:
        came.extend(indices())
    assert came == list(range(19)) and readers[0].returncode == 0


def test_frames_that_are_there_of_a_scan_that_died(run: Path) -> None:
    with h5py.File(run / "scan.h5", "r+") as file:
        file[layout.COMMITTED][()], file[layout.FINISHED][()] = 7, False
    assert [frame.index for frame in api.stream(run, follow=False)] == list(range(7))


def _volume(value: float) -> ReconRecord:
    volume = recon.Volume(np.full((2, 3, 3), value, np.float32), recon.Grid((2, 3, 3), 0.1))
    return ReconRecord(
        volume=volume, length_unit="mm", raw_file="scan.h5", title="a", sample="b", time=0.0, parameters={"n_views": 1}
    )


def test_the_live_volume_each_time_that_it_is_new_then_the_finished_one(run: Path) -> None:
    record = RecordFile(run, RunRecord("finishing"))
    write_volume(run / "recon.snapshot.h5", _volume(1.0))
    grown = api.volumes(run)
    assert next(grown).data.max() == 1
    write_volume(run / "recon.snapshot.h5", _volume(2.0), replace=True)
    os.utime(run / "recon.snapshot.h5", ns=(10**18, 10**18))
    assert next(grown).data.max() == 2
    write_volume(run / "recon.h5", _volume(3.0))
    (run / "recon.snapshot.h5").unlink()
    record.close()
    (last,) = grown
    assert last.data.max() == 3 and last.grid.voxel_size == pytest.approx(0.1)
    assert len(list(api.volumes(run))) == 1


@pytest.fixture
def left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of temporary files, which is empty afterwards."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    yield place
    assert list(place.iterdir()) == []


def test_a_volume_and_figures_without_a_file(scan: Path, left: Path, tmp_path: Path) -> None:
    before = {*tmp_path.iterdir()}
    result = api.reconstruct(scan, "fbp", rows=slice(0, 1), say=None)
    assert result.volume.data.shape == (1, 40, 40) and result.volume.data.dtype == np.float32
    assert result.method == "fbp" and 0 < result.figures["residual"] < 1
    assert result.settings["rows"] == "0:1" and result.units == "1/mm"
    assert (result.output, result.report, result.ended_early) == (None, None, False)
    assert {*tmp_path.iterdir()} == before
    assert "data:image/png;base64," in result._repr_html_()


def test_a_method_with_settings_and_a_selection(scan: Path, left: Path) -> None:
    chosen = api.Selection(axis_col=19.5, views="fixed:15")
    result = api.reconstruct(scan, recon.Sirt(iterations=2), selection=chosen, binning=2, say=None)
    assert (result.axis_col, result.settings["n_views"], result.settings["binning"]) == (19.5, 15, 2)
    assert result.volume.data.shape == (1, 20, 20)


def test_with_an_output_the_files_of_the_command(scan: Path, tmp_path: Path) -> None:
    result = api.reconstruct(scan, "fbp", output=tmp_path / "out.h5", say=None)
    command = beamline("recon", str(scan), "-m", "fbp", "-o", str(tmp_path / "cli.h5"))
    assert command.exit_code == 0
    again = replace(result, output=tmp_path / "cli.h5").volume
    assert np.array_equal(result.volume.data, again.data) and result.volume.grid == again.grid
    assert result.report == tmp_path / "out.html" and result.report.is_file()
    with pytest.raises(api.DataError, match="never overwritten"):
        api.reconstruct(scan, "fbp", output=tmp_path / "out.h5", say=None)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"method": "magic"}, api.ConfigError, "magic"),
        ({"rows": slice(0, 2, 2)}, api.ConfigError, "give a slice without a step"),
        ({"rows": (0, 99)}, api.ConfigError, "0:99"),
        ({"views": "some"}, api.ConfigError, "some"),
    ],
)
def test_what_cannot_be_is_refused(
    scan: Path, left: Path, arguments: dict[str, object], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        api.reconstruct(scan, say=None, **{"method": "fbp", **arguments})  # type: ignore[arg-type]
