"""Empirical constants: values that somebody found on data, and that change a volume or a choice.

Those that choose and make a volume of `fista-tv`, `os-sirt-tv`, `pnp-dct`, `r2` and `auto` stand here, by the question
that they answer. Each says what it is and what is lost without it: dB of `r2` by default on 8 to 24 rows of 50 views,
where nothing else is said. "By the noise" is FISTA-TV where no views are held out. tests/bench/test_thresholds.py
removes most of them and prints what that costs. What brings less than 0.2 dB on bone and cement, on which nothing was
tuned, and prevents no loss of 1 dB on any row, has no place here, unless it saves time, or could not be measured and
says so.
"""

from __future__ import annotations

# Which views, rows and rays judge a candidate?

ONE_IN = 8
"""One of so many views is held out. Without views held out: -2 dB on a texture, whose weight follows the noise."""

ENOUGH_MATTER = 0.5
"""Of the matter in the fullest rows, that the middle of a cone must hold. Without: air would judge; +0.7 to -2.5 dB of
`auto` on a shell and a teapot whose middle is cut out."""

SHARPENED = 0.75
"""Of what voxels are blurrier than views, that the model makes up for. Without: -0.5, -0.9 dB of `pnp-dct` on bone and
cement, +0.2, -0.3 of FISTA-TV; with all of it -0.2, 0.0 and -0.3, -0.3 (docs/numerics.md)."""

# How do patches work?

FIRST_THRESHOLD = 8.0
"""Times the noise of a volume. Without: -0.4 dB of `pnp-dct` on 12 views, which prefer nothing; -0.3 on bone."""

PULL = 0.03
"""Of the largest eigenvalue of AᵀWA, towards sparse patches. Without, at ten times: -1.3 dB on bone; at a tenth:
-1.2 dB on cement."""

FALL = 0.8
"""Of the threshold, from round to round. Without: -0.3, -0.8 dB on bone and cement."""

# How heavy is total variation where no views are held out?

SHARE_OF_NOISE = 0.75
"""Of the weight by the noise of the first volume. Without: -1.1, -2.4 dB by the noise on bone and cement."""

MOST_BY_RESIDUAL = 4.0
"""Times the first weight, at most, by what the residual shows. Without, at one: -1.7, -1.9 dB by the noise on bone and
cement of 180 views, -1.4 dB on a walnut."""

MANY_VIEWS = 0.3
"""More noise, where views determine a volume. Without: -1.1, -1.4 dB by the noise on bone and cement of 180 views."""

HALF_OF_MANY = 0.45
"""Of π / 2 views a column: from here to twice as many that rises from 0. It belongs to `MANY_VIEWS`."""

SETTLED = 3 / 8
"""Of the sweeps, before the residual may make the weight heavier. Without, after 3 of 40 of OS-SIRT-TV: -5.6 dB on
cement in a cone."""

# When does total variation end?

LEAST_OF_SUBSET = 15
"""Views of a subset at least, since fewer disagree on the step, of at most three subsets. Without: one subset of 30
views needs half as many sweeps more."""

SWEEPS_OF_VIEWS = 540
"""Views projected in sweeps on subsets before each step is from all views: 18 sweeps of 30 views, 6 of 90. Without:
sweeps on subsets alone end up to 0.5 dB beyond or before the end on packed grains of 30 and 45 views."""

STANDS_STILL = 0.005
"""Of the norm of a volume: sweeps end where four of them change it by less. Without: -1 to -3 dB of FISTA-TV after the
20 sweeps of before, on packed grains of 30 and 45 views."""

STILL_IN_TRIAL = 0.01
"""The same of a trial, whose volumes are compared at the same share. Without, as where volumes begin with another one
of the trial and stand still too early: -9 dB on cracks of 30 views, by a weight of a thousandth of the best one."""

# Where do the first Gaussians lie, and how many are there?

VOXELS_A_GAUSSIAN = 60
"""In the cylinder of the field. Without, with half and a quarter as many: -0.1, -0.5 dB."""

SPREAD = 0.6
"""Width of a first Gaussian over the distance to its neighbours. Without: level, and a tenth to a fifth more CPU time,
since each covers more pixels."""

SMOOTHED = 1.0
"""Voxels, by which the first volume is smoothed. Without: streaks of few views attract Gaussians, -0.4 dB with 25
views (Yuluo et al. 2025, GR-Gaussian)."""

WILD_PIXEL = 10.0
"""Times the largest pixel of other views: such a pixel has no part in the start. Without: one of 10⁶ costs a fit of
400 steps 24 dB, one of 1000 1.0 dB."""

WILD_VIEWS = 0.1
"""Of the views, which may hold such pixels. It belongs to `WILD_PIXEL`."""

EMPTY = 0.15
"""Of a mean value: edges below are empty, as the air of a walnut with 0.07. Without: no box is wider than the field,
-16 dB on grains that reach twice as far."""

LIGHT_WEIGHT = 1e-4
"""Of total variation, as `FistaTv.tv_weight`, in trials of how far a sample reaches. Without, at ten times: grains that
reach 1.5 times as far as the field are taken for 2.5; at a third and at three times the same radii."""

# How is a fit made?

DEFAULT_STEPS = 400
"""Of a fit before its finish. Without: a shell has 34.9 dB after 100, 41.3 after 400."""

PACE = 26.0
"""Times the published rates, which are for 30 000 steps. Without: -1 to -4 dB after 1000 steps."""

VIEWS_A_STEP = 2
"""Averaged in a gradient. Without: -1.7 dB on a teapot, -1.3 and -0.8 dB on a shell and bone of 12 views."""

NARROWEST = 0.3
"""Pixels of a Gaussian's least standard deviation. Without, at the published 0.128: -0.6 dB on a shell in a cone."""

TV_OF_NOISE = 3e5
"""Weight of total variation over the variance of a pixel's noise, and times a Gaussian's pixels. Without, at the
published weight: -2.2, -0.8 dB on cement and bone of 12 views, -0.5 dB on a teapot in a cone."""

TV_LEAST = 0.02
"""The weight, at least. Without: -0.7 dB on a shell in a cone."""

TV_MOST = 0.25
"""The weight, at most. Without: -1.1 dB on a foam of 12 views."""

TV_CHANGE = 0.16
"""Of the density unit a voxel: matter that changes by more needs less of it. Without: -0.5 dB on a teapot in a cone,
-0.2 dB on a shell of 12 views."""

TV_SHARE = 4
"""Sides of the box of total variation in the grid's: in a smaller one, places see it in rare kicks. Without, in the
published one: -1.8 dB on a battery of 256³ voxels."""

APART = 0.75
"""Standard deviations of each half of a split from the centre. Without, by the published split: -12.9, -10.8 dB in
streams of a shell and a teapot."""

LOST = 3.0
"""Standard deviations beyond the box, where a Gaussian is removed. Without: -4.0, -3.6, -1.2 dB in streams of a shell,
a teapot and a foam."""

GROWTH = 1.5
"""Times the first number of Gaussians, at most. Without, at the published 10: -1.9 dB on a shell and a teapot in a cone
at 400 steps."""

# How is a fit refined?

WILD_RAY = 0.5
"""Of the largest line integral: a ray that differs so much from the fit has no weight. Without: -8.4 dB on a teapot
with 2 in 10 000 wild pixels."""

FEW_WILD = 0.01
"""Of the rays: where more are wild, the fit has failed, and all count. It belongs to `WILD_RAY`."""
