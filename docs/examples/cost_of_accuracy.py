"""What accuracy costs: fewer projections and other methods, on a simulated scan. Writes cost_of_accuracy.png.

beamline simulate cathode --frames 120 --set detector.shape=[4,160] --out scan.h5 --truth truth.h5
python cost_of_accuracy.py scan.h5 truth.h5
"""

import sys

import h5py
import matplotlib.pyplot as plt

import recon
from beamline import api
from recon.assess.metrics import psnr

scan, truth_file = sys.argv[1:]
with h5py.File(truth_file) as file:
    truth = file["entry/data/data"][()]  # 1/mm

methods = {"FBP": recon.Fbp(), "CGLS": recon.Cgls(), "FISTA-TV": recon.FistaTv(iterations=10)}
views = (15, 30, 60)

drawn, axes = plt.subplots(1, len(methods) + 1, figsize=(12, 3.2), layout="constrained")
print(f"{'method':<14}{'views':>6}{'PSNR (dB)':>12}{'time (s)':>10}")
for (name, method), axis in zip(methods.items(), axes[1:], strict=True):
    quality = []
    for number in views:
        result = api.reconstruct(scan, method, views=f"fixed:{number}", say=None)
        quality.append(psnr(truth, result.volume.data))
        print(f"{name:<14}{number:>6}{quality[-1]:>12.1f}{result.figures['seconds']:>10.2f}")
        if number == 30:
            axis.imshow(result.volume.data[2], cmap="gray", vmin=0, vmax=truth.max())
            axis.set(title=f"{name}, 30 views", xticks=(), yticks=())
    axes[0].plot(views, quality, "o-", label=name)
axes[0].set(title="PSNR (dB)", xlabel="views", xscale="log", xticks=views, xticklabels=views)
axes[0].minorticks_off()
axes[0].legend()
drawn.savefig("cost_of_accuracy.png", dpi=80)
