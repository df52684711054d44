"""Checks a volume before its delivery: figures of merit, FBP beside it, and warnings of what it may hide or invent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Note, event_of_sentence
from beamline.core.text import count
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.measure import contrast_by, measure, regions, residual_share, residuals_along_rows
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.scan_facts import ReportContext, label_of
from beamline.storage.disk_file import scratch_array
from drivers.base.clock import Clock
from recon.base.method import SAMPLE, Reconstruction, SampleRadius
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE, by_name
from recon.splatting.gaussians import NEEDLES_LIMIT, needles
from recon.voxels import odd_views
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.field_edges import FieldEdges
from recon.voxels.matter_checks import (
    STRAY_LIMIT,
    UNEXPLAINED_LIMIT,
    StrayMass,
    Unexplained,
    lost_matter,
    stray_mass,
    stray_mass_share,
    unexplained,
)

_NAMED = 5  # odd views, at most
_COMPARED = ("fbp", "fista-tv")  # that show cracks, by edges and by flat parts


@dataclass(eq=False)
class CheckedVolume:
    """A volume with what its views and FBP say of it.

    Attributes:
        volumes: the volume and, where it is compared with one, FBP of the same views before it; by method.
        metrics: figures of merit of each, by method.
        warnings: those of the context first.
        skipped: checks for which there was no time.
        unexplained: what the volume leaves in the views; None where that is not known.
        stray: mass where views show nothing; None where it was not looked for.
        hiding_warning: the warning that the volume may hide structure; empty without one.
        seconds_of_views: to project all views, about.
    """

    made: Reconstruction
    prepared: PreparedProjections
    truth: Volume | None
    target: OutputPaths
    context: ReportContext
    clock: Clock
    volumes: dict[str, Volume] = field(init=False)
    metrics: dict[str, dict[str, float]] = field(default_factory=dict)
    warnings: list[str] = field(init=False)
    skipped: list[str] = field(default_factory=list)
    unexplained: Unexplained | None = None
    stray: StrayMass | None = None
    hiding_warning: str = ""
    seconds_of_views: float = 0.0

    def __post_init__(self) -> None:
        self.volumes, self.warnings = {self.made.method: self.made.volume}, list(self.context.warnings)

    @property
    def fitted(self) -> bool:
        """Whether the volume was fitted to the views. A direct one leaves the blur of its filter in them."""
        return not by_name(self.made.method).traits.direct

    @cached_property
    def views_show_more(self) -> bool:
        """Whether views show more than the volume: than a region, or than a field that does not hold all of the sample,
        where what lies beside it was not taken off."""
        geometry, data = self.prepared.geometry, self.prepared.projections.data
        if self.context.region is not None and self.made.volume.grid.shape != Grid.matching(geometry).shape:
            return True
        if self.fitted:
            return SAMPLE in self.made.settings and not self.prepared.inside
        return bool(FieldEdges.of(data, geometry).beyond())

    @property
    def skipped_text(self) -> str:
        """A sentence on the checks left out and the reason; empty if none was."""
        if not self.skipped:
            return ""
        stopped = self.made.ending.early
        why = "the reconstruction was stopped" if stopped else "the seconds asked for were nearly over"
        return f"Left out, as {why}: {', '.join(self.skipped)}."

    def figures_of(self, volume: Volume, seconds: float) -> dict[str, float]:
        """Figures of merit; without residuals where the views show more than the volume."""
        prepared = None if self.views_show_more else self.prepared
        return {**measure(volume, prepared, self.truth, self.context.phases.progress), "seconds": seconds}


class _Check(NamedTuple):
    """A check of a volume.

    Attributes:
        run: completes the figures, and returns a warning; empty: nothing speaks against the volume.
        concerns: whether it says anything of this volume.
        name: in the sentence on what was left out.
        projections: of all views that take as long, about; 0: it is always made.
    """

    run: Callable[[CheckedVolume], str]
    concerns: Callable[[CheckedVolume], bool] = lambda volume: True
    name: str = ""
    projections: Callable[[CheckedVolume], float] = lambda volume: 0.0


def check_volume(
    made: Reconstruction,
    prepared: PreparedProjections,
    truth: Volume | None,
    target: OutputPaths,
    context: ReportContext,
    sink: Sink,
    clock: Clock,
) -> CheckedVolume:
    """Compare a volume with its views and with FBP, and send each warning to `sink`.

    Checks that would take longer than `context` leaves, or that somebody waits for, are left out with a remark.
    """
    volume = CheckedVolume(made, prepared, truth, target, context, clock)
    if made.series is not None:  # each view shows a volume of its own time
        volume.metrics[made.method] = {"residual": made.series.residual, "seconds": made.seconds}
        return volume
    for check in _CHECKS:
        if not check.concerns(volume):
            continue
        work = check.projections(volume)
        if work and (made.ending.early or not context.leaves(work * volume.seconds_of_views)):
            volume.skipped.append(check.name)
            continue
        if sentence := check.run(volume):
            sink(event_of_sentence(sentence, clock.now()))
            volume.warnings.append(sentence)
    if volume.skipped_text:
        sink(StateEntered("left_out", volume.skipped_text, time=clock.now()))
    return volume


def _sample_radius(volume: CheckedVolume) -> str:
    """How far the sample reaches beside the field, and what that leaves open."""
    settings, prepared = volume.made.settings, volume.prepared
    radius, low, high, density = (settings[name] for name in SampleRadius(1, 1, 1, 1).settings)
    unit, reach = prepared.length_unit, prepared.geometry.reach
    known, sure = "as given", ""
    if density == 1:
        known = "assumed: there are too few views to measure it"
    elif low < high:
        known = f"{low:.4g} to {high:.4g} {unit} explain the views nearly as well"
        advice = "; wide views (scan.wide_views) reduce that" if prepared.geometry.ordinary.all() else ""
        sure = f" Densities near the axis are uncertain by {density:.1%} or more{advice}."
    return Note(
        f"The sample reaches {radius:.4g} {unit} from the rotation axis, {radius / reach:.2f} times as far as the "
        f"field ({known}). The whole sample was reconstructed; only the part within the field is written.{sure}"
    )


def _residual(volume: CheckedVolume) -> str:
    """The figures of merit, and whether the volume shows anything of the sample."""
    made, prepared, clock = volume.made, volume.prepared, volume.clock
    before = clock.now()
    figures = volume.metrics[made.method] = volume.figures_of(made.volume, made.seconds)
    share = residual_share(prepared.geometry, made.volume.grid, prepared.held_out)
    volume.seconds_of_views = (clock.now() - before) / share
    if not volume.fitted or "residual" not in figures:
        return ""
    return not_begun_warning(made, *residuals_along_rows(made.volume, prepared))


def not_begun_warning(made: Reconstruction, left: float, uniform: float) -> str:
    """The warning that a volume shows nothing of the sample yet; empty if it explains its views better than a
    volume of one density.

    Args:
        left, uniform: by the volume, and by a volume of one density; see `measure.residuals_along_rows`.
    """
    if left < uniform or uniform == 0:
        return ""
    last = made.history[-1] if made.history else None
    steps = f" after {last.step} of {last.steps} {last.unit or 'steps'}" if last is not None and last.steps else ""
    return (
        f"The {label_of(made.method)} volume shows nothing of the sample: it leaves {left:.3g} of the differences "
        f"along the rows of the views, where a volume of one density leaves {uniform:.3g}. The method ended in "
        f"{made.seconds:.3g} s{steps}: give it more seconds, steps or iterations."
    )


def _structure(volume: CheckedVolume) -> str:
    """Structure in the residual of the views."""
    made, prepared = volume.made, volume.prepared
    views, rng = prepared.projections.data, np.random.default_rng(volume.context.seed)
    volume.unexplained = unexplained(made.volume, views, prepared.geometry, rng, prepared.ray_factors())
    if volume.unexplained is None:
        return ""
    share = volume.metrics[made.method]["unexplained"] = volume.unexplained.share
    if share > UNEXPLAINED_LIMIT:
        others = " and ".join(name for name in _COMPARED if name != made.method)
        volume.hiding_warning = (
            f"{share:.1%} of the matter leaves structure in the residual of the views (at most {UNEXPLAINED_LIMIT:.1%} "
            f"is usual): the {label_of(made.method)} volume may hide cracks, pores or edges. Look at 'What the volume "
            f"leaves in the views' in the report, and compare with --method {others}."
        )
    return volume.hiding_warning


def _stray_mass(volume: CheckedVolume) -> str:
    """Mass where views show none."""
    made, prepared = volume.made, volume.prepared
    volume.stray = stray_mass(made.volume, prepared.projections.data, prepared.geometry, prepared.ray_factors())
    if volume.stray is None:
        return ""
    share = volume.metrics[made.method]["stray"] = volume.stray.share
    if share <= STRAY_LIMIT or not volume.fitted:
        return ""
    return (
        f"{share:.1%} of the mass of the {label_of(made.method)} volume is stray, where the views show nothing "
        f"(at most {STRAY_LIMIT:.0%} is usual). Look at 'Stray mass' in the report before you believe faint parts."
    )


def _needles(volume: CheckedVolume) -> str:
    """Gaussians of a model that are needle-shaped."""
    model = volume.made.gaussians
    share = needles(model, volume.prepared.geometry).share if model is not None and model.n else 0.0
    if share <= NEEDLES_LIMIT:
        return ""
    return (
        f"{share:.0%} of the mass of the model is in Gaussians thinner than a pixel and ten times as long (at "
        f"most {NEEDLES_LIMIT:.0%} is usual). They follow the noise of few views: compare with --method fista-tv."
    )


def _odd_views(volume: CheckedVolume) -> str:
    """Views with a part that the volume does not explain."""
    prepared, selection, progress = volume.prepared, volume.context.selection, volume.context.phases.progress
    views, factors = prepared.projections.data, prepared.ray_factors()
    odd = odd_views.odd_views(volume.made.volume, views, prepared.geometry, factors, progress=progress)
    if not odd:
        return ""
    return odd_views_warning(odd, prepared.projections.view_ids, (selection.rows or (0, 0))[0], selection.binning)


def odd_views_warning(odd: Sequence[odd_views.OddView], frames: NDArray[np.int64], first_row: int, binning: int) -> str:
    """The warning that names the worst of these views, by frames [view] and pixels of the file."""
    places = [
        f"frame {frames[each.view]}, rows {first_row + each.rows[0] * binning} ... "
        f"{first_row + each.rows[1] * binning - 1}, columns {each.cols[0] * binning} ... "
        f"{each.cols[1] * binning - 1} (absorbs {'more' if each.score > 0 else 'less'})"
        for each in sorted(odd, key=lambda each: -abs(each.score))[:_NAMED]
    ]
    more = f"; and {len(odd) - _NAMED} more" if len(odd) > _NAMED else ""
    return (
        f"{count(len(odd), 'view')} with a part that is not in the volume, by more than {odd_views.LIMIT:g} times "
        f"what is usual there: {'; '.join(places)}{more}. Something was in the beam, or the sample was elsewhere: look "
        "at these frames."
    )


def _fbp(volume: CheckedVolume) -> str:
    """Put FBP of the same views first among the volumes."""
    prepared, context, grid = volume.prepared, volume.context, volume.made.volume.grid
    context.phases.enter("FBP for comparison", "slices")
    before, on_disk = volume.clock.now(), isinstance(volume.made.volume.data, np.memmap)
    out = scratch_array(volume.target.output.parent, grid.shape) if on_disk else None
    progress = context.phases.progress
    data = direct(prepared.projections.data, prepared.geometry, grid, context.filter, progress, out)
    fbp = Volume(data, grid)
    volume.volumes = {BASELINE: fbp, **volume.volumes}
    volume.metrics = {BASELINE: volume.figures_of(fbp, volume.clock.now() - before), **volume.metrics}
    return ""


def _contrast(volume: CheckedVolume) -> str:
    """SNR and CNR of all volumes in regions of one reference: the truth, else FBP of the views, else none.

    Regions of the volume itself would give each method others.
    """
    reference = volume.truth or volume.volumes.get(BASELINE) or (None if volume.fitted else volume.made.volume)
    if reference is not None:
        mask = regions(reference, volume.context.seed)
        for name, each in volume.volumes.items():
            volume.metrics[name] |= contrast_by(mask, each)
    return ""


def _air(volume: CheckedVolume) -> str:
    """The level of air in each volume, if the views show air, relative to the noise of FBP there."""
    if volume.stray is not None and BASELINE in volume.volumes:
        _, noise = volume.stray.level(volume.volumes[BASELINE])
        for name, each in volume.volumes.items() if noise > 0 else ():  # neither NaN
            volume.metrics[name]["air"] = volume.stray.level(each)[0] / noise
    return ""


def _lost_matter(volume: CheckedVolume) -> str:
    """Weakly absorbing matter that FBP shows."""
    made, fbp = volume.made, volume.volumes[BASELINE]
    beside_fbp = lost_matter(made.volume.data, fbp.data, _slices_seen(volume.prepared, fbp.grid))
    if beside_fbp is None or beside_fbp.lost is None:
        return ""
    z, y, x = (f"{first}:{end}" for first, end in beside_fbp.lost)
    return (
        f"The {label_of(made.method)} volume keeps {beside_fbp.kept:.0%} of the mass that FBP shows above its own air "
        f"in a region of {z},{y},{x} [z, y, x]. Weak matter was lost, as where air is below zero. See --air in "
        "docs/corrections.md, give --allow-negative, or use --method fbp."
    )


def _slices_seen(prepared: PreparedProjections, grid: Grid) -> NDArray[np.bool_] | None:
    """[z] whether the slice's row of the detector got beam; None: all did, or rows show no slices."""
    lit, geometry = prepared.measured, prepared.geometry
    if lit is None or not geometry.rows_show_slices or grid.shape[0] != len(lit):
        return None
    return np.asarray(lit.any(axis=1))


_CHECKS = (
    _Check(_sample_radius, lambda volume: SAMPLE in volume.made.settings),
    _Check(_residual),
    _Check(_structure, lambda volume: volume.fitted and not volume.views_show_more),
    _Check(
        _stray_mass,
        name="the look for mass where views show nothing",
        projections=lambda volume: stray_mass_share(volume.prepared.geometry, volume.made.volume.grid),
    ),
    _Check(_needles),
    _Check(
        _odd_views,
        lambda volume: volume.fitted and not volume.views_show_more,
        "the look for views that do not fit the volume",
        lambda volume: 1.5,
    ),
    _Check(
        _fbp,
        lambda volume: (
            volume.fitted and volume.target.report is not None and has_direct_method(volume.prepared.geometry)
        ),
        "FBP for comparison",
        lambda volume: 2.5,
    ),
    _Check(_contrast),
    _Check(_air),
    _Check(_lost_matter, lambda volume: volume.fitted and BASELINE in volume.volumes),
)
