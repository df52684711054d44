"""Judges a volume before delivery: figures of merit, FBP beside it, and warnings of what it may hide or invent."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Note, event_of_sentence
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.measure import contrast_by, measure, regions, residual_share, residuals_along_rows
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.outcome import (
    ReportContext,
    hiding_warning,
    lost_mass_warning,
    needles_warning,
    not_begun_warning,
    odd_views_warning,
    sample_radius_note,
    stray_mass_warning,
)
from beamline.storage.disk_file import scratch_array
from drivers.base.clock import Clock
from recon.base.method import SAMPLE, Reconstruction
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE, by_name
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.field_edges import FieldEdges
from recon.voxels.matter_checks import StrayMass, Unexplained, lost_matter, stray_mass, stray_mass_share, unexplained

# Times of projecting all views that these take, about: a look for odd views, and a direct method with its figures.
_ODD_VIEWS, _DIRECT = 1.5, 2.5


def judge(
    made: Reconstruction,
    prepared: PreparedProjections,
    truth: Volume | None,
    target: OutputPaths,
    context: ReportContext,
    sink: Sink,
    clock: Clock,
    in_parts: bool = False,
) -> VolumeLooks:
    """Compare a volume with its views and with FBP, and send each warning to `sink`.

    Looks that would take longer than `context` leaves, or that somebody waits for, are left out with a remark.

    Args:
        in_parts: the output is made of slabs already, so that FBP cannot be kept in it.
    """
    judged = VolumeLooks(made, prepared, truth, target, context, sink, clock)
    if made.series is not None:  # each view shows a volume of its own time
        judged.metrics[made.method] = {"residual": made.series.residual, "seconds": made.seconds}
        return judged
    judged.warn(sample_radius_note(made.settings, prepared))
    judged.look_at_residual()
    judged.look_for_stray_mass()
    judged.warn(needles_warning(made, prepared.geometry))
    judged.look_for_odd_views()
    judged.compare_with_fbp()
    judged.compare_regions()
    judged.compare_air()
    judged.decide_whether_fbp_is_kept(in_parts)
    if judged.left_out_text:
        sink(StateEntered("left_out", judged.left_out_text, time=clock.now()))
    return judged


class VolumeLooks:
    """The checks of one volume, in order, and their results; arguments as for `judge`.

    Attributes:
        volumes: the volume and, where it is compared with one, FBP of the same views before it; by method.
        metrics: figures of merit of each, by method.
        warnings: those of the context first.
        left_out: looks for which there was no time.
        unexplained: what the volume leaves in the views; None where that is not known.
        stray: mass where views show nothing; None where it was not looked for.
        hiding: the warning that the volume may hide structure; empty without one.
        keeps_fbp: FBP is to be kept in the output, because the volume is in doubt.
        all_rays: seconds to project all views, about.
    """

    def __init__(
        self,
        made: Reconstruction,
        prepared: PreparedProjections,
        truth: Volume | None,
        target: OutputPaths,
        context: ReportContext,
        sink: Sink,
        clock: Clock,
    ) -> None:
        self.made, self.prepared, self.truth, self.target, self.context = made, prepared, truth, target, context
        self.sink, self.clock = sink, clock
        self.volumes: dict[str, Volume] = {made.method: made.volume}
        self.metrics: dict[str, dict[str, float]] = {}
        self.warnings, self.left_out = list(context.warnings), list[str]()
        self.unexplained: Unexplained | None = None
        self.stray: StrayMass | None = None
        self.hiding, self.keeps_fbp, self.all_rays = "", False, 0.0

    @property
    def waited_for(self) -> bool:
        """Whether the user stopped the reconstruction and waits for its end."""
        return self.made.ending.early

    @cached_property
    def shows_more(self) -> bool:
        """Whether views show more than the volume: than a region, or than a field that does not hold all of the sample,
        where what lies beside it was not taken off."""
        geometry, data = self.prepared.geometry, self.prepared.projections.data
        if self.context.region is not None and self.made.volume.grid.shape != Grid.matching(geometry).shape:
            return True
        if not self.direct:
            return SAMPLE in self.made.settings and not self.prepared.inside
        return bool(FieldEdges.of(data, geometry).beyond())

    @property
    def direct(self) -> bool:
        return by_name(self.made.method).traits.direct

    def has_time_for(self, projections: float) -> bool:
        """Whether there is time for `projections` projections of all views."""
        return not self.waited_for and self.context.leaves(projections * self.all_rays)

    def warn(self, sentence: str) -> None:
        """Send and record a warning; an empty one is ignored."""
        if sentence:
            self.sink(event_of_sentence(sentence, self.clock.now()))
            self.warnings.append(sentence)

    @property
    def left_out_text(self) -> str:
        """A sentence on the skipped checks and the reason; empty if none was skipped."""
        if not self.left_out:
            return ""
        why = "the reconstruction was stopped" if self.waited_for else "the seconds asked for were nearly over"
        return f"Left out, as {why}: {', '.join(self.left_out)}."

    def measured(self, volume: Volume, seconds: float) -> dict[str, float]:
        """Figures of merit; without residuals where the views show more than the volume."""
        prepared = None if self.shows_more else self.prepared
        figures = measure(volume, prepared, self.truth, self.context.phases.progress)
        return {**figures, "seconds": seconds}

    def look_at_residual(self) -> None:
        """Measure the volume and its residual in the views, for a volume that was fitted to them.

        A direct method leaves the blur of its filter in them, which tells nothing of what it hides.
        """
        made, prepared, seed = self.made, self.prepared, self.context.seed
        views, rng = prepared.projections.data, np.random.default_rng(seed)
        if not (self.direct or self.shows_more):
            self.unexplained = unexplained(made.volume, views, prepared.geometry, rng, prepared.ray_factors())
        before = self.clock.now()
        figures = self.metrics[made.method] = self.measured(made.volume, made.seconds)
        share = residual_share(prepared.geometry, made.volume.grid, prepared.held_out)
        self.all_rays = (self.clock.now() - before) / share
        if not self.direct and "residual" in figures:
            self.warn(not_begun_warning(made, *residuals_along_rows(made.volume, prepared)))
        if self.unexplained is not None:
            figures["unexplained"] = self.unexplained.share
            self.hiding = hiding_warning(made, self.unexplained)
            self.warn(self.hiding)

    def look_for_stray_mass(self) -> None:
        made, prepared = self.made, self.prepared
        if not self.has_time_for(stray_mass_share(prepared.geometry, made.volume.grid)):
            self.left_out.append("the look for mass where views show nothing")
            return
        self.stray = stray_mass(made.volume, prepared.projections.data, prepared.geometry, prepared.ray_factors())
        if self.stray is not None:
            self.metrics[made.method]["stray"] = self.stray.share
            self.warn(stray_mass_warning(made, self.stray))

    def look_for_odd_views(self) -> None:
        if self.shows_more:
            return
        if self.direct or self.has_time_for(_ODD_VIEWS):
            self.warn(odd_views_warning(self.made, self.prepared, self.context.selection, self.context.phases.progress))
        else:
            self.left_out.append("the look for views that do not fit the volume")

    def compare_with_fbp(self) -> None:
        """Put FBP of the same views first among the volumes, if it is wanted and fast enough."""
        made, prepared, phases = self.made, self.prepared, self.context.phases
        if self.direct or self.target.report is None or not has_direct_method(prepared.geometry):
            return
        if not self.has_time_for(_DIRECT):
            self.left_out.append("FBP for comparison")
            return
        phases.enter("FBP for comparison", "slices")
        before = self.clock.now()
        grid, on_disk = made.volume.grid, isinstance(made.volume.data, np.memmap)
        out = scratch_array(self.target.output.parent, grid.shape) if on_disk else None
        data = direct(prepared.projections.data, prepared.geometry, grid, self.context.filter, phases.progress, out)
        fbp = Volume(data, grid)
        self.volumes = {BASELINE: fbp, **self.volumes}
        self.metrics = {BASELINE: self.measured(fbp, self.clock.now() - before), **self.metrics}

    def compare_regions(self) -> None:
        """SNR and CNR of all volumes in regions of one reference: the truth, else FBP of the views, else none.

        Regions of the volume itself would give each method others.
        """
        reference = self.truth or self.volumes.get(BASELINE) or (self.made.volume if self.direct else None)
        if reference is not None:
            mask = regions(reference, self.context.seed)
            for name, volume in self.volumes.items():
                self.metrics[name] |= contrast_by(mask, volume)

    def compare_air(self) -> None:
        """The level of air in each volume, if the views show air, relative to the noise of FBP there."""
        if self.stray is None or BASELINE not in self.volumes:
            return
        _, noise = self.stray.level(self.volumes[BASELINE])
        if noise > 0:  # neither NaN
            for name, volume in self.volumes.items():
                self.metrics[name]["air"] = self.stray.level(volume)[0] / noise

    def look_for_lost_mass(self) -> bool:
        """Compare weakly absorbing matter with that in FBP; returns whether some was lost."""
        lost = False
        if BASELINE not in self.volumes or len(self.volumes) == 1:
            return lost
        fbp = self.volumes[BASELINE]
        for volume in self.volumes.values():
            beside_fbp = lost_matter(volume.data, fbp.data, _slices_seen(self.prepared, volume.grid))
            if beside_fbp is None:
                break  # it shows no air
            self.warn(sentence := lost_mass_warning(self.made, beside_fbp))
            lost = lost or bool(sentence)
        return lost

    def decide_whether_fbp_is_kept(self, in_parts: bool) -> None:
        """Decide whether the volume is in doubt, so that FBP is stored beside it if possible."""
        doubtful = self.look_for_lost_mass() or bool(self.hiding)
        if not doubtful or len(self.volumes) == 1:
            return
        self.keeps_fbp = not in_parts and self.target.takes_a_second(self.made.volume.grid)
        if self.keeps_fbp:
            output = self.target.output.name
            self.warn(Note(f"FBP of the same views is kept beside the volume: `beamline view {output}` shows both."))
            return
        self.warn(
            "FBP of the same views is not kept beside the volume: that takes an .h5 made at once, and room on its "
            "disk. Make it with --method fbp to lost_matter."
        )


def _slices_seen(prepared: PreparedProjections, grid: Grid) -> NDArray[np.bool_] | None:
    """[z] whether the slice's row of the detector got beam; None: all did, or rows show no slices."""
    measured, geometry = prepared.measured, prepared.geometry
    if measured is None or not geometry.rows_show_slices or grid.shape[0] != len(measured):
        return None
    return np.asarray(measured.any(axis=1))
