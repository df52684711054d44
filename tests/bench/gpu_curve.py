"""Accuracy against seconds on a CUDA device, on cones of the published protocol:

python -m tests.bench.gpu_curve DATA teapot:75 "published 3000" "ours 1600 0" ours auto fista-tv "naf 3000"

A row is `published STEPS`, `ours [STEPS [ITERATIONS]]`, or another method that runs on the device, `METHOD [STEPS]`.
DATA is the folder of the volumes. Each row is run once with few steps before it is measured, so that its time contains
no compilation. PROFILE=1 prints a profile of the host.
"""

from __future__ import annotations

import cProfile
import os
import pstats
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import recon
from recon.assess.metrics import psnr
from recon.features.published.r2_published import R2Published
from recon.methods import by_name
from tests.bench.quality_cases import Case, cone, seen_by_simulator


def method_of(words: list[str]) -> recon.Method:
    kinds: dict[str, type[recon.Method]] = {"published": R2Published, "ours": recon.R2, "auto": recon.Auto}
    kind = kinds.get(words[0]) or by_name(words[0])
    return kind(**dict(zip(("steps", "finish"), map(int, words[1:]), strict=False)))


def row(case: Case, label: str, method: recon.Method) -> str:
    torch.cuda.reset_peak_memory_stats()
    torch.cuda.synchronize()
    begin, cpu = time.perf_counter(), time.process_time()
    made = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid, device="cuda")
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    memory = torch.cuda.max_memory_allocated() / 2**30
    quality = psnr(case.truth, np.maximum(made.volume.data, 0), case.peak)
    size = f"{made.settings.get('steps', 0):>6} steps {made.settings.get('gaussians', 0):>7} Gaussians"
    return (
        f"{case.name:8} {case.geometry.n_views:3} views  {label:20} {size} {quality:6.2f} dB {wall:7.2f} s "
        f"({cpu:.1f} CPU s) {memory:.2f} GB"
    )


def main(folder: Path, scan: str, labels: list[str]) -> None:
    name, views = scan.split(":")
    case = cone(folder, name, int(views), 256, seen_by_simulator)
    print(torch.cuda.get_device_name(), torch.__version__, flush=True)
    for label in labels:
        method = method_of(label.split())
        few = replace(method, steps=3) if getattr(method, "steps", None) else method
        row(case, label, few)
        if os.environ.get("PROFILE"):
            with cProfile.Profile() as profile:
                print(row(case, label, method), flush=True)
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)
        else:
            print(row(case, label, method), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
