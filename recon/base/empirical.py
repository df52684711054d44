"""Empirical constants: values that were found on data, and that change a volume or the choice of a method.

This file has the constants of `fista-tv`, `os-sirt-tv`, `pnp-dct`, `r2` and `auto`, grouped by the question that they
answer. Each docstring says what the constant is, and by how many dB the PSNR changes without it. Unless another method
is named, the change is that of `r2` with default settings on 8 to 24 rows of 50 projections.
tests/bench/test_thresholds.py removes most of the constants and prints the loss.

A constant belongs here only if it brings 0.2 dB or more on bone and cement (on which nothing was tuned), or prevents a
loss of 1 dB on any row of that benchmark. There are two exceptions: constants that save time, and constants whose
effect could not be measured; their docstrings say so.
"""

from __future__ import annotations

# Which projections, rows and rays decide between candidates?

ONE_IN = 8
"""One of this many projections is held out. Without held-out projections: -2 dB on a texture, because the weight of
total variation is then derived from the noise alone."""

ENOUGH_MATTER = 0.5
"""Candidates for a cone beam are compared on the middle rows only if these rows contain this share of the material in
the fullest rows. Without this rule, candidates would be compared on rows of air: +0.7 to -2.5 dB of `auto` on a shell
and a teapot whose middle is cut out."""

SHARPENED = 0.75
"""Voxels blur the volume more than pixels blur the projections; this is the share of the extra blur that the model
compensates. Without compensation: -0.5 and -0.9 dB of `pnp-dct` on bone and cement, +0.2 and -0.3 dB of FISTA-TV. With
full compensation: -0.2 and 0.0 dB, -0.3 and -0.3 dB (docs/numerics.md)."""

# How does the patch-based denoiser (PnP-DCT) work?

FIRST_THRESHOLD = 8.0
"""First threshold of the patches, in units of the noise of the volume. Without it: -0.3 dB of `pnp-dct` on bone, and
-0.4 dB on 12 projections, for which no other setting is better either."""

PULL = 0.03
"""Weight of the pull towards the denoised patches, as a share of the largest eigenvalue of AᵀWA. With ten times this
value: -1.3 dB on bone. With a tenth of it: -1.2 dB on cement."""

FALL = 0.8
"""Factor of the threshold from one round to the next. Without it: -0.3 and -0.8 dB on bone and cement."""

# How large is the weight of total variation if no projections are held out?

SHARE_OF_NOISE = 0.75
"""Factor on the weight that is derived from the noise of the first volume. Without it: -1.1 dB on bone and -2.4 dB on
cement, if no projections are held out."""

MOST_BY_RESIDUAL = 4.0
"""Largest factor by which the residual may raise the first weight. With a factor of one: -1.7 dB on bone and -1.9 dB on
cement from 180 projections of which none is held out, and -1.4 dB on a walnut."""

MANY_VIEWS = 0.3
"""If there are enough projections to determine the volume, the noise is assumed to be higher by this share. Without it:
-1.1 dB on bone and -1.4 dB on cement from 180 projections, if no projections are held out."""

HALF_OF_MANY = 0.45
"""Number of projections, in units of π / 2 times the number of columns, above which the share `MANY_VIEWS` begins to
apply. The share rises from 0 at this number to its full value at twice this number."""

SETTLED = 3 / 8
"""Share of the iterations after which the residual may raise the weight. If the weight may rise after 3 of 40
iterations of OS-SIRT-TV: -5.6 dB on cement in a cone beam."""

# When does total variation end?

STANDS_STILL = 0.005
"""The iterations end when four of them together change the volume by less than this share of its norm. With a fixed
number of 20 iterations, as in earlier versions: -1 to -3 dB of FISTA-TV on packed grains from 30 and 45 projections."""

STILL_IN_TRIAL = 0.01
"""The same share for a test reconstruction. A test reconstruction that starts from another one changes slowly and would
therefore end too early. Without this smaller share: -9 dB on cracks from 30 projections, because a thousandth of the
best weight is chosen."""

# Where are the first Gaussians, and how many are there?

VOXELS_A_GAUSSIAN = 60
"""Voxels per Gaussian in the cylinder of the field of view. With half as many Gaussians: -0.1 dB. With a quarter as
many: -0.5 dB."""

SPREAD = 0.6
"""Width of a first Gaussian, divided by the distance to its neighbours. Without this factor, the quality is the same,
but a fit takes a tenth to a fifth more CPU time, because each Gaussian covers more pixels."""

SMOOTHED = 1.0
"""Standard deviation, in voxels, by which the first volume is smoothed. Without smoothing, Gaussians are placed on the
streaks that few projections cause: -0.4 dB with 25 projections (Yuluo et al. 2025, GR-Gaussian)."""

WILD_PIXEL = 10.0
"""A pixel that exceeds the largest pixel of the other projections by this factor is not used at the start. Without this
rule, a single pixel with a line integral of 10⁶ costs a fit of 400 steps 24 dB, and one of 1000 costs 1.0 dB."""

WILD_VIEWS = 0.1
"""Largest share of the projections that may contain pixels above the limit `WILD_PIXEL`."""

EMPTY = 0.15
"""Edges of projections count as empty if they are below this share of the mean value. The air around a walnut has a
share of 0.07. Without this rule, no box would be wider than the field of view: -16 dB on grains that reach twice as far
as the field of view."""

LIGHT_WEIGHT = 1e-4
"""Weight of total variation, as `FistaTv.tv_weight`, in test reconstructions that measure the width of the sample. With
ten times this value, grains that reach 1.5 times as far as the field of view are measured as 2.5 times as far. With a
third of this value, or three times, the measured width is the same."""

# How is a fit made?

DEFAULT_STEPS = 400
"""Steps of a fit before its voxel refinement. A shell reaches 34.9 dB after 100 steps and 41.3 dB after 400."""

PACE = 26.0
"""Factor on the published learning rates, which are for 30 000 steps. Without it: -1 to -4 dB after 1000 steps."""

VIEWS_A_STEP = 2
"""Number of projections whose gradients are averaged in a step. With one projection: -1.7 dB on a teapot; from 12
projections, -1.3 dB on a shell and -0.8 dB on bone."""

NARROWEST = 0.3
"""Smallest standard deviation of a Gaussian in pixels. With the published value 0.128: -0.6 dB on a shell in a cone
beam."""

TV_OF_NOISE = 3e5
"""Weight of total variation, divided by the variance of the noise of a pixel, and multiplied by the number of pixels
that a Gaussian covers. With the published weight: from 12 projections, -2.2 dB on cement and -0.8 dB on bone; -0.5 dB
on a teapot in a cone beam."""

TV_LEAST = 0.02
"""Smallest weight of total variation. Without it: -0.7 dB on a shell in a cone."""

TV_MOST = 0.25
"""Largest weight of total variation. Without it: -1.1 dB on a foam from 12 projections."""

TV_CHANGE = 0.16
"""Change of the density from voxel to voxel, as a share of the density unit, above which a sample gets less total
variation. Without this rule: -0.5 dB on a teapot in a cone beam, -0.2 dB on a shell from 12 projections."""

TV_SHARE = 4
"""Side of the grid, divided by the side of the box in which a step computes total variation. In a smaller box, each
voxel would be changed rarely and by large steps. With the published box: -1.8 dB on a battery of 256³ voxels."""

APART = 0.75
"""Distance of each half of a split Gaussian from the centre of the split one, in standard deviations. With the
published split, in fits during a scan: -12.9 dB on a shell and -10.8 dB on a teapot."""

LOST = 3.0
"""A Gaussian this many standard deviations outside the box is removed. Without this rule, in fits during a scan: -4.0
dB on a shell, -3.6 dB on a teapot and -1.2 dB on a foam."""

GROWTH = 1.5
"""Largest number of Gaussians, as a multiple of their number at the start. With the published value 10: -1.9 dB on a
shell and a teapot in a cone beam after 400 steps."""

# How is a fit refined?

WILD_RAY = 0.5
"""A ray that differs from the fit by more than this share of the largest line integral gets weight 0. Without this
rule: -8.4 dB on a teapot if 2 of 10 000 pixels have wild values."""

FEW_WILD = 0.01
"""Largest share of the rays that the rule `WILD_RAY` may remove. If more rays differ, the fit has failed, and all rays
count."""
