"""First reconstruction: scan, check, reconstruct, look. Writes first_reconstruction.png.

python first_reconstruction.py my.yaml
"""

import sys

import matplotlib.pyplot as plt

import recon
from beamline import api

config = sys.argv[1]

# A tenth of the rows and a quarter of the projections: enough to see whether everything works.
few = {"scan.angles.views": 90, "scan.period_s": 0.4, "devices.camera.roi": [1144, 1968, 16, 160]}
scan = api.scan(config, set=few, live=False, say=None)
print(f"{scan.frames} frames, {scan.status}; {scan.alarms} with an alarm")

result = api.reconstruct(scan.path, recon.Fbp(), say=None)
volume = result.volume.data  # float32 [z, y, x]
print(f"{result.method}: {' x '.join(map(str, volume.shape))} voxels, attenuation in {result.units}")
print(f"rotation axis at column {result.axis_col:.2f} of the detector")
snr, residual = result.figures["snr"], result.figures["residual"]
print(f"signal-to-noise ratio {snr:.1f}, residual of the projections {residual:.0%}")

view = next(frame for frame in api.stream(scan.path) if frame.kind.name == "PROJECTION")
drawn, (left, right) = plt.subplots(1, 2, figsize=(8, 4), width_ratios=(1, 1.1), layout="constrained")
left.imshow(view.counts, cmap="gray", aspect="auto")
left.set(title="first view, counts", xlabel="column", ylabel="row")
shown = right.imshow(volume[len(volume) // 2], cmap="gray", vmin=0)
right.set(title="middle slice", xlabel="x (voxels)", ylabel="y (voxels)")
drawn.colorbar(shown, ax=right, label=result.units)
drawn.savefig("first_reconstruction.png", dpi=80)
