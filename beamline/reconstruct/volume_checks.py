"""Checks a volume before its delivery: its judgement, FBP beside it, and warnings of what it may hide or invent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Note, event_of_sentence
from beamline.core.text import count
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.scan_facts import ReportContext, label_of
from beamline.storage.disk_file import scratch_array
from drivers.base.clock import Clock
from recon.base.method import SAMPLE, Reconstruction, SampleRadius
from recon.base.volume import Grid, Volume
from recon.judgement import Aspect, Judgement, TimeLeft, contrast, judge
from recon.methods import BASELINE, by_name
from recon.splatting.gaussians import NEEDLES_LIMIT, needles
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.field_edges import FieldEdges
from recon.voxels.matter_checks import STRAY_LIMIT, UNEXPLAINED_LIMIT, lost_matter
from recon.voxels.odd_views import LIMIT, OddView

_NAMED = 5  # odd views, at most
_COMPARED = ("fbp", "fista-tv")  # that show cracks, by edges and by flat parts
_FBP_WORK = 2.5  # projections of all views that take as long


@dataclass(frozen=True, eq=False)
class CheckedVolume:
    """A volume with what its views and FBP say of it.

    Attributes:
        judgement: by its views and the truth.
        volumes: the volume and, where it is compared with one, FBP of the same views before it; by method.
        metrics: figures of merit of each, by method.
        warnings: those of the context first.
        hiding_warning: the one that the volume may hide structure; empty without one.
        skipped_text: a sentence on the checks left out and the reason; empty if none was.
    """

    judgement: Judgement
    volumes: Mapping[str, Volume]
    metrics: Mapping[str, Mapping[str, float]]
    warnings: Sequence[str]
    hiding_warning: str = ""
    skipped_text: str = ""


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
    volumes, warnings = {made.method: made.volume}, list(context.warnings)

    def tell(*sentences: str) -> None:
        for sentence in filter(None, sentences):
            sink(event_of_sentence(sentence, clock.now()))
            warnings.append(sentence)

    if made.series is not None:  # each view shows a volume of its own time
        figures = {"residual": made.series.residual, "seconds": made.seconds}
        return CheckedVolume(Judgement(figures), volumes, {made.method: figures}, warnings)
    tell(_sample_radius(made, prepared), _unused_levels(made))
    aspects, fitted = _aspects(made, prepared, context), by_name(made.method).fitted
    time = TimeLeft(clock.now, lambda seconds: not made.ending.early and context.leaves(seconds))
    progress = context.phases.progress
    judgement = judge(
        made.volume, prepared.views, truth,
        held_out=prepared.views_held_out, aspects=aspects, seed=context.seed, time=time, progress=progress,
    )  # fmt: skip
    metrics: dict[str, dict[str, float]] = {made.method: {**judgement.figures, "seconds": made.seconds}}
    hiding = _structure(made, judgement)
    tell(not_begun_warning(made, judgement), hiding, _stray_mass(made, judgement) if fitted else "")
    tell(_needles(made, prepared), odd_views_warning(judgement.odd_views, prepared, context))
    skipped = list(judgement.skipped)
    if fitted and target.report is not None and has_direct_method(prepared.geometry):
        if time.leaves(_FBP_WORK * judgement.seconds_of_views):
            before = clock.now()
            fbp = _fbp(made, prepared, target, context)
            seconds, residual = clock.now() - before, aspects & Aspect.RESIDUAL
            of_fbp = judge(
                fbp, prepared.views, truth, held_out=prepared.views_held_out, aspects=residual, progress=progress
            ).figures
            volumes = {BASELINE: fbp, **volumes}
            metrics = {BASELINE: {**of_fbp, "seconds": seconds}, **metrics}
        else:
            skipped.append("FBP for comparison")
    for name, figures in _beside_each_other(made, volumes, judgement, truth, context.seed).items():
        metrics[name] |= figures
    if fitted and BASELINE in volumes:
        tell(_lost_matter(made, prepared, volumes[BASELINE]))
    if skipped:
        why = "the reconstruction was stopped" if made.ending.early else "the seconds asked for were nearly over"
        text = f"Left out, as {why}: {', '.join(skipped)}."
        sink(StateEntered("left_out", text, time=clock.now()))
    return CheckedVolume(judgement, volumes, metrics, warnings, hiding, text if skipped else "")


def _aspects(made: Reconstruction, prepared: PreparedProjections, context: ReportContext) -> Aspect:
    """What the volume can be judged by: without residuals where views show more than the volume.

    That is, more than a region, or than a field that does not hold all of the sample, where what lies beside it was not
    taken off. A direct volume leaves the blur of its filter in the views.
    """
    geometry, fitted = prepared.geometry, by_name(made.method).fitted
    if context.region is not None and made.volume.grid.shape != Grid.matching(geometry).shape:
        show_more = True
    elif fitted:
        show_more = SAMPLE in made.settings and not prepared.inside
    else:
        show_more = bool(FieldEdges.of(prepared.projections.data, geometry).beyond())
    if show_more:
        return Aspect.STRAY
    return Aspect.STRAY | Aspect.RESIDUAL | (Aspect.FIT if fitted else Aspect(0))


def _sample_radius(made: Reconstruction, prepared: PreparedProjections) -> str:
    """How far a sample wider than the field reaches beside it, and what that leaves open."""
    if SAMPLE not in made.settings:
        return ""
    radius, low, high, density = (made.settings[name] for name in SampleRadius(1, 1, 1, 1).settings)
    unit, reach = prepared.length_unit, prepared.geometry.reach
    known, sure = "as given", ""
    if density == 1:
        known = "assumed: there are too few views to measure it"
    elif low < high:
        known = f"{low:.4g} to {high:.4g} {unit} explain the views nearly as well"
        advice = "; offset views (scan.offset_views) reduce that" if prepared.geometry.is_centred.all() else ""
        sure = f" Densities near the axis are uncertain by {density:.1%} or more{advice}."
    return Note(
        f"The sample reaches {radius:.4g} {unit} from the rotation axis, {radius / reach:.2f} times as far as the "
        f"field ({known}). The whole sample was reconstructed; only the part within the field is written.{sure}"
    )


def not_begun_warning(made: Reconstruction, judgement: Judgement) -> str:
    """The warning that a volume shows nothing of the sample yet; empty if it explains its views better than a
    volume of one density."""
    left, uniform = judgement.along_rows or (0.0, 0.0)
    if left < uniform or uniform == 0:
        return ""
    last = made.history[-1] if made.history else None
    steps = f" after {last.step} of {last.steps} {last.unit or 'steps'}" if last is not None and last.steps else ""
    return (
        f"The {label_of(made.method)} volume shows nothing of the sample: it leaves {left:.3g} of the differences "
        f"along the rows of the views, where a volume of one density leaves {uniform:.3g}. The method ended in "
        f"{made.seconds:.3g} s{steps}: give it more seconds, steps or iterations."
    )


def _structure(made: Reconstruction, judgement: Judgement) -> str:
    """The warning of structure in the residual of the views."""
    if judgement.unexplained is None or (share := judgement.unexplained.share) <= UNEXPLAINED_LIMIT:
        return ""
    others = " and ".join(name for name in _COMPARED if name != made.method)
    return (
        f"{share:.1%} of the matter leaves structure in the residual of the views (at most {UNEXPLAINED_LIMIT:.1%} "
        f"is usual): the {label_of(made.method)} volume may hide cracks, pores or edges. Look at 'What the volume "
        f"leaves in the views' in the report, and compare with --method {others}."
    )


def _stray_mass(made: Reconstruction, judgement: Judgement) -> str:
    """The warning of mass where views show none."""
    if judgement.stray is None or (share := judgement.stray.share) <= STRAY_LIMIT:
        return ""
    return (
        f"{share:.1%} of the mass of the {label_of(made.method)} volume is stray, where the views show nothing "
        f"(at most {STRAY_LIMIT:.0%} is usual). Look at 'Stray mass' in the report before you believe faint parts."
    )


def _needles(made: Reconstruction, prepared: PreparedProjections) -> str:
    """The warning of Gaussians of a model that are needle-shaped."""
    model = made.gaussians
    share = needles(model, prepared.geometry).share if model is not None and model.n else 0.0
    if share <= NEEDLES_LIMIT:
        return ""
    return (
        f"{share:.0%} of the mass of the model is in Gaussians thinner than a pixel and ten times as long (at "
        f"most {NEEDLES_LIMIT:.0%} is usual). They follow the noise of few views: compare with --method fista-tv."
    )


def odd_views_warning(odd: Sequence[OddView], prepared: PreparedProjections, context: ReportContext) -> str:
    """The warning of views that do not fit, which names the worst by frames and pixels of the file; empty without."""
    if not odd:
        return ""
    frames, binning = prepared.projections.view_ids, context.selection.binning
    first_row = (context.selection.rows or (0, 0))[0]
    places = [
        f"frame {frames[each.view]}, rows {first_row + each.rows[0] * binning} ... "
        f"{first_row + each.rows[1] * binning - 1}, columns {each.cols[0] * binning} ... "
        f"{each.cols[1] * binning - 1} (absorbs {'more' if each.score > 0 else 'less'})"
        for each in sorted(odd, key=lambda each: -abs(each.score))[:_NAMED]
    ]
    more = f"; and {len(odd) - _NAMED} more" if len(odd) > _NAMED else ""
    return (
        f"{count(len(odd), 'view')} with a part that is not in the volume, by more than {LIMIT:g} times "
        f"what is usual there: {'; '.join(places)}{more}. Something was in the beam, or the sample was elsewhere: look "
        "at these frames."
    )


def _fbp(made: Reconstruction, prepared: PreparedProjections, target: OutputPaths, context: ReportContext) -> Volume:
    """FBP of the same views."""
    context.phases.enter("FBP for comparison", "slices")
    grid, on_disk = made.volume.grid, isinstance(made.volume.data, np.memmap)
    out = scratch_array(target.output.parent, grid.shape) if on_disk else None
    lines, progress = prepared.projections.data, context.phases.progress
    return Volume(direct(lines, prepared.geometry, grid, context.filter, progress, out), grid)


def _beside_each_other(
    made: Reconstruction, volumes: Mapping[str, Volume], judgement: Judgement, truth: Volume | None, seed: int
) -> dict[str, dict[str, float]]:
    """Figures of merit that compare volumes: SNR and CNR in regions of one reference, level of air.

    The reference is the truth, else FBP of the views, else none. Air, if the views show any, is relative to the noise
    of FBP there.
    """
    direct_one = None if by_name(made.method).fitted else made.volume
    reference = truth or volumes.get(BASELINE) or direct_one
    figures: dict[str, dict[str, float]] = {name: {} for name in volumes}
    if reference is not None:
        figures |= contrast(reference, volumes, seed)
    if (stray := judgement.stray) is not None and BASELINE in volumes:
        _, noise = stray.level(volumes[BASELINE])
        for name, each in volumes.items() if noise > 0 else ():  # neither NaN
            figures[name]["air"] = stray.level(each)[0] / noise
    return figures


def _lost_matter(made: Reconstruction, prepared: PreparedProjections, fbp: Volume) -> str:
    """The warning that weakly absorbing matter is missing that FBP shows."""
    lit, seen = prepared.measured, None  # [z] whether the slice's row of the detector got beam
    if lit is not None and prepared.geometry.rows_show_slices and fbp.grid.shape[0] == len(lit):
        seen = np.asarray(lit.any(axis=1))
    if (lost := lost_matter(made.volume.data, fbp.data, seen)) is None:
        return ""
    z, y, x = (f"{first}:{end}" for first, end in lost.region)
    return (
        f"The {label_of(made.method)} volume keeps {lost.kept:.0%} of the mass that FBP shows above its own air "
        f"in a region of {z},{y},{x} [z, y, x]. Weak matter was lost, as where air is below zero. See --air in "
        "docs/corrections.md, give --allow-negative, or use --method fbp."
    )


def _unused_levels(made: Reconstruction) -> str:
    """That the volume was not pulled to the levels that were given."""
    levels = made.settings.get("levels")
    if levels is None or not np.size(levels) or "levels_of_materials" in made.settings:
        return ""
    stated = ", ".join(f"{level:g}" for level in np.ravel(levels))
    return (
        f"The levels {stated} were not used, because views held out are not predicted better with them: the volume is "
        "that of total variation. Levels are densities in the unit of the volume, without the air's; leave them out to "
        "have them found."
    )
