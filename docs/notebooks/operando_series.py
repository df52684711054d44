# %% [markdown]
# # A sample that changes: states of an operando series
#
# With this notebook you can scan a sample in several states as one queue, reconstruct each state, and plot a number of
# the sample against time. The instrument is simulated: in a matrix, a grain grows from state to state.
#
# A line that begins with `!` is a command. In a terminal you type it without the `!`. All files go into a new
# temporary folder.

# %%
import math
import os
import tempfile
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np

from beamline import api

os.chdir(tempfile.mkdtemp(prefix="series-"))

# %% [markdown]
# ## The states and the queue
#
# Each state is a scene for the simulated camera, and a line of the table `series.csv`. With a real instrument, the
# table needs no scenes, because the sample itself changes between the scans. If all states have the same settings, you
# need no table either: `scan.states` takes one scan of each at planned times ([operando](../operando.md)).

# %%
radii = 0.06, 0.08, 0.10, 0.12  # mm
rows = ["config,sample.name,simulation.scene"]
for state, radius in enumerate(radii):
    Path(f"state_{state}.yaml").write_text(
        f"""
phantom:
  kind: solids
  solids:
    - {{kind: cylinder, radius: 0.19, height: 0.3, attenuation: 1.5}}
    - {{kind: ellipsoid, semi_axes: [{radius}, {radius}, {radius}], attenuation: 3.0, centre: [0.03, 0.02, 0.0]}}
beam: {{photons_per_s: 1.0e+5}}
effects: [pixel_area, photon_noise, read_noise, offset]
""",
        encoding="utf-8",
    )
    rows.append(f"my.yaml,state_{state},state_{state}.yaml")
Path("series.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")

# !beamline config init > my.yaml

# %% [markdown]
# A virtual clock scans as fast as the computer can. `--dry-run` plans the whole queue and starts nothing: whether each
# scan can run, and how long it takes.

# %%
small = "--set devices.camera.roi=[1120,2000,64,96] --set scan.angles.views=60 --set scan.period_s=0.3"
queue = f"beamline scan series.csv --no-live --set simulation.clock=virtual {small}"
# !{queue} --dry-run

# %%
# !{queue}

# %% [markdown]
# ## A number of each state
#
# The virtual clock begins at the same time in each scan, so the notebook puts the states 60 s apart. With a real clock,
# `entry/frame_log/time` alone is the time.
#
# The volume of the grain is the number of voxels above the middle between matrix and grain, times the volume of a
# voxel. Two limits, a tenth of the contrast lower and higher, show how much the number depends on the threshold.

# %%
times, volumes, slices = [], [], []
for state, run in enumerate(sorted(Path("runs").iterdir())):
    result = api.reconstruct(run, "fbp", say=None)
    edge, data = result.volume.grid.voxel_size, result.volume.data
    matrix, grain = 1.5, 4.5  # 1/mm; for your own sample, the peaks of the histogram
    limits = [matrix + share * (grain - matrix) for share in (0.4, 0.5, 0.6)]
    volumes.append([np.count_nonzero(data > limit) * edge**3 for limit in limits])
    slices.append(data[len(data) // 2])
    with h5py.File(run / "scan.h5") as file:
        taken = file["entry/frame_log/time"][()]  # s since 1970
    times.append(60 * state + taken.mean() - taken[0])
volumes = np.array(volumes)
result  # of the last state

# %% [markdown]
# ## The states side by side

# %%
drawn, axes = plt.subplots(1, len(slices), figsize=(11, 3), layout="constrained")
for axis, image, seconds in zip(axes, slices, times, strict=True):
    shown = axis.imshow(image, cmap="gray", vmin=0, vmax=4.8)
    axis.set(title=f"{seconds:.1f} s", xticks=(), yticks=())
drawn.colorbar(shown, ax=axes, label="attenuation (1/mm)")
# %% [markdown]
# ## The number against time
#
# The time of a state is the mean time of its frames. The error bars come from the two other limits. The true volume is
# known here, because the grain is a ball.

# %%
middle = volumes[:, 1]
bars = np.abs(volumes[:, [2, 0]].T - middle)
drawn, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
axis.errorbar(times, 1e3 * middle, 1e3 * bars, fmt="o-", capsize=3, label="measured")
axis.plot(times, [1e3 * 4 / 3 * math.pi * radius**3 for radius in radii], "kx", label="true")
axis.set(xlabel="time (s)", ylabel="volume of the grain (10⁻³ mm³)")
axis.legend()
for seconds, value, radius in zip(times, middle, radii, strict=True):
    print(f"{seconds:6.1f} s  {1e3 * value:.3f} of {1e3 * 4 / 3 * math.pi * radius**3:.3f} x 10⁻³ mm³")

# %% [markdown]
# [Microstructure](../structure.md) measures sizes, surfaces and contacts of many particles, each with an interval.
# [A sample that changes](../energies.md#a-sample-that-changes-while-it-is-scanned) within a scan has its own methods.
