"""Streaming: a volume that grows with each projection of a running or a finished scan. Writes streaming.png.

python streaming.py runs/NAME/scan.h5
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import recon
from beamline import api

path = sys.argv[1]
AXIS = 79.5  # column of the rotation axis; `beamline align` measures it
PIXEL = 0.0046  # mm
SNAPSHOTS = (30, 60, 120)  # projections

frames = {"DARK": [], "FLAT": [], "PROJECTION": []}
references, fit, drawn = None, None, []
for frame in api.stream(path):  # waits for the next frame while the scan runs
    frames.setdefault(frame.kind.name, []).append(frame.counts)
    if frame.kind.name != "PROJECTION":
        continue
    if fit is None:
        references = recon.References(np.array(frames["DARK"]), ((0.0, np.array(frames["FLAT"])),))
        fit = recon.StreamingFit(recon.Geometry.parallel([0.0], frame.counts.shape, pixel_pitch=PIXEL, axis_col=AXIS))
    line_integrals = recon.correct(frame.counts[None], [frame.index], references).data
    fit.add_views(line_integrals, [frame.angle])
    at = fit.advance(0.02)  # s; a fit that is too slow falls behind, and does not slow the scan down
    if at.n_views in SNAPSHOTS:
        drawn.append((at.n_views, fit.snapshot().data))
        print(f"{at.n_views:>4} views, {at.n_gaussians:>6} Gaussians; new views differ by {fit.unlearnt:.1%}")
at = fit.finish(1.0)
drawn.append(("finished", fit.snapshot().data))
print(f"finished: {at.n_gaussians} Gaussians, residual {at.residual:.4f}")

figure, axes = plt.subplots(1, len(drawn), figsize=(12, 2.8), layout="constrained")
for axis, (views, volume) in zip(axes, drawn, strict=True):
    axis.imshow(volume[len(volume) // 2], cmap="gray", vmin=0, vmax=np.percentile(drawn[-1][1], 99.9))
    axis.set(title=views if views == "finished" else f"{views} views", xticks=(), yticks=())
figure.savefig("streaming.png", dpi=80)
