# %% [markdown]
# # A scan that others wrote
#
# With this notebook you can reconstruct a scan of another program whose files lack something. `beamline info` says what
# is missing, and you state it with an option. The notebook makes two such scans itself: a folder of TIFFs without
# angles, and an NXtomo file without darks and flats.
#
# A line that begins with `!` is a command. In a terminal you type it without the `!`. All files go into a new
# temporary folder.

# %%
import os
import tempfile
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
import tifffile

from beamline import api

os.chdir(tempfile.mkdtemp(prefix="others-"))

# %%
scene = "--frames 90 --set detector.shape=[36,96] --set detector.pixel_size_um=7.7"
effects = "--set effects=[pixel_area,photon_noise,read_noise,offset]"
# !beamline simulate plain -o ours.h5 {scene} {effects}

# %% [markdown]
# The next cell writes the two scans. In the projections some columns answer 3 % more or less than the flats say. Such
# columns make stripes in sinograms, and rings in slices.

# %%
rng = np.random.default_rng(0)
gain = 1 + 0.03 * rng.normal(size=96) * (rng.random(96) < 0.2)
Path("tiffs").mkdir()
number = {"dark": 0, "flat": 0, "projection": 0}
for frame in api.stream("ours.h5", follow=False):
    kind = frame.kind.name.lower()
    counts = frame.counts * gain if kind == "projection" else frame.counts
    tifffile.imwrite(f"tiffs/{kind}_{number[kind]:04d}.tif", np.rint(counts).astype(np.uint16))
    number[kind] += 1

with h5py.File("ours.h5") as ours, h5py.File("theirs.nxs", "w") as theirs:
    views = ours["entry/data/image_key"][()] == 0
    entry, detector = theirs.create_group("entry"), theirs.create_group("entry/instrument/detector")
    entry.attrs["NX_class"], detector.attrs["NX_class"] = "NXentry", "NXdetector"
    theirs["entry/instrument"].attrs["NX_class"] = "NXinstrument"
    entry["definition"] = "NXtomo"
    detector["data"] = ours["entry/data/data"][()][views]
    detector["image_key"] = ours["entry/data/image_key"][()][views]
    entry["sample/rotation_angle"] = ours["entry/data/rotation_angle"][()][views]
    entry["sample"].attrs["NX_class"], entry["sample/rotation_angle"].attrs["units"] = "NXsample", "degree"
print(number)

# %% [markdown]
# ## The folder of TIFFs: what is missing
#
# Lines that begin with `!` in the output are problems. `reconstructable` is `no` until all of them are solved.

# %%
# !beamline info tiffs

# %% [markdown]
# ## What to say
#
# The names of the images tell darks, flats and projections apart. The angles, and that the pixel values are counts, are
# known only to the person who took the scan: 90 projections in equal steps over 180°. `--angles` reads a text file with
# one angle for each projection.

# %%
np.savetxt("angles.txt", np.linspace(0, 180, 90, endpoint=False), fmt="%.4f")
stated = "--quantity counts --angles angles.txt"
# !beamline info tiffs {stated}

# %% [markdown]
# ## The axis by picture
#
# `beamline recon` finds the rotation axis by itself. To see it, `beamline sweep` reconstructs one slice for each of
# several axes. A wrong axis turns points into crescents. The sheet names the axis whose slice predicts held-out
# projections best.

# %%
# !beamline sweep tiffs axis=43.5:51.5:2 {stated} -o axes

# %%
drawn, axis = plt.subplots(figsize=(10, 4), layout="constrained")
axis.imshow(plt.imread("axes/slices.png"))
axis.axis("off")
# %% [markdown]
# ## Rings
#
# `--rings vo` removes the stripes of single columns from the sinograms. The slices show the volume without it and with
# it. `--pixel-size-um` gives the attenuation in 1/mm; without it, the unit is 1/pixel.

# %%
stated += " --pixel-size-um 7.7 --axis 47.5 --method fbp --no-report"
# !beamline recon tiffs {stated} -o plain.h5
# !beamline recon tiffs {stated} -o smooth.h5 --rings vo

# %%
volumes = {}
for name in ("plain", "smooth"):
    with h5py.File(f"{name}.h5") as file:
        volumes[name] = file["entry/data/data"][()]
drawn, axes = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained")
for axis, name, rings in zip(axes, ("plain", "smooth"), ("none", "vo"), strict=True):
    shown = axis.imshow(volumes[name][18], cmap="gray", vmin=-0.5, vmax=3)
    axis.set(title=f"--rings {rings}", xlabel="x (voxels)", ylabel="y (voxels)")
drawn.colorbar(shown, ax=axes, label="attenuation (1/mm)")
# %% [markdown]
# ## The NXtomo file
#
# This file has the angles, but only projections. Here the darks and flats come from the other scan. `--darks` and
# `--flats` take images, folders, other HDF5 files, or one number of counts.

# %%
# !beamline info theirs.nxs

# %%
for kind in ("dark", "flat"):
    images = [tifffile.imread(path) for path in sorted(Path("tiffs").glob(f"{kind}*"))]
    tifffile.imwrite(f"{kind}s.tif", np.stack(images))
# !beamline info theirs.nxs --darks darks.tif --flats flats.tif

# %% [markdown]
# ## Export
#
# The suffix of the output sets the format. Without a suffix, `beamline export` writes a folder of TIFFs, one for each
# slice. `--bits 16` needs a window, because the values become whole numbers.

# %%
# !beamline export smooth.h5 -o slices
# !beamline export smooth.h5 -o grey.tif --bits 16 --window 0:5
grey = tifffile.imread("grey.tif")
print(f"{len(list(Path('slices').glob('*.tif')))} slices; grey.tif: {grey.dtype} {grey.shape}")
