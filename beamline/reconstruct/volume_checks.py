"""Checks of a finished volume: residual, comparison with FBP, and warnings about features it may hide or invent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Note, event_of_sentence
from beamline.core.text import count
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.scan_facts import MadeVolume, label_of
from beamline.storage.disk_file import scratch_array
from drivers.base.clock import Clock
from recon.base.method import Reconstruction
from recon.base.reach import SAMPLE, SampleRadius
from recon.base.volume import Grid, Volume
from recon.judgement import Aspect, Judgement, TimeLeft, contrast, judge
from recon.methods import BASELINE, by_name
from recon.splatting.gaussians import NEEDLES_LIMIT, needles
from recon.voxels.beyond_field import reach_of
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.matter_checks import STRAY_LIMIT, UNEXPLAINED_LIMIT, lost_matter
from recon.voxels.odd_views import LIMIT, OddView
from recon.voxels.view_weights import density_gain

_NAMED = 5  # largest number of odd projections that the warning names
_COMPARED = ("fbp", "fista-tv")  # methods that show cracks well: FBP has sharp edges, FISTA-TV has low noise
_FBP_WORK = 2.5  # time of FBP, in units of the time to project the volume once into all views


@dataclass(frozen=True, eq=False)
class CheckedVolume:
    """A volume with the results of its checks.

    Attributes:
        judgement: comparison of the volume with its projections and with the ground truth.
        volumes: volumes by method: FBP of the same projections, if the volume is compared with FBP, and then the volume
            itself.
        metrics: figures of merit of each volume, by method.
        warnings: all warnings, those of the context first.
        hiding_warning: the warning that the volume may hide structure; empty if there is none.
        skipped_text: a sentence about the checks that were left out, with the reason; empty if no check was left out.
    """

    judgement: Judgement
    volumes: Mapping[str, Volume]
    metrics: Mapping[str, Mapping[str, float]]
    warnings: Sequence[str]
    hiding_warning: str = ""
    skipped_text: str = ""


def check_volume(outcome: MadeVolume, sink: Sink, clock: Clock) -> CheckedVolume:
    """Compare a volume with its projections and with FBP, and send each warning to `sink`.

    Checks are left out if they would take longer than the time limit in `context` allows, or if the reconstruction was
    stopped. The result then has a remark.
    """
    result, prepared, truth, context = outcome.result, outcome.prepared, outcome.truth, outcome.context
    volumes, warnings = {result.method: result.volume}, list(context.warnings)

    def tell(*sentences: str) -> None:
        for sentence in filter(None, sentences):
            sink(event_of_sentence(sentence, clock.now()))
            warnings.append(sentence)

    if result.series is not None:  # each projection shows the volume at its own time
        figures = {"residual": result.series.residual, "seconds": result.seconds}
        return CheckedVolume(Judgement(figures), volumes, {result.method: figures}, warnings)
    tell(_sample_radius(result, prepared), _unused_levels(result))
    aspects, fitted = _aspects(outcome), by_name(result.method).fitted
    time = TimeLeft(clock.now, lambda seconds: not result.ending.early and context.leaves(seconds))
    progress = context.phases.progress
    judgement = judge(
        result.volume, prepared.views, truth,
        aspects=aspects, seed=context.seed, time=time, progress=progress,
    )  # fmt: skip
    metrics: dict[str, dict[str, float]] = {result.method: {**judgement.figures, "seconds": result.seconds}}
    hiding = _structure(result, judgement)
    tell(not_begun_warning(result, judgement), hiding, _stray_mass(result, judgement) if fitted else "")
    tell(_needles(result, prepared), odd_views_warning(judgement.odd_views, outcome))
    skipped = list(judgement.skipped)
    if fitted and outcome.target.report is not None and has_direct_method(prepared.geometry):
        if time.leaves(_FBP_WORK * judgement.seconds_of_views):
            before = clock.now()
            fbp = _fbp(outcome)
            seconds, residual = clock.now() - before, aspects & Aspect.RESIDUAL
            of_fbp = judge(fbp, prepared.views, truth, aspects=residual, progress=progress).figures
            volumes = {BASELINE: fbp, **volumes}
            metrics = {BASELINE: {**of_fbp, "seconds": seconds}, **metrics}
        else:
            skipped.append("FBP for comparison")
    for name, figures in _beside_each_other(result, volumes, judgement, truth, context.seed).items():
        metrics[name] |= figures
    if fitted and BASELINE in volumes:
        tell(_lost_material(result, prepared, volumes[BASELINE]))
    if skipped:
        reason = "the reconstruction was stopped" if result.ending.early else "the time limit was nearly reached"
        skipped_checks = ", ".join(skipped)
        text = f"These checks were left out, because {reason}: {skipped_checks}."
        sink(StateEntered("left_out", text, time=clock.now()))
    return CheckedVolume(judgement, volumes, metrics, warnings, hiding, text if skipped else "")


def _aspects(outcome: MadeVolume) -> Aspect:
    """The checks that can be made for this volume. No residual is computed if the projections show more than the
    volume. This is so if the volume is only a region, or if the sample is larger than the field of view and the part
    outside was not subtracted. The residual of a direct method contains the blur of its filter.
    """
    result, prepared = outcome.result, outcome.prepared
    geometry, fitted, reach = prepared.geometry, by_name(result.method).fitted, prepared.lines.reach
    if outcome.context.region is not None and result.volume.grid.shape != Grid.matching(geometry).shape:
        show_more = True
    elif fitted:
        subtracted = reach is not None and reach.measured and reach.sample is None
        show_more = SAMPLE in result.settings and not subtracted
    else:
        show_more = bool(reach_of(prepared.seen).beyond)
    if show_more:
        return Aspect.STRAY
    return Aspect.STRAY | Aspect.RESIDUAL | (Aspect.FIT if fitted else Aspect(0))


def _sample_radius(result: Reconstruction, prepared: PreparedProjections) -> str:
    """A note on the width of a sample larger than the field of view, and on the uncertainty that follows from it."""
    if SAMPLE not in result.settings:
        return ""
    radius, low, high, density = (result.settings[name] for name in SampleRadius(1, 1, 1, 1).settings)
    unit, reach = prepared.origin.length_unit, prepared.geometry.reach
    known, sure = "as given", ""
    if density == 1:
        known = "an assumed value, because there are too few projections to measure the radius"
    elif low < high:
        known = f"{low:.4g} to {high:.4g} {unit} fit the projections nearly as well"
        advice = (
            "; offset projections (scan.offset_views) reduce this uncertainty"
            if prepared.geometry.is_centred.all()
            else ""
        )
        sure = f" Densities near the axis are uncertain by {density:.1%} or more{advice}."
    ratio = radius / reach
    return Note(
        f"The sample is wider than the field of view: its radius about the rotation axis is {radius:.4g} {unit}, "
        f"{ratio:.2f} times the radius of the field of view ({known}). The whole sample was reconstructed, but only "
        f"the part in the field of view is written.{sure}"
    )


def not_begun_warning(result: Reconstruction, judgement: Judgement) -> str:
    """The warning that a volume does not show the sample yet; empty if the residual is smaller than that of a uniform
    volume."""
    residual, uniform = judgement.along_rows or (0.0, 0.0)
    if residual < uniform or uniform == 0:
        return ""
    last = result.history[-1] if result.history else None
    steps = f" after {last.step} of {last.steps} {last.unit or 'steps'}" if last is not None and last.steps else ""
    return (
        f"Allow more time, steps or iterations: the {label_of(result.method)} volume does not show the sample yet. "
        f"The residual of this volume, {residual:.3g}, is not smaller than the residual of a uniform volume, "
        f"{uniform:.3g} (both as a fraction of the variation along detector rows). The method ended after "
        f"{result.seconds:.3g} s{steps}."
    )


def _structure(result: Reconstruction, judgement: Judgement) -> str:
    """The warning about structure in the residual."""
    if judgement.unexplained is None or (share := judgement.unexplained.share) <= UNEXPLAINED_LIMIT:
        return ""
    others = " and ".join(name for name in _COMPARED if name != result.method)
    return (
        f"The {label_of(result.method)} volume may hide cracks, pores or edges: in {share:.1%} of the sample voxels "
        f"the residual shows structure above the noise (normally in at most {UNEXPLAINED_LIMIT:.1%}). Look at "
        f"'Residual in the projections' in the report, and compare with --method {others}."
    )


def _stray_mass(result: Reconstruction, judgement: Judgement) -> str:
    """The warning about mass in regions that the projections show to be empty."""
    if judgement.stray is None or (share := judgement.stray.share) <= STRAY_LIMIT:
        return ""
    return (
        f"Do not trust faint features before you have looked at 'Stray mass' in the report: {share:.1%} of the mass of "
        f"the {label_of(result.method)} volume lies in voxels that the projections show to be empty (normally at most "
        f"{STRAY_LIMIT:.0%})."
    )


def _needles(result: Reconstruction, prepared: PreparedProjections) -> str:
    """The warning about needle-shaped Gaussians."""
    model = result.gaussians
    share = needles(model, prepared.geometry).share if model is not None and model.n else 0.0
    if share <= NEEDLES_LIMIT:
        return ""
    return (
        f"Compare with --method fista-tv: {share:.0%} of the mass is in needle-shaped Gaussians, thinner than a pixel "
        f"and ten times as long (normally at most {NEEDLES_LIMIT:.0%}). With few projections, such Gaussians fit the "
        "noise."
    )


def odd_views_warning(odd: Sequence[OddView], outcome: MadeVolume) -> str:
    """The warning about projections that do not fit the volume, with frames and pixels of the worst ones; empty if all
    projections fit.
    """
    if not odd:
        return ""
    frames, selection = outcome.prepared.ids, outcome.context.selection
    binning, first_row = selection.binning, (selection.rows or (0, 0))[0]
    places = []
    for each in sorted(odd, key=lambda each: -abs(each.score))[:_NAMED]:
        top, below = (first_row + row * binning for row in each.rows)
        left, right = (col * binning for col in each.cols)
        more_or_less = "more" if each.score > 0 else "less"
        places.append(
            f"frame {frames[each.view]}, rows {top} ... {below - 1}, columns {left} ... {right - 1} (the projection "
            f"absorbs {more_or_less} than the volume)"
        )
    more = f"; and {len(odd) - _NAMED} more" if len(odd) > _NAMED else ""
    where = "; ".join(places)
    return (
        "Look at these frames, because something crossed the beam or the sample moved: a part of "
        f"{count(len(odd), 'projection')} differs from the volume by more than {LIMIT:g} times the usual difference "
        f"between projections and volume: {where}{more}."
    )


def _fbp(outcome: MadeVolume) -> Volume:
    """FBP of the same projections."""
    result, prepared, context = outcome.result, outcome.prepared, outcome.context
    context.phases.enter("FBP for comparison", "slices")
    grid, on_disk = result.volume.grid, isinstance(result.volume.data, np.memmap)
    out = scratch_array(outcome.target.output.parent, grid.shape) if on_disk else None
    lines, progress = prepared.seen.data, context.phases.progress
    volume = direct(lines, prepared.geometry, grid, context.filter, progress, out)
    if (gain := density_gain(prepared.geometry)) != 1:
        volume *= np.float32(gain)
    return Volume(volume, grid)


def _beside_each_other(
    result: Reconstruction, volumes: Mapping[str, Volume], judgement: Judgement, truth: Volume | None, seed: int
) -> dict[str, dict[str, float]]:
    """Figures of merit that compare volumes: SNR and CNR in regions of one reference, and the air level. The reference
    is the ground truth if there is one, otherwise FBP of the projections, otherwise the volume of a direct method.
    Without a reference, SNR and CNR are not computed. The air level is in units of the noise of FBP in air. It is
    computed if the projections show air.
    """
    direct_one = None if by_name(result.method).fitted else result.volume
    reference = truth or volumes.get(BASELINE) or direct_one
    figures: dict[str, dict[str, float]] = {name: {} for name in volumes}
    if reference is not None:
        figures |= contrast(reference, volumes, seed)
    if (stray := judgement.stray) is not None and BASELINE in volumes:
        _, noise = stray.level(volumes[BASELINE])
        for name, each in volumes.items() if noise > 0 else ():  # NaN is excluded by this comparison
            figures[name]["air"] = stray.level(each)[0] / noise
    return figures


def _lost_material(result: Reconstruction, prepared: PreparedProjections, fbp: Volume) -> str:
    """The warning that weakly absorbing material is missing in the volume, although FBP shows it."""
    measured, rows_in_beam = prepared.sources.measured, None  # [z]: the detector row of the slice was in the beam
    if measured is not None and prepared.geometry.rows_show_slices and fbp.grid.shape[0] == len(measured):
        rows_in_beam = np.asarray(measured.any(axis=1))
    if (lost := lost_matter(result.volume.data, fbp.data, rows_in_beam)) is None:
        return ""
    z, y, x = (f"{first}:{end}" for first, end in lost.region)
    return (
        f"Weakly absorbing material is missing: in the region {z},{y},{x} [z, y, x] the {label_of(result.method)} "
        f"volume has only {lost.kept_share:.0%} of the mass that FBP shows (measured from the air level of FBP). One "
        "possible cause is an air level below zero. Use --allow-negative or --method fbp, or correct the air "
        "(--air, see docs/corrections.md)."
    )


def _unused_levels(result: Reconstruction) -> str:
    """The warning that the levels of --levels were not used."""
    levels = result.settings.get("levels")
    if levels is None or not np.size(levels) or "levels_of_materials" in result.settings:
        return ""
    stated = ", ".join(f"{level:g}" for level in np.ravel(levels))
    return (
        f"The levels {stated} were not used, because these levels do not improve the prediction of held-out "
        "projections, or because a weaker pull to the levels predicts the projections still better (the density then "
        "varies within a material). The volume is the FISTA-TV volume. Levels are densities in the unit of the volume; "
        "do not list the density of air. Leave out --levels to have the levels determined from the scan."
    )
