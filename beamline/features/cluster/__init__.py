"""Workers on this machine or on a cluster that reconstruct slabs (dask.distributed, Slurm)."""

from __future__ import annotations

WORKERS = {"cluster": "beamline.features.cluster.cluster"}
