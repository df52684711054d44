"""Slabs from workers of dask.distributed are bit-identical, also after a worker is lost."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import distributed
import numpy as np
import pytest

import recon
import splatline_cluster as module
from beamline.cli.recon_options import cluster_of
from beamline.core.errors import ConfigError, DataError
from beamline.storage.writers.recon_file import read_reconstruction
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import DataUse, ReconProblem, Reconstruction, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.features.iterative.methods import Sirt
from splatline_cluster import Cluster, WorkersLostError, connected
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange

pytestmark = pytest.mark.filterwarnings("ignore")  # of dask's own threads and sockets


@dataclass(frozen=True)
class DiesOnce(Sirt):
    """SIRT that ends its whole process where the file is not there yet."""

    marker: str = ""

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        if not Path(self.marker).exists():
            Path(self.marker).touch()
            os._exit(1)
        return Sirt(self.iterations).run(problem, control)


@pytest.fixture(scope="module")
def two() -> Iterator[Cluster]:
    with connected("local:2") as cluster:
        yield cluster


@pytest.mark.slow
def test_the_work_of_a_lost_worker_is_done_again(two: Cluster, tmp_path: Path) -> None:
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 9.0)), shape=(3, 32), axis_col=15.7)
    views = Geometry.parallel(scan.angles, scan.shape, axis_col=scan.axis_col)
    data = scan.line_integrals().astype(np.float32)
    use, control = DataUse(), RunControl(decide=Decisions(0))
    method = DiesOnce(iterations=3, marker=str(tmp_path / "died"))
    grid = Grid.matching(views)
    found = two.reconstruct(Views(data, views), method, grid=grid, seed=0, device="cpu", use=use, control=control)
    assert (tmp_path / "died").exists()
    np.testing.assert_array_equal(found.volume.data, recon.reconstruct(data, views, Sirt(iterations=3)).volume.data)


@pytest.mark.slow
def test_the_volume_is_that_without_a_cluster_to_the_bit(
    two: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "LOOK_EVERY", 0.01)  # as if a slab took long: what looks leave behind holds no file
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(96, 32), axis_col=15.7)
    counts = 100 + rng.poisson(scan.counts().astype(float) - 100)
    write_exchange(Path("scan.h5"), scan, {"data": counts.astype(np.uint16)})
    fista = ("recon", "scan.h5", "-m", "fista-tv", "--iterations", "2", "--tv-weight", "0.002", "--no-report")
    fista += ("--memory", "4.1M")
    scheduler = two.client.scheduler.address
    for more in (("-o", "here.h5"), ("--cluster", scheduler, "-o", "there.h5")):
        result = beamline(*fista, *more)
        assert result.exit_code == 0, result.output
    assert "96 of 96 slices are done" in result.stderr
    here, there = (read_reconstruction(Path(name)) for name in ("here.h5", "there.h5"))
    np.testing.assert_array_equal(there.volume.data, here.volume.data)
    assert there.metrics["residual"] == here.metrics["residual"]
    assert left(tmp_path) == {"scan.h5", "here.h5", "there.h5"}


class Losing:
    """A client, and its future, that never gets a result."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def submit(self, *work: object, **options: object) -> Losing:
        return self

    def add_done_callback(self, then: Callable[[Losing], object]) -> None:
        then(self)

    def result(self) -> None:
        raise self.error


def test_a_slab_that_nobody_returns_is_an_error_and_not_left_to_another_method() -> None:
    """A DataError would be: that of a slab without matter."""
    killed = distributed.KilledWorker("slab", SimpleNamespace(address="worker"), 3)
    views = Geometry.parallel([0.0, 1.0], (1, 4))
    rest = {"grid": Grid.matching(views), "seed": 0, "device": "cpu", "use": DataUse(), "control": RunControl()}
    for error in (killed, CancelledError("gone")):
        with pytest.raises(WorkersLostError, match="was lost, or several workers"):
            Cluster(1, Losing(error)).reconstruct(Views(np.zeros((2, 1, 4), np.float32), views), Sirt(), **rest)  # type: ignore[arg-type]
    assert not issubclass(WorkersLostError, DataError)


def test_there_are_as_many_workers_as_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as many as processors; in this process, which is quick."""
    monkeypatch.setattr(distributed, "LocalCluster", partial(distributed.LocalCluster, processes=False))
    n = (os.cpu_count() or 1) + 1
    with connected(f"local:{n}") as cluster:
        assert cluster.workers == n


def test_without_any_worker_it_ends_after_the_time_stated() -> None:
    """A scheduler that answers and has none, at the start and during work."""
    views = Geometry.parallel([0.0, 1.0], (1, 4))
    rest = {"grid": Grid.matching(views), "seed": 0, "device": "cpu", "use": DataUse(), "control": RunControl()}
    alone = distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None, protocol="tcp")
    with alone, distributed.Client(alone, set_as_default=False) as client:
        with (
            pytest.raises(ConfigError, match=r"in 0\.2 s\."),
            connected(alone.scheduler_address, first_worker_s=0.2),
        ):
            pytest.fail("there is nobody to do anything")
        with pytest.raises(WorkersLostError, match=r"for 0\.2 s"):
            Cluster(1, client, patience=0.2).reconstruct(Views(np.zeros((2, 1, 4), np.float32), views), Sirt(), **rest)  # type: ignore[arg-type]


@pytest.mark.parametrize("spec", ["local", "local:0", "slurm", "tcp://", "tcp://x", "tls://x:1", "http://x:1"])
def test_what_names_no_workers_is_refused(spec: str) -> None:
    with pytest.raises(ValueError, match="neither local:N"):
        cluster_of(spec)


@pytest.mark.slow
def test_workers_do_not_import_modules_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    (tmp_path / "string.py").write_text("raise SystemExit('a module of the current folder')")
    with connected("local:1") as cluster:
        assert cluster.workers == 1


@pytest.mark.parametrize(
    ("version", "told"),
    [
        ("0.9.0", "2 of 2 workers cannot be used: splatline is 0.9.0 at"),
        (None, "2 of 2 workers cannot be used: splatline or splatline-cluster cannot be loaded (no version) at"),
    ],
)
def test_workers_that_lack_this_version_are_named_before_the_work(two: Cluster, version: str | None, told: str) -> None:
    def another() -> None:
        def absent(name: str) -> str:
            if name == "__version__":
                raise ModuleNotFoundError("no version")
            raise AttributeError(name)

        vars(recon).pop("__version__", None)
        vars(recon).update({"__version__": version} if version else {"__getattr__": absent})

    def as_before() -> None:
        import importlib

        vars(recon).pop("__version__", None)
        importlib.reload(recon)

    two.client.run(another)
    try:
        with pytest.raises(ConfigError) as refused:
            module._require_same_version(two.client, "local:2")
        assert told in str(refused.value) and f"where splatline {recon.__version__} and" in str(refused.value)
    finally:
        two.client.run(as_before)
    module._require_same_version(two.client, "local:2")
