"""Cluster: processes on this machine or on others that reconstruct slabs, by dask.distributed."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PositiveFloat, PositiveInt, ValidationError

import recon
from beamline.config.section import Section
from beamline.config.tree import YAML_FAULTS
from beamline.core.errors import BeamlineError, ConfigError
from beamline.core.files import SETTINGS, text_in
from beamline.core.process import SAFE_PATH
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Method, Reconstruction, RunControl

if TYPE_CHECKING:
    from distributed import Client, Future

_NAME = "slurm"
_CONNECT_TIMEOUT = 30  # s for a scheduler to answer, and to get its first worker
_PATIENCE = 60.0  # s that work goes without any worker
LOOK_EVERY = 2.0  # s between two checks for a worker
_TASK_SIZE_WARNING = "1 TB"  # of a task, from which distributed would warn: a slab goes as it is


def _text(value: Any) -> Any:
    """A name that YAML takes for a whole number."""
    return str(value) if isinstance(value, int) else value


class SlurmJobs(Section):
    """Jobs of one worker each; missing keys have the cluster's defaults."""

    jobs: PositiveInt = 4
    cores: PositiveInt = 8
    """Cores of a job; it computes with as many threads as the process that submits it, see NUMBA_NUM_THREADS."""
    memory: str = Field("32GB", pattern=r"^\d+ ?[KMGT]i?B$")
    """Memory of a job; --memory is less."""
    walltime: str = Field("04:00:00", pattern=r"^(\d+-)?\d+(:\d\d){0,2}$")
    """In quotes in YAML, which takes 12:00:00 for a number."""
    queue: Annotated[str, BeforeValidator(_text)] | None = None
    account: Annotated[str, BeforeValidator(_text)] | None = None
    interface: str | None = None
    """Network interface between the jobs and this process, such as ib0."""
    directives: tuple[str, ...] = ()
    """Further options of sbatch, as --exclusive."""
    prologue: tuple[str, ...] = ()
    """Shell lines that a job begins with, as module load."""
    wait_s: PositiveFloat = 3600.0
    """For the first job to begin, and for another one where none is left."""

    @property
    def bytes(self) -> int:
        """Memory of a job."""
        (number, letter, binary), *_ = re.findall(r"(\d+) ?([KMGT])(i?)B", self.memory)
        return int(number) * (1024 if binary else 1000) ** (" KMGT".index(letter))


def is_slurm(spec: str) -> bool:
    """Whether a cluster is named as `slurm` or `slurm:CONFIG.yaml`."""
    return spec == _NAME or spec.startswith(f"{_NAME}:")


def slurm_jobs(spec: str) -> SlurmJobs:
    """The jobs of `slurm` or `slurm:CONFIG.yaml`.

    Raises:
        ConfigError: dask-jobqueue or sbatch is missing, or the file cannot be read, or is wrong, with the key.
    """
    if find_spec("dask_jobqueue") is None:
        raise ConfigError(f"--cluster {spec} needs dask-jobqueue: pip install splatline[cluster].")
    if shutil.which("sbatch") is None:
        raise ConfigError(f"--cluster {spec}: there is no sbatch here. Call from a machine that submits Slurm jobs.")
    name = spec.removeprefix(_NAME).removeprefix(":")
    try:
        tree = (yaml.safe_load(text_in(Path(name), SETTINGS)) if name else None) or {}
    except (OSError, yaml.YAMLError, RecursionError, *YAML_FAULTS) as error:
        raise ConfigError(f"--cluster {spec}: {name} cannot be read: {' '.join(str(error).split())}.") from error
    try:
        return SlurmJobs.model_validate(tree)
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, one['loc'])) or name}: {one['msg']}" for one in error.errors())
        raise ConfigError(f"--cluster {spec}: {wrong}. Keys: {', '.join(SlurmJobs.model_fields)}.") from error


def _cluster(jobs: SlurmJobs) -> Any:
    """The cluster of these jobs; no job is submitted."""
    ctrl_c = signal.getsignal(signal.SIGINT)
    from dask_jobqueue import SLURMCluster  # whose import lets Ctrl-C end the process at once

    if signal.getsignal(signal.SIGINT) is not ctrl_c:
        signal.signal(signal.SIGINT, ctrl_c)
    return SLURMCluster(
        cores=1,  # slabs that a worker makes at a time
        processes=1,
        job_cpu=jobs.cores,
        memory=jobs.memory,
        walltime=jobs.walltime,
        queue=jobs.queue,
        account=jobs.account,
        interface=jobs.interface,
        job_extra_directives=list(jobs.directives),
        job_script_prologue=[*(f"export {name}={value}" for name, value in SAFE_PATH.items()), *jobs.prologue],
        worker_extra_args=["--memory-limit", "0", "--no-dashboard"],
        scheduler_options={"dashboard": False},
    )


def _ask_slurm(cluster: Any) -> str:
    """Why Slurm would refuse the cluster's jobs; empty if it would take them.

    The library does not report a refused job.
    """
    asked = subprocess.run(["sbatch", "--test-only"], input=cluster.job_script(), capture_output=True, text=True)
    if not asked.returncode:
        return ""
    return " ".join(asked.stderr.split()) or f"sbatch ended with {asked.returncode}"


def require_accepted(spec: str) -> None:
    """Ask Slurm whether it would take the jobs of `slurm` or `slurm:CONFIG.yaml`; none is submitted.

    Raises:
        ConfigError: it would not, or the cluster cannot be started, or as `slurm_jobs`.
    """
    jobs = slurm_jobs(spec)
    try:
        with _cluster(jobs) as cluster:
            refusal = _ask_slurm(cluster)
    except (OSError, RuntimeError, ValueError) as error:  # distributed turns errors into a RuntimeError
        raise ConfigError(
            f"--cluster {spec}: the cluster cannot be started ({' '.join(str(error).split())}). Mend the configuration "
            "of the jobs, or this machine's network. Nothing was read."
        ) from error
    if refusal:
        raise ConfigError(
            f"--cluster {spec}: Slurm refuses the jobs ({refusal}). Mend the configuration of the jobs, and ask Slurm "
            "with sinfo what there is. Nothing was read."
        )


@contextmanager
def submitted(jobs: SlurmJobs) -> Iterator[Any]:
    """The cluster of these jobs, which are submitted, and cancelled when the block ends.

    Raises:
        RuntimeError: Slurm refuses them.
    """
    with _cluster(jobs) as cluster:
        if refusal := _ask_slurm(cluster):
            raise RuntimeError(refusal)
        cluster.scale(jobs=jobs.jobs)
        yield cluster


class WorkersLostError(BeamlineError):
    """Workers did not come back with a slab."""

    exit_code = 5


@dataclass(frozen=True)
class Cluster:
    """Workers that reconstruct; another worker repeats the work of a lost one.

    Attributes:
        patience: s after which work without any worker is given up.
    """

    workers: int
    _client: Client
    patience: float = _PATIENCE

    def reconstruct(
        self,
        projections: NDArray[np.float32],
        geometry: Geometry,
        method: Method,
        *,
        control: RunControl,
        **settings: Any,
    ) -> Reconstruction:
        """Reconstruct on a worker with as many threads as this process has; without progress and stop.

        Raises:
            WorkersLostError: several workers were lost with this work, or all workers, or the scheduler.
        """
        import numba
        from distributed import KilledWorker

        work = (np.array(projections), geometry, method, settings, control.decide)
        future = self._client.submit(_reconstruct, work, numba.get_num_threads(), pure=False)
        try:
            self._wait_for(future)
            made: Reconstruction = future.result()
        except (KilledWorker, CancelledError) as error:
            raise WorkersLostError(
                f"The scheduler, or several workers with the same slab, were lost ({error}). They may lack memory: "
                "give a smaller --memory, or fewer workers. Slabs that are finished stay: see --resume."
            ) from error
        return made

    def _wait_for(self, future: Future) -> None:
        """Return when it is done; raises WorkersLostError after `patience` without a worker."""
        look, alone, done = min(LOOK_EVERY, self.patience), 0.0, Event()
        # Not result(look): each TimeoutError of it is in a cycle with its frames, and these hold the partial volume.
        future.add_done_callback(lambda _: done.set())
        while not (done.wait(look) or future.done()):
            alone = 0.0 if _count(self._client) else alone + look
            if alone >= self.patience:
                raise WorkersLostError(
                    f"All workers have left, and none came for {self.patience:g} s. Start some again; slabs that "
                    "are finished stay: see --resume."
                )


def _count(client: Client) -> int:
    try:
        return len(client.scheduler_info(n_workers=-1)["workers"])
    except OSError:  # the scheduler does not answer
        return 0


def _reconstruct(work: tuple[Any, ...], threads: int) -> Reconstruction:
    """On a worker. The same number of threads gives the same bits."""
    import numba

    data, geometry, method, settings, decide = work
    assert decide is None or isinstance(decide, Decisions)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    made = recon.reconstruct(data, geometry, method, control=RunControl(decide=decide), **settings)
    return replace(made, gaussians=None, checkpoint=None, settings=dict(made.settings))


def check_cluster(spec: str) -> None:
    """Raises ValueError for a wrong name of a cluster, or if dask.distributed is not installed."""
    if find_spec("distributed") is None:
        raise ValueError("it needs dask.distributed: pip install splatline[cluster]")
    if not re.fullmatch(r"local:[1-9]\d*|tcp://[^\s/]+:\d+|slurm(:.+)?", spec):
        raise ValueError(
            f"{spec!r} is neither local:N with N workers on this machine, nor tcp://HOST:PORT, nor slurm[:CONFIG.yaml]"
        )


def local_workers(spec: str | None) -> int:
    """Number of workers to start on this machine; 0 where a scheduler has its own."""
    return int(spec.removeprefix("local:")) if spec is not None and spec.startswith("local:") else 0


def memory_of_each(spec: str, free: int) -> int:
    """Bytes that each worker, or job of Slurm, may use, where so many are free on this machine."""
    return min(free, slurm_jobs(spec).bytes) if is_slurm(spec) else round(free / (1 + local_workers(spec)))


def refuse_unusable(spec: str) -> None:
    """Raises ConfigError before any work if a cluster is unusable; no jobs are submitted."""
    if is_slurm(spec):
        require_accepted(spec)
    elif not local_workers(spec):
        with connected(spec):
            pass


@contextmanager
def connected(spec: str, first_worker_s: float = _CONNECT_TIMEOUT) -> Iterator[Cluster]:
    """The cluster that `spec` names; workers on this machine and jobs of Slurm end with the block.

    Args:
        first_worker_s: s to wait for the first worker; a configuration of Slurm has its own.

    Raises:
        ConfigError: no scheduler answers, jobs are refused, or no worker comes in time.
    """
    import dask
    from distributed import Client, LocalCluster

    with ExitStack() as closing:
        closing.enter_context(dask.config.set({"distributed.admin.large-graph-warning-threshold": _TASK_SIZE_WARNING}))
        address: Any = spec
        jobs = slurm_jobs(spec) if is_slurm(spec) else None
        try:
            if n := local_workers(spec):
                os.environ.update(SAFE_PATH)  # in ours, since multiprocessing starts a helper of its own with it
                # Without a page on a port, and without a limit of its own: --memory is that of a slab.
                address = LocalCluster(
                    n_workers=n, threads_per_worker=1, dashboard_address=None, memory_limit=0,
                    silence_logs=logging.ERROR,
                )  # fmt: skip
                closing.enter_context(address)
            elif jobs is not None:
                address, first_worker_s = closing.enter_context(submitted(jobs)), jobs.wait_s
            client = closing.enter_context(Client(address, timeout=_CONNECT_TIMEOUT, set_as_default=False))
        except (OSError, RuntimeError, ValueError) as error:
            what = "no scheduler answers" if jobs is None else "the jobs were not submitted"
            raise ConfigError(f"--cluster {spec}: {what} ({' '.join(str(error).split())}).") from error
        try:
            client.wait_for_workers(1, first_worker_s)
        except TimeoutError:
            advice = (
                f"Start some: dask worker {spec}." if jobs is None else "See squeue, and wait_s of the configuration."
            )
            raise ConfigError(
                f"--cluster {spec}: the scheduler has no workers, and none came in {first_worker_s:g} s. {advice}"
            ) from None
        if jobs is not None:
            yield Cluster(jobs.jobs, client, jobs.wait_s)
        else:
            yield Cluster(max(1, _count(client)), client)
