"""Jobs of Slurm: what is submitted, and what is refused before."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.core.errors import ConfigError
from beamline.features.cluster import cluster as slurm
from beamline.features.cluster.cluster import SlurmJobs, connected, is_slurm, require_accepted, slurm_jobs
from beamline.reconstruct import pipeline
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import DataUse, RunControl
from recon.base.volume import Grid
from recon.features.iterative.methods import Sirt
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scans import TwoCylinders, write_exchange

# Keeps the script, and runs it as Slurm would, in a group of its own.
SBATCH = """#!/bin/sh
if [ "$1" = --test-only ]; then cat > "$FAKE/tested.sh"; exit 0; fi
cp "$1" "$FAKE/job.sh"
setsid bash "$FAKE/job.sh" > "$FAKE/out" 2>&1 &
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
echo "$1" > "$FAKE/cancelled"
kill -- "-$1"
"""


@pytest.fixture(autouse=True)
def ctrl_c_as_before() -> Iterator[None]:
    """The library sets a handler of Ctrl-C when it is imported, which would end the tests after these."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the commands of Slurm, first on the path."""
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no shell")
@pytest.mark.filterwarnings("ignore")  # of dask's own threads and sockets
def test_a_job_reconstructs_and_is_cancelled(fake: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    Path("jobs.yaml").write_text("jobs: 1\ncores: 3\nmemory: 5GB\nqueue: day\ndirectives: [--exclusive]\nwait_s: 60\n")
    views = Geometry.parallel(np.arange(12) * np.pi / 12, (2, 16))
    data = np.random.default_rng(0).random((12, 2, 16), dtype=np.float32)
    use, control = DataUse(), RunControl(decide=Decisions(0))
    with connected("slurm:jobs.yaml") as cluster:
        grid, method = Grid.matching(views), Sirt(iterations=3)
        found = cluster.reconstruct(data, views, method, grid=grid, seed=0, device="cpu", use=use, control=control)
    assert cluster.workers == 1
    np.testing.assert_array_equal(found.volume.data, recon.reconstruct(data, views, Sirt(iterations=3)).volume.data)
    script = Path("job.sh").read_text()
    assert "#SBATCH -p day" in Path("tested.sh").read_text().splitlines()
    for line in ("#SBATCH -p day", "#SBATCH --cpus-per-task=3", "#SBATCH --mem=5G", "#SBATCH --exclusive"):
        assert line in script.splitlines()
    assert "--nthreads 1" in script
    assert Path("cancelled").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="no shell")
@pytest.mark.filterwarnings("ignore")
def test_what_slurm_refuses_is_an_error_at_once(fake: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    (fake / "sbatch").write_text("#!/bin/sh\ncat > /dev/null\necho 'invalid partition specified: day' >&2\nexit 1\n")
    with pytest.raises(ConfigError, match=r"not submitted .*invalid partition"), connected("slurm"):
        pytest.fail("nothing was submitted")


@pytest.mark.skipif(sys.platform == "win32", reason="no shell")
@pytest.mark.filterwarnings("ignore")
def test_ctrl_c_still_interrupts_after_the_library_of_slurm_was_imported(
    fake: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    for name in [name for name in sys.modules if name.startswith("dask_jobqueue")]:
        monkeypatch.delitem(sys.modules, name)
    before = signal.getsignal(signal.SIGINT)
    require_accepted("slurm")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(sys.platform == "win32", reason="no shell")
@pytest.mark.filterwarnings("ignore")
def test_slurm_is_asked_before_the_scan_is_read(fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    (fake / "sbatch").write_text("#!/bin/sh\ncat > asked.sh\necho 'invalid partition specified: day' >&2\nexit 1\n")
    write_exchange(Path("scan.h5"), TwoCylinders(angles=np.radians(np.arange(0, 180, 20.0)), shape=(4, 16), axis_col=8))
    monkeypatch.setattr(pipeline, "prepare_within", lambda *_: pytest.fail("too late"))
    result = beamline("recon", "scan.h5", "-m", "sirt", "--cluster", "slurm", "-o", "out.h5")
    assert result.exit_code == 2 and "Slurm refuses the jobs (invalid partition specified: day)" in result.stderr
    assert "--cpus-per-task=8" in Path("asked.sh").read_text()
    assert not list(fake.glob("out*"))


@pytest.mark.skipif(sys.platform == "win32", reason="no shell")
@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_cannot_be_started_is_not_said_to_be_refused(fake: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
    Path("jobs.yaml").write_text("interface: none9\n")
    with pytest.raises(ConfigError, match=r"be started \(.*none9.*Nothing was read"):
        require_accepted("slurm:jobs.yaml")
    assert not Path("tested.sh").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cpus: 3", "cpus: Extra inputs are not permitted. Keys: jobs, cores"),
        ("jobs: 0", "jobs: Input should be greater than 0"),
        ("jobs: yes", "jobs is true"),
        ("memory: plenty", "memory: String should match"),
        ("- 3", "valid dictionary"),
        ("a: [", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_a_wrong_configuration_is_refused(
    fake: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, said: str
) -> None:
    monkeypatch.setattr(slurm, "find_spec", lambda name: object())  # whether or not it is installed
    monkeypatch.setattr(slurm.shutil, "which", lambda name: name)
    if text is not None:
        Path("jobs.yaml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        slurm_jobs("slurm:jobs.yaml")


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slurm, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install splatline\[cluster\]"):
        slurm_jobs("slurm")
    monkeypatch.setattr(slurm, "find_spec", lambda name: object())
    monkeypatch.setattr(slurm.shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match="no sbatch here"):
        slurm_jobs("slurm")
    monkeypatch.setattr(slurm.shutil, "which", lambda name: name)
    assert slurm_jobs("slurm") == SlurmJobs() and is_slurm("slurm:x.yaml") and not is_slurm("local:3")


def test_slabs_fit_a_job() -> None:
    assert SlurmJobs(memory="32GB").bytes == 32 * 10**9
    assert SlurmJobs(memory="4 GiB").bytes == 4 * 2**30
