"""Every command on damaged and malicious inputs ends in time, with a documented exit code and without a traceback."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from beamline.core.stop import StopRequest
from tests.beamline.config_file import GOOD
from tests.beamline.fakes import FakeInstrument
from tests.beamline.hostile_worker import Worker
from tests.beamline.mutations import mutate_file, mutate_yaml
from tests.beamline.ran import Ran

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
CPU_SECONDS = 15.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a scan that was stopped."""
    stop = StopRequest()
    instrument = FakeInstrument(at={10: stop.stop})
    ran = Ran(tmp_path_factory.mktemp("runs"), instrument, "scan.mode=step", stop=stop)
    return ran.folder


@pytest.fixture(scope="module")
def worker(run: Path) -> Iterator[Worker]:
    scan = str(run / "scan.h5")
    with Worker(CPU_SECONDS, [("recon", "-m", "fbp", scan, "--dry-run"), ("monitor", scan)]) as worker:
        yield worker


@pytest.mark.parametrize("seed", range(8))
def test_altered_scan_files(worker: Worker, run: Path, tmp_path: Path, seed: int) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    scan, did = str(folder / "scan.h5"), mutate_file(folder / "scan.h5", np.random.default_rng(seed))
    for command in (
        ("info", scan),
        ("validate", "--deep", scan),
        ("monitor", scan),
        ("recon", "-m", "fbp", scan, "-o", str(folder / "v.h5"), "--no-report"),
        ("ingest", scan, str(folder / "i.h5")),
        ("archive", scan, "-o", str(folder / "a.h5")),
        ("scan", "--resume", str(folder), "--dry-run"),
        ("recover", str(folder)),
    ):
        ended = worker.run(*command)
        assert ended.good, (did, command, ended)


@pytest.mark.parametrize("seed", range(20))
def test_altered_configurations(worker: Worker, run: Path, tmp_path: Path, seed: int) -> None:
    text, did = mutate_yaml(GOOD, np.random.default_rng(seed))
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    name = str(tmp_path / "c.yaml")
    for command in (("check", name), ("scan", name, "--dry-run"), ("monitor", str(run / "scan.h5"), "--config", name)):
        ended = worker.run(*command)
        assert ended.good, (did, command, ended)
