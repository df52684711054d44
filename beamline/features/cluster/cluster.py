"""Cluster: processes on this machine or on others that reconstruct slabs, by dask.distributed."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import recon
from beamline.core.errors import BeamlineError, ConfigError
from beamline.core.process import SAFE_PATH
from beamline.features.cluster.slurm import is_slurm, require_accepted, slurm_jobs, submitted
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.method import Method, Reconstruction, RunControl

if TYPE_CHECKING:
    from distributed import Client, Future

_CONNECT_TIMEOUT = 30  # s for a scheduler to answer, and to get its first worker
_PATIENCE = 60.0  # s that work goes without any worker
LOOK_EVERY = 2.0  # s between two checks for a worker
_TASK_SIZE_WARNING = "1 TB"  # of a task, from which distributed would warn: a slab goes as it is


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
        """As `recon.reconstruct`, by a worker with as many threads as there are here; without progress and stop.

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
    """Number of workers on this machine; 0: none, or those of a scheduler."""
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
