"""Empirical constants: values that were found on data, and that change a volume or the choice of a method.

The constants that choose and make a volume of `fista-tv`, `os-sirt-tv`, `pnp-dct`, `r2` and `auto` are in this file,
grouped by the question that they answer. Each docstring says what the constant is and what is lost without it: the
change of PSNR in dB. Unless another method is named, it is the change of `r2` with default settings on 8 to 24 rows of
50 projections. tests/bench/test_thresholds.py removes most of the constants and prints the loss.

A constant belongs here only if it brings 0.2 dB or more on bone and cement (on which nothing was tuned), or prevents a
loss of 1 dB on any row of that benchmark. Exceptions save time, or could not be measured and say so.
"""

from __future__ import annotations

# Which projections, rows and rays decide between candidates?

ONE_IN = 8
"""One in this many projections is held out. Without held-out projections: -2 dB on a texture, because the weight of
total variation then follows the noise."""

ENOUGH_MATTER = 0.5
"""The middle rows of a cone judge a candidate only if they contain this share of the material in the fullest rows.
Without it, air would judge: +0.7 to -2.5 dB of `auto` on a shell and a teapot whose middle is cut out."""

SHARPENED = 0.75
"""Share of the extra blur of voxels (compared with projections) that the model compensates. Without compensation: -0.5
and -0.9 dB of `pnp-dct` on bone and cement, +0.2 and -0.3 dB of FISTA-TV. With full compensation: -0.2 and 0.0 dB, -0.3
and -0.3 dB (docs/numerics.md)."""

# How does the patch-based denoiser (PnP-DCT) work?

FIRST_THRESHOLD = 8.0
"""First threshold of the patches, in units of the noise of the volume. Without it: -0.4 dB of `pnp-dct` on 12
projections, for which no setting is better; -0.3 dB on bone."""

PULL = 0.03
"""Weight of the pull towards the denoised patches, as a share of the largest eigenvalue of AᵀWA. Without it, at ten
times this value: -1.3 dB on bone; at a tenth: -1.2 dB on cement."""

FALL = 0.8
"""Factor of the threshold from one round to the next. Without it: -0.3 and -0.8 dB on bone and cement."""

# How large is the weight of total variation if no projections are held out?

SHARE_OF_NOISE = 0.75
"""Factor on the weight that follows from the noise of the first volume. Without it: -1.1 and -2.4 dB on bone and
cement, if no projections are held out."""

MOST_BY_RESIDUAL = 4.0
"""Largest factor by which the residual may raise the first weight. Without it, with a factor of one: -1.7 and -1.9 dB
on bone and cement from 180 projections without held-out ones, -1.4 dB on a walnut."""

MANY_VIEWS = 0.3
"""Share by which the noise is assumed higher if the projections determine the volume. Without it: -1.1 and -1.4 dB on
bone and cement from 180 projections, if no projections are held out."""

HALF_OF_MANY = 0.45
"""It belongs to `MANY_VIEWS`: the number of projections, in units of π / 2 times the number of columns, from which that
value rises from 0. At twice this number it is reached in full."""

SETTLED = 3 / 8
"""Share of the iterations after which the residual may raise the weight. Without it, after 3 of 40 iterations of
OS-SIRT-TV: -5.6 dB on cement in a cone."""

# When does total variation end?

STANDS_STILL = 0.005
"""Share of the norm of a volume: the iterations end when four of them change the volume by less. Without it, after the
20 iterations of earlier versions: -1 to -3 dB of FISTA-TV on packed grains from 30 and 45 projections."""

STILL_IN_TRIAL = 0.01
"""The same for a test reconstruction. Without it, if a test reconstruction starts from another one and therefore stands
still too early: -9 dB on cracks from 30 projections, because a weight of a thousandth of the best one is chosen."""

# Where are the first Gaussians, and how many are there?

VOXELS_A_GAUSSIAN = 60
"""Voxels per Gaussian in the cylinder of the field of view. Without it, with half and a quarter as many Gaussians: -0.1
and -0.5 dB."""

SPREAD = 0.6
"""Width of a first Gaussian, divided by the distance to its neighbours. Without it: the same quality, and a tenth to a
fifth more CPU time, because each Gaussian covers more pixels."""

SMOOTHED = 1.0
"""Voxels by which the first volume is smoothed. Without it, Gaussians are placed on the streaks of few projections:
-0.4 dB with 25 projections (Yuluo et al. 2025, GR-Gaussian)."""

WILD_PIXEL = 10.0
"""A pixel that exceeds the largest pixel of the other projections by this factor is not used at the start. Without it,
one pixel of 10⁶ costs a fit of 400 steps 24 dB, one of 1000 costs 1.0 dB."""

WILD_VIEWS = 0.1
"""It belongs to `WILD_PIXEL`: the largest share of the projections that may contain such pixels."""

EMPTY = 0.15
"""Share of a mean value below which edges count as empty. The air around a walnut has 0.07. Without it, no box is wider
than the field of view: -16 dB on grains that reach twice as far."""

LIGHT_WEIGHT = 1e-4
"""Weight of total variation, as `FistaTv.tv_weight`, in test reconstructions that measure the width of the sample.
Without it, at ten times this value, grains that reach 1.5 times as far as the field of view are measured as 2.5 times;
at a third and at three times, the result is the same."""

# How is a fit made?

DEFAULT_STEPS = 400
"""Steps of a fit before its voxel refinement. Without it, after 100 steps, a shell has 34.9 dB; after 400 it has 41.3
dB."""

PACE = 26.0
"""Factor on the published learning rates, which are for 30 000 steps. Without it: -1 to -4 dB after 1000 steps."""

VIEWS_A_STEP = 2
"""Projections that are averaged in one gradient. Without it: -1.7 dB on a teapot, -1.3 and -0.8 dB on a shell and bone
from 12 projections."""

NARROWEST = 0.3
"""Smallest standard deviation of a Gaussian in pixels. Without it, with the published 0.128: -0.6 dB on a shell in a
cone."""

TV_OF_NOISE = 3e5
"""Weight of total variation, divided by the variance of a pixel's noise, times the pixels of a Gaussian. Without it,
with the published weight: -2.2 and -0.8 dB on cement and bone from 12 projections, -0.5 dB on a teapot in a cone."""

TV_LEAST = 0.02
"""Smallest weight of total variation. Without it: -0.7 dB on a shell in a cone."""

TV_MOST = 0.25
"""Largest weight of total variation. Without it: -1.1 dB on a foam from 12 projections."""

TV_CHANGE = 0.16
"""Change per voxel, as a share of the density unit; a sample that changes by more needs less total variation. Without
it: -0.5 dB on a teapot in a cone, -0.2 dB on a shell from 12 projections."""

TV_SHARE = 4
"""The sides of the box in which total variation is computed are the grid's divided by this. In a smaller box, each
position would get rare, large steps. Without it, with the published box: -1.8 dB on a battery of 256³ voxels."""

APART = 0.75
"""Distance of each half of a split Gaussian from the centre, in standard deviations. Without it, with the published
split: -12.9 and -10.8 dB in fits during a scan of a shell and a teapot."""

LOST = 3.0
"""A Gaussian this many standard deviations outside the box is removed. Without it: -4.0, -3.6 and -1.2 dB in fits
during a scan of a shell, a teapot and a foam."""

GROWTH = 1.5
"""Largest number of Gaussians, as a multiple of the first number. Without it, with the published 10: -1.9 dB on a shell
and a teapot in a cone after 400 steps."""

# How is a fit refined?

WILD_RAY = 0.5
"""A ray that differs from the fit by more than this share of the largest line integral gets weight 0. Without it: -8.4
dB on a teapot with 2 wild pixels in 10 000."""

FEW_WILD = 0.01
"""It belongs to `WILD_RAY`: if more than this share of the rays is wild, the fit has failed, and all rays count."""
