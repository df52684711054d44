"""What a report and a file state of a scan and its volume: facts, context, and warnings of faults of the volume."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import Phases
from beamline.core.sinks import Note
from beamline.core.text import count, spans
from beamline.projections.flagged_frames import reasons, reference_images, returned_views, worst_frames
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.region import RegionOfRows
from beamline.storage.flag_legend import FrameFlags, counted
from beamline.storage.readers.base import ScanSource, rows_replaced
from beamline.storage.rules.scan import scan_ended
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.method import SAMPLE, Reconstruction, SampleRadius
from recon.base.volume import Grid
from recon.methods import by_name
from recon.splatting.gaussians import NEEDLES_LIMIT, needles
from recon.voxels import odd_views, view_weights
from recon.voxels.fbp import Filter
from recon.voxels.matter_checks import STRAY_LIMIT, UNEXPLAINED_LIMIT, LostMatter, StrayMass, Unexplained

if TYPE_CHECKING:
    from beamline.report.sheets import FlaggedFrame


@dataclass(frozen=True)
class ScanFacts:
    """The facts of a scan for a report.

    Attributes:
        table: facts for people, by name.
        frames: frames in the file of those triggered, e.g. "110/110".
        remarks: faults during the scan, by the file.
        flagged: the worst of the flagged frames.
        references: mean darks and flats [row, col], binned, by title.
        shape: of a frame.
        columns: of the detector that are used, the last not included, as --cols takes them; empty: all.
        ended: how the scan ended where it did not take all its frames, and why; empty: it did, or runs.
        frames_per_view: that a view is the mean of.
        live_picture: file name of the last picture of a volume that grew with its scan; empty: none did.
    """

    path: Path
    name: str
    sample: str
    table: Mapping[str, str]
    frames: str
    remarks: Sequence[str] = ()
    flagged: Sequence[FlaggedFrame] = ()
    references: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    shape: tuple[int, int] = (1, 1)
    columns: str = ""
    ended: str = ""
    frames_per_view: int = 1
    live_picture: str = ""


@dataclass(frozen=True)
class ReportContext:
    """The context of a reconstruction: the scan, the selection, the command, and the warnings so far.

    Attributes:
        filter: of FBP, also of the one that the volume is compared with.
        leaves: whether there is time for so many seconds before the report.
        stray: the map of mass where views show nothing [y, x]; None without any.
    """

    facts: ScanFacts
    selection: Selection
    command: str
    seed: int
    warnings: Sequence[str] = ()
    started: float = 0.0
    recipe: str = ""
    region: RegionOfRows | None = None
    phases: Phases = field(default_factory=Phases)
    leaves: Callable[[float], bool] = lambda seconds: True
    stray: NDArray[np.float32] | None = None
    filter: Filter = "hann"


def label_of(method: str) -> str:
    """The name of a method for people."""
    return by_name(method).label


def facts_of(source: ScanSource, flags: FrameFlags | None = None) -> ScanFacts:
    """Facts of an open scan; `flags` replace those of the file."""
    counts = {kind: int(np.sum(source.image_key == kind)) for kind in FrameKind}
    attributes = dict(source.attributes)
    sample = str(attributes.pop("sample", attributes.pop("sample_name", "")))
    pitch, energy = source.pixel_size_mm, source.energy_kev
    columns = "" if source.cols is None else f"{source.cols[0]}:{source.cols[1]}"
    missing, flags = int(attributes.get("missing_triggers", 0)), source.flags if flags is None else flags
    table = {
        "file": source.path.name,
        "format": source.format,
        "sample": sample or "not stated",
        "projections": str(counts[FrameKind.PROJECTION]),
        "flats, darks": f"{counts[FrameKind.FLAT]}, {counts[FrameKind.DARK]}",
        "detector (rows × columns)": f"{source.shape[0]} × {source.shape[1]}"
        + (f", columns {columns}" if columns else ""),
        "pixel size": "not known" if pitch is None else f"{pitch * 1e3:.4g} µm",
        "energy": "not known" if energy is None else f"{energy:g} keV",
        "axis in the file": "not stated" if source.axis_col is None else f"column {source.axis_col:.2f}",
        "flagged by the monitor": "no monitor looked at it" if flags is None else counted(flags.counts()),
    }
    table |= {str(k): as_text(v) for k, v in attributes.items() if len(str(v)) <= 200 and str(k) not in table}
    n = int(source.image_key.size)
    again = rows_replaced(source)
    if again.size:
        table["views taken again"] = f"{again.size}, because of an alarm: frames {spans(again.tolist())} are not used"
    returned = returned_views(source)
    if returned:
        table["views on the way back"] = "; ".join(view.in_words() for view in returned)
    remarks = [] if flags is None else reasons(flags)
    remarks += [f"On the way back {view.in_words()} since the first view." for view in returned if view.moved]
    ended = " ".join(finding.message for finding in scan_ended(source)) if source.finished else ""
    return ScanFacts(
        source.path,
        source.path.name,
        sample,
        table,
        f"{n}/{n + missing}",
        remarks,
        [] if flags is None else worst_frames(source, flags),
        reference_images(source),
        source.shape,
        columns,
        ended,
        source.frames_per_view,
    )


def as_text(value: object) -> str:
    """A value as text for people; the file has the exact value."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)


_NAMED = 5  # odd views, at most


def partly_seen(geometry: Geometry) -> NDArray[np.intp]:
    """Slices that are seen over less of the half turn than others, because views have different heights."""
    if geometry.is_cone or not geometry.is_straight or not geometry.shifts[:, 1].any():
        return np.zeros(0, np.intp)
    heights = Grid.matching(geometry).coordinates()[0]
    return np.flatnonzero(view_weights.partly_seen(geometry, heights / geometry.pixel_pitch + geometry.axis_row))


def partly_seen_warning(geometry: Geometry) -> str:
    """The warning that some slices are seen by few views; empty if all are seen equally."""
    some = partly_seen(geometry)
    if not some.size:
        return ""
    return (
        f"Slices {spans(some.tolist())} of {Grid.matching(geometry).shape[0]} are seen over less of the half turn than "
        "the others, since views stand at heights of their own: there the volume is streaked, and too thin by FBP."
    )


def lost_mass_warning(made: Reconstruction, beside_fbp: LostMatter) -> str:
    """The warning that a volume has lost weakly absorbing matter that FBP shows; empty if it has not."""
    if beside_fbp.lost is None:
        return ""
    z, y, x = (f"{first}:{end}" for first, end in beside_fbp.lost)
    return (
        f"The {label_of(made.method)} volume keeps {beside_fbp.kept:.0%} of the mass that FBP shows above its own air "
        f"in a region of {z},{y},{x} [z, y, x]. Weak matter was lost, as where air is below zero. See --air in "
        "docs/corrections.md, give --allow-negative, or use --method fbp."
    )


def sample_radius_note(settings: Mapping[str, Any], prepared: PreparedProjections) -> str:
    """How far the sample reaches beside the field, and what that leaves open; empty of one that ends within it."""
    if SAMPLE not in settings:
        return ""
    radius, low, high, density = (settings[name] for name in SampleRadius(1, 1, 1, 1).settings)
    unit, field = prepared.length_unit, prepared.geometry.reach
    known, sure = "as given", ""
    if density == 1:
        known = "assumed: there are too few views to measure it"
    elif low < high:
        known = f"{low:.4g} to {high:.4g} {unit} explain the views nearly as well"
        sure = f" Densities near the axis are uncertain by {density:.1%} or more; scan.wide_views reduce that."
    return Note(
        f"The sample reaches {radius:.4g} {unit} from the rotation axis, {radius / field:.2f} times as far as the "
        f"field ({known}). The whole sample was reconstructed; only the part within the field is written.{sure}"
    )


def not_begun_warning(made: Reconstruction, left: float, uniform: float) -> str:
    """The warning that a volume shows nothing of the sample yet; empty if it explains its views better than a
    volume of one density.

    Args:
        left, uniform: by the volume, and by a volume of one density; see `measure.residuals_along_rows`.
    """
    if left < uniform or uniform == 0 or by_name(made.method).traits.direct:
        return ""
    last = made.history[-1] if made.history else None
    steps = f" after {last.step} of {last.steps} {last.unit or 'steps'}" if last is not None and last.steps else ""
    return (
        f"The {label_of(made.method)} volume shows nothing of the sample: it leaves {left:.3g} of the differences "
        f"along the rows of the views, where a volume of one density leaves {uniform:.3g}. The method ended in "
        f"{made.seconds:.3g} s{steps}: give it more seconds, steps or iterations."
    )


_COMPARED = ("fbp", "fista-tv")  # that show cracks, by edges and by flat parts


def hiding_warning(made: Reconstruction, structure: Unexplained) -> str:
    """The warning that the residual of a volume has structure; empty if it has none, or if the volume was not
    fitted."""
    if structure.share <= UNEXPLAINED_LIMIT or by_name(made.method).traits.direct:
        return ""
    others = " and ".join(name for name in _COMPARED if name != made.method)
    return (
        f"{structure.share:.1%} of the matter leaves structure in the residual of the views (at most "
        f"{UNEXPLAINED_LIMIT:.1%} is usual): the {label_of(made.method)} volume may hide cracks, pores or edges. Look "
        f"at 'What the volume leaves in the views' in the report, and compare with --method {others}."
    )


def _crossing_sentence(parts: tuple[odd_views.OddView, ...], frames: NDArray[np.int64], first: int, side: int) -> str:
    """Odd views that one object makes on its way through the field."""
    rows = min(odd.rows[0] for odd in parts), max(odd.rows[1] for odd in parts)
    speed = odd_views.speed_of(parts) * side
    return (
        f"one object that crosses, seen in {count(len(parts), 'view')} of frames {frames[parts[0].view]} ... "
        f"{frames[parts[-1].view]}, rows {first + rows[0] * side} ... {first + rows[1] * side - 1}, "
        f"{abs(speed):.1f} px a view to the {'right' if speed > 0 else 'left'} "
        f"(absorbs {'more' if parts[0].score > 0 else 'less'}; `beamline monitor` shows its whole way)"
    )


def stray_mass_warning(made: Reconstruction, stray: StrayMass) -> str:
    """The warning that a volume has mass where views show none; empty if it has little, and for direct methods."""
    if stray.share <= STRAY_LIMIT or by_name(made.method).traits.direct:
        return ""
    return (
        f"{stray.share:.1%} of the mass of the {label_of(made.method)} volume is stray, where the views show nothing "
        f"(at most {STRAY_LIMIT:.0%} is usual). Look at 'Stray mass' in the report before you believe faint parts."
    )


def needles_warning(made: Reconstruction, geometry: Geometry) -> str:
    """The warning that the Gaussians of a model are needle-shaped; empty if they are not, or if there is no model."""
    if made.gaussians is None or not made.gaussians.n:
        return ""
    found = needles(made.gaussians, geometry)
    if found.share <= NEEDLES_LIMIT:
        return ""
    return (
        f"{found.share:.0%} of the mass of the model is in Gaussians thinner than a pixel and ten times as long (at "
        f"most {NEEDLES_LIMIT:.0%} is usual). They follow the noise of few views: compare with --method fista-tv."
    )


def odd_views_warning(
    made: Reconstruction,
    prepared: PreparedProjections,
    selection: Selection,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> str:
    """The warning that the volume does not explain parts of some views; empty without such parts, and for direct
    methods.

    So it is of a volume that was stopped: who did that waits for it, and it differs from its views in many places.
    `progress` hears how many of how many views were compared.
    """
    if by_name(made.method).traits.direct or made.ending.early:
        return ""
    views = prepared.projections.data
    found = odd_views.odd_views(made.volume, views, prepared.geometry, prepared.ray_factors(), progress=progress)
    if not found:
        return ""
    first, side = (selection.rows or (0, 0))[0], selection.binning
    frames = prepared.projections.view_ids
    crossing = odd_views.on_a_line(found)
    places = [_crossing_sentence(crossing, frames, first, side)] if crossing else []
    places += [
        f"frame {prepared.projections.view_ids[odd.view]}, rows {first + odd.rows[0] * side} ... "
        f"{first + odd.rows[1] * side - 1}, columns {odd.cols[0] * side} ... {odd.cols[1] * side - 1} "
        f"(absorbs {'more' if odd.score > 0 else 'less'})"
        for odd in sorted((odd for odd in found if odd not in crossing), key=lambda odd: -abs(odd.score))[:_NAMED]
    ]
    unnamed = len(found) - len(crossing) - _NAMED
    more = f"; and {unnamed} more" if unnamed > 0 else ""
    return (
        f"{count(len(found), 'view')} with a part that is not in the volume, by more than {odd_views.LIMIT:g} times "
        f"what is usual there: {'; '.join(places)}{more}. Something was in the beam, or the sample was elsewhere: look "
        "at these frames."
    )
