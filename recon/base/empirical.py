"""Empirical constants: values that somebody found on data, and that change a volume or a choice.

All that choose and make a volume of `fbp`, `fista-tv`, `pnp-dct`, `r2` and `auto` stand here, by the question that they
answer. Each says what it is, and what is lost without it: dB of `r2` by default on 8 to 24 rows, where not said. "Cones"
are a teapot and a shell of 64³ voxels, "12 views" those of slabs, "by the noise" FISTA-TV where nothing is held out.
docs/choosing.md has the table; tests/bench/test_thresholds.py removes each again. What brings less than 0.2 dB on bone
and cement, which nothing was tuned on, and prevents no loss of 1 dB, has no place here.
"""

from __future__ import annotations

# Which views and rows judge a candidate? (recon.voxels.held_out)

ONE_IN = 8
"""One of so many views is held out. Without it nothing is chosen: the weight by the noise lost 2 dB on a texture."""

CANNOT_RESOLVE = 1.2
"""Pixels a voxel, from which on voxels cannot explain the edges of views. Without it: -10.0, -6.7 dB on cones."""

ALIKE = 0.03
"""Share of the least residual, within which the strongest prior is taken where voxels are so coarse. -0.5, -2.4 dB."""

OF_MATTER = 0.1
"""Share of the largest line integrals, above which rays of a cone judge. Without it: -0.6 dB on a teapot in a cone."""

ENOUGH_MATTER = 0.5
"""Share of the matter in the fullest rows that the middle of a cone must hold. Else air would judge."""

AIR = 0.03
"""Of the largest line integral: columns below see air, and no trial. Without it a tooth takes TOOTH."""

BESIDE_MATTER = 0.05
"""Of the width of the matter: air that trials see on either side, with the same gain as `AIR`."""

# How long is a trial, and what does it stand for? (recon.voxels.held_out, recon.voxels.pnp_dct, recon.splatting.finish)

TRIAL_SWEEPS = 16
"""Sweeps of total variation. After 8 a weight twice as heavy seems best: -0.8 to -2.9 dB on a teapot."""

TRIAL_STEPS = 15
"""Steps with patches. 35, as the method makes, choose the same within 0.1 dB, and take half as long again."""

TRIAL_THRESHOLD = 1.6
"""Threshold of patches over that of 35 steps, since so few prefer a higher one. Without it: -1.0 dB on fibres."""

FIRST_SHARE = 0.25
"""Of the steps of a trial fit, after which it is looked at first. Without it: 0.9 of 3 CPU s more on six rows."""

FAR = 10 ** (3 / 20)
"""Residual over that of voxels, beyond which such a fit ends. Winners of ten scans were at most 2.0 dB behind, others
3.6 or more. Without it: 0.7 of 3 CPU s more."""

