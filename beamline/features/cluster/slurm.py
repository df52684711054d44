"""Slurm: jobs whose workers reconstruct slabs, by dask-jobqueue."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator, Field, PositiveFloat, PositiveInt, ValidationError

from beamline.config.section import Section
from beamline.core.errors import ConfigError
from beamline.core.files import SETTINGS, YAML_FAULTS, text_in
from beamline.core.process import SAFE_PATH

_NAME = "slurm"


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
