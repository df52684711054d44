"""Reconstructs slabs in processes on this machine or on others, with dask.distributed."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from threading import Event
from typing import Any

import dask
import numpy as np
from distributed import Client, Future, KilledWorker, LocalCluster

import recon
from beamline.core.errors import BeamlineError, ConfigError
from recon import Reconstruction, RunControl
from recon.base.method import Method
from recon.base.view_data import Views

_CONNECT_TIMEOUT = 30  # s to wait for a scheduler, and for its first worker
_PATIENCE = 60.0  # s to wait if all workers have left
LOOK_EVERY = 2.0  # s between two checks for a worker
_TASK_SIZE_WARNING = "1 TB"  # task size above which distributed warns; a slab is sent as one task
_SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # so that modules in the current folder are not imported


class WorkersLostError(BeamlineError):
    """A slab was lost with its workers."""

    exit_code = 5


@dataclass(frozen=True)
class Cluster:
    """Workers that reconstruct slabs. If a worker is lost, another one repeats its work.

    Attributes:
        patience: time in s without any worker after which the reconstruction stops.
    """

    workers: int
    client: Client
    patience: float = _PATIENCE

    def reconstruct(
        self,
        views: Views,
        method: Method,
        *,
        control: RunControl,
        **settings: Any,
    ) -> Reconstruction:
        """Reconstruct on a worker with as many threads as this process has. Progress and stop are not supported.

        Raises:
            WorkersLostError: several workers with this slab were lost, or all workers, or the scheduler.
        """
        import numba  # imported here, because beamline loads numba after recon's compiled kernels

        work = (replace(views, data=np.array(views.data)), method, settings, control.decide)
        future = self.client.submit(_reconstruct, work, numba.get_num_threads(), pure=False)
        try:
            self._wait_for(future)
            result: Reconstruction = future.result()
        except (KilledWorker, CancelledError) as error:
            raise WorkersLostError(
                f"Either the scheduler was lost, or several workers that computed the same slab were lost ({error}). "
                f"The workers may have too little memory: give a smaller --memory, or fewer workers. Finished slabs "
                f"are kept: continue with --resume."
            ) from error
        return result

    def _wait_for(self, future: Future) -> None:
        """Wait until the work is done. Raises WorkersLostError if there is no worker for `patience` s."""
        look, alone, done = min(LOOK_EVERY, self.patience), 0.0, Event()
        # Do not use result(look): its TimeoutErrors form cycles with their frames, which keep the partial volume alive.
        future.add_done_callback(lambda _: done.set())
        while not (done.wait(look) or future.done()):
            alone = 0.0 if _count(self.client) else alone + look
            if alone >= self.patience:
                raise WorkersLostError(
                    "Start workers again and continue with --resume: all workers have left, and no worker came for "
                    f"{self.patience:g} s. Finished slabs are kept."
                )


def _count(client: Client) -> int:
    try:
        return len(client.scheduler_info(n_workers=-1)["workers"])
    except OSError:  # the scheduler does not answer
        return 0


def _reconstruct(work: tuple[Any, ...], threads: int) -> Reconstruction:
    """Reconstruct, on a worker. The same number of threads gives bit-identical results."""
    import numba

    views, method, settings, decide = work
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    result = recon.reconstruct(views, method=method, control=RunControl(decide=decide), **settings)
    return replace(result, gaussians=None, checkpoint=None, settings=dict(result.settings))


@contextmanager
def connected(spec: str, first_worker_s: float = _CONNECT_TIMEOUT) -> Iterator[Cluster]:
    """Connect to the cluster that `spec` names. Workers on this machine end with the block.

    Args:
        spec: `local:N` for N workers on this machine, or `tcp://HOST:PORT` of a scheduler.
        first_worker_s: s to wait for the first worker.

    Raises:
        ConfigError: no scheduler answers, no worker comes in time, or a worker has another version of splatline.
    """
    with ExitStack() as closing:
        closing.enter_context(dask.config.set({"distributed.admin.large-graph-warning-threshold": _TASK_SIZE_WARNING}))
        address: Any = spec
        try:
            if spec.startswith("local:"):
                os.environ.update(_SAFE_PATH)  # for the helper process of multiprocessing, too
                # Without a status page, and without a memory limit of dask: --memory limits a slab.
                address = LocalCluster(
                    n_workers=int(spec.removeprefix("local:")),
                    threads_per_worker=1,
                    dashboard_address=None,
                    memory_limit=0,
                    silence_logs=logging.ERROR,
                )
                closing.enter_context(address)
            client = closing.enter_context(Client(address, timeout=_CONNECT_TIMEOUT, set_as_default=False))
        except (OSError, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"Check the address --cluster {spec}, and whether the scheduler runs: no scheduler answers "
                f"({' '.join(str(error).split())}). Nothing was read."
            ) from error
        try:
            client.wait_for_workers(1, first_worker_s)
        except TimeoutError:
            raise ConfigError(
                f"Start workers with dask worker {spec}: the scheduler of --cluster has no workers, and no worker "
                f"came in {first_worker_s:g} s."
            ) from None
        _require_same_version(client, spec)
        yield Cluster(max(1, _count(client)), client)


def _require_same_version(client: Client, spec: str) -> None:
    """Raise ConfigError if a worker does not have this package, or has another version of splatline."""
    # Run a function of Python, because a worker without this package has none of ours.
    versions = client.run(resolve_name, "splatline_cluster:recon.__version__", on_error="return")
    others = {worker: there for worker, there in versions.items() if there != recon.__version__}
    for worker, there in others.items():
        lacks = isinstance(there, Exception)
        what = f"splatline or splatline-cluster cannot be loaded ({there})" if lacks else f"splatline is {there}"
        raise ConfigError(
            f"--cluster {spec}: {len(others)} of {len(versions)} workers cannot be used: {what} at {worker}. Start the "
            f"workers where splatline {recon.__version__} and splatline-cluster are installed. Nothing was read."
        )
