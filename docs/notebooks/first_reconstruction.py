# %% [markdown]
# # From a scan file to a volume with error bars
#
# With this notebook you can reconstruct a scan file, look at a slice and a histogram, read the report, and see how far
# each voxel can be trusted. The notebook simulates its own scan, so you know the true sample.
#
# A line that begins with `!` is a command. In a terminal you type it without the `!`. All files go into a new
# temporary folder.

# %%
import html
import os
import tempfile
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML

from beamline import api

os.chdir(tempfile.mkdtemp(prefix="first-"))

# %% [markdown]
# ## The scan file
#
# The scene `plain` is a tube with a sphere and a box in it. The scan has 90 projections of 36 x 96 pixels, with the
# noise of the photons and of the camera. `truth.h5` holds the true attenuation of each voxel.

# %%
scene = "--frames 90 --set detector.shape=[36,96] --set detector.pixel_size_um=7.7"
effects = "--set effects=[pixel_area,photon_noise,read_noise,offset]"
# !beamline simulate plain -o scan.h5 --truth truth.h5 {scene} {effects}

# %% [markdown]
# `beamline info` says what is in a scan file, and what is missing for a reconstruction. Here nothing is missing.

# %%
# !beamline info scan.h5

# %% [markdown]
# ## The volume
#
# `--uncertainty` also computes the standard deviation of each voxel. `--truth` compares the volume with the true
# sample, which you do not have for your own scan. The table at the end compares the method with filtered
# back-projection (FBP).

# %%
# !beamline recon scan.h5 -o volume.h5 --method fista-tv --uncertainty --truth truth.h5

# %% [markdown]
# `beamline.api.reconstruct` does the same from Python and returns the record of the volume. A record at the end of a
# cell shows the middle slices and the figures of merit. Here the method is FBP, which takes less than a second.

# %%
fbp = api.reconstruct("scan.h5", "fbp", say=None)
fbp

# %% [markdown]
# ## A slice
#
# The voxels are in `entry/data/data` of the file, [z, y, x], in 1/mm.

# %%
with h5py.File("volume.h5") as file:
    volume = file["entry/data/data"][()]
    deviation = file["entry/data/data_errors"][()]
with h5py.File("truth.h5") as file:
    truth = file["entry/data/data"][()]

middle = len(volume) // 2
drawn, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for axis, (name, image) in zip(axes, {"FISTA-TV": volume, "FBP": fbp.volume.data, "true": truth}.items(), strict=True):
    shown = axis.imshow(image[middle], cmap="gray", vmin=0, vmax=truth.max())
    axis.set(title=name, xlabel="x (voxels)", ylabel="y (voxels)")
drawn.colorbar(shown, ax=axes, label="attenuation (1/mm)")
# %% [markdown]
# ## A histogram
#
# Each material is a peak. The narrower the peaks, the fewer voxels a threshold between two materials puts on the wrong
# side. Voxels at edges contain two materials, and fill the range between the peaks.

# %%
drawn, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for name, values in {"FISTA-TV": volume, "FBP": fbp.volume.data}.items():
    axis.hist(values.ravel(), bins=200, range=(-0.5, 5.5), histtype="step", label=name)
axis.set(xlabel="attenuation (1/mm)", ylabel="voxels", yscale="log")
axis.legend()
# %% [markdown]
# ## The report
#
# `beamline recon` wrote a report next to the volume, with pictures, figures of merit and all settings. You can open
# `volume.html` in a browser, or show it here:

# %%
page = html.escape(Path("volume.html").read_text(encoding="utf-8"))
HTML(f'<iframe srcdoc="{page}" width="100%" height="500"></iframe>')

# %% [markdown]
# ## Error bars
#
# In about two of three voxels, the true value should lie within one standard deviation of the volume. You can check it
# here, because you know the true sample.

# %%
within = np.abs(volume - truth)[truth > 0] < deviation[truth > 0]
print(f"{within.mean():.0%} of the voxels of the sample are within one standard deviation of the true value")

line = middle, 48
columns = np.arange(truth.shape[2])
drawn, axis = plt.subplots(figsize=(8, 3), layout="constrained")
low, high = volume[line] - deviation[line], volume[line] + deviation[line]
axis.fill_between(columns, low, high, alpha=0.3, label="one standard deviation")
axis.plot(columns, volume[line], label="FISTA-TV")
axis.plot(columns, truth[line], "k:", label="true")
axis.set(xlabel="x (voxels)", ylabel="attenuation (1/mm)")
axis.legend()
plt.show()

# %% [markdown]
# More than two thirds are within it, so these error bars are wider than necessary: the sample is even over large
# parts, where the method leaves less noise than the error bars allow for. [Error bars](../error_bars.md) lists the
# samples for which they are too wide or too narrow.
