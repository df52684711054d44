"""Options that choose a part of a scan and say how it is to be read; the same for every command that reconstructs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from beamline.cli.option_groups import CORRECTIONS, DATA, heading
from beamline.cli.options import POSITIVE
from beamline.cli.scan_options import scan_options
from beamline.core.files import text_in
from recon.base.choices import FEW_PHOTONS, FlatFields, Noise, Rings

if TYPE_CHECKING:
    from beamline.projections.selection import Hardening, Phase, Selection
    from beamline.reconstruct.axis_trials import AxisRange
    from beamline.storage.readers.open import SourceOptions
    from recon.prep.resample import Distortion


def span(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """`first:end`, whole numbers."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]):
        raise click.BadParameter(f"{value!r} is not FIRST:END with 0 <= FIRST < END, e.g. 100:200")
    return int(match[1]), int(match[2])


def column(ctx: click.Context, param: click.Parameter, value: str) -> float | AxisRange | None:
    """A column of the detector, or several to try; None for "auto"."""
    if value == "auto":
        return None
    if value.startswith("try:"):
        from beamline.reconstruct.axis_trials import AxisRange

        try:
            first, last, step = (float(part) for part in value.split(":")[1:])
            return AxisRange(first, last, step)
        except ValueError as error:
            raise click.BadParameter(f"{value!r} is not try:FIRST:LAST:STEP, e.g. try:80:90:0.5 ({error})") from error
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise click.BadParameter(
            f"{value!r} is neither a column (0 is the centre of the first one), nor auto, nor try:FIRST:LAST:STEP"
        )
    return number


def distances(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, float] | None:
    """`sod:sdd` in mm."""
    if value is None:
        return None
    try:
        sod, sdd = (float(part) for part in value.split(":"))
    except ValueError:
        sod = sdd = math.nan
    if not 0 < sod <= sdd < math.inf:
        raise click.BadParameter(f"{value!r} is not SOD:SDD with 0 < SOD <= SDD in mm, e.g. 100:140")
    return sod, sdd


_MOST_TILT_DEG = 45.0


def tilt_of(ctx: click.Context, param: click.Parameter, value: str | None) -> float | str | None:
    """An angle within 45 degrees, or "auto"."""
    if value is None or value == "auto":
        return value
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not abs(number) <= _MOST_TILT_DEG:
        raise click.BadParameter(f"{value!r} is neither auto nor degrees within {_MOST_TILT_DEG:g} of 0")
    return number


def distortion_of(ctx: click.Context, param: click.Parameter, value: Path | None) -> Distortion | None:
    """The distortion that a text file says."""
    if value is None:
        return None
    from recon.prep.resample import Distortion

    try:
        return Distortion.parse(text_in(value))
    except (OSError, ValueError) as error:
        raise click.BadParameter(f"{value}: {error}") from error


def air_of(ctx: click.Context, param: click.Parameter, value: str) -> tuple[str | tuple[int, int], str | int]:
    """Which columns at the detector's edges show air, and the surface that is taken off; see `Selection`."""
    if match := re.fullmatch(r"(\d+),(\d+)", value):
        return (int(match[1]), int(match[2])), "none"
    if match := re.fullmatch(r"surface:([0-3])", value):
        return "auto", int(match[1])
    models = {"auto": ("auto", "auto"), "columns": ("auto", "none"), "none": ("none", "none")}
    if value not in models:
        raise click.BadParameter(
            f"{value!r} is not known; expected auto, none, columns, LEFT,RIGHT (numbers of columns, e.g. 12,12) or "
            f"surface:ORDER (0 to 3)"
        )
    return models[value]


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options of `Selection`, from --views to --gain, and what `scan_options` adds."""
    for option in reversed(_AFTER):
        command = option(command)
    command = scan_options(command)
    for option in reversed(_BEFORE):
        command = option(command)
    return command


def chosen(file: Path, seed: int, said: Mapping[str, Any]) -> tuple[SourceOptions, Selection]:
    """The scan and the part of it that the options in `said` name."""
    from beamline.projections.selection import Selection
    from beamline.storage.readers.open import SourceOptions
    from recon.prep.correct import CorrectionSettings

    rest = dict(said)
    if rest["axis"] is not None and not isinstance(rest["axis"], float):
        raise click.UsageError("--axis try is for beamline recon.")
    pixel_size_um, tilt = rest.pop("pixel_size_um"), rest.pop("tilt")
    columns, surface = rest.pop("air")
    selection = Selection(
        views=rest.pop("views"),
        rows=rest.pop("rows"),
        binning=rest.pop("binning"),
        axis_col=rest.pop("axis"),
        pixel_size_mm=None if pixel_size_um is None else pixel_size_um * 1e-3,
        cone=rest.pop("cone"),
        correction=CorrectionSettings(air=columns),
        surface=surface,
        seed=seed,
        use_flags=rest["flags"] != "ignore",
        judge=rest.pop("flags") == "judge",
        accept_references=rest.pop("references") == "accept",
        noise=rest.pop("noise"),
        rings=rest.pop("rings"),
        flat_fields=rest.pop("flat_fields"),
        use_current=rest.pop("ring_current") == "use",
        gain=rest.pop("gain"),
        phase=_phase(rest),
        hardening=_hardening(rest.pop("hardening")),
        tilt_deg=tilt if isinstance(tilt, float) else None,
        find_tilt=tilt == "auto",
        distortion=rest.pop("distortion"),
    )
    if selection.gain is not None and selection.noise == "log":
        raise click.UsageError("--gain is for counted photons; it does not go with --noise log.")
    return SourceOptions(file, **rest), selection


def phase_of(ctx: click.Context, param: click.Parameter, value: str) -> str | None:
    """What `paganin:` is followed by; None for "none"."""
    way, _, material = value.partition(":")
    if value != "none" and (way != "paganin" or not material):
        raise click.BadParameter(
            f"{value!r} is not known; expected none, paganin:RATIO (delta/beta) or paganin:MATERIAL"
        )
    return material or None


def unsharp_mask(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, float] | None:
    """`sigma:weight`."""
    if value is None:
        return None
    try:
        sigma, weight = (float(part) for part in value.split(":"))
    except ValueError:
        sigma = weight = math.nan
    if not (0 < sigma < math.inf and 0 <= weight < math.inf):
        raise click.BadParameter(f"{value!r} is not SIGMA:WEIGHT with SIGMA > 0 in pixels, e.g. 1.5:2")
    return sigma, weight


def _phase(rest: dict[str, Any]) -> Phase | None:
    """Phase retrieval by its options, which are taken out of `rest`."""
    from beamline.projections.selection import Phase

    material, *others = (rest.pop(name) for name in ("phase", "distance_mm", "energy_kev", "unsharp"))
    if material is None:
        if any(other is not None for other in others):
            raise click.UsageError("--distance-mm, --energy-kev and --unsharp are for --phase.")
        return None
    try:
        ratio = float(material)
    except ValueError:
        from recon.prep.matter import delta_beta

        return Phase(material, partial(delta_beta, material), *others)
    if not 0 <= ratio < math.inf:
        raise click.UsageError(f"--phase: delta/beta is 0 or more, got {material}.")
    return Phase(material, lambda _: ratio, *others)


def hardening_of(ctx: click.Context, param: click.Parameter, value: str) -> str | None:
    """`fit` or `material:beam`; None for "none"."""
    if value not in ("none", "fit") and not re.fullmatch(r"[^:]+:.+", value):
        raise click.BadParameter(
            f"{value!r} is not known; expected none, fit or MATERIAL:BEAM (Al:60kV,Al=1 is a tube behind 1 mm Al; or "
            f"Al:FILE)"
        )
    return None if value == "none" else value


def _hardening(value: str | None) -> Hardening | None:
    """Correction of beam hardening by its option."""
    from beamline.projections.selection import Hardening

    if value is None or value == "fit":
        return None if value is None else Hardening(value)
    from beamline.projections.beam import in_beam

    try:
        return Hardening(value, in_beam(*value.split(":", 1)))
    except ValueError as error:
        raise click.UsageError(f"--hardening {value}: {error}.") from error


_BEFORE = (
    heading(DATA),
    click.option(
        "--views",
        default="all",
        show_default=True,
        metavar="SPEC",
        help="all | fixed:N | sector:A-B[:N] (degrees) | random:N[:SEED] | first:N | every:K",
    ),
    click.option(
        "--rows",
        callback=span,
        metavar="FIRST:END",
        help="Detector rows to use; the volume has one slice per row. Default: all.",
    ),
    click.option(
        "--bin",
        "binning",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        help="Average blocks of N x N pixels.",
    ),
    click.option(
        "--axis",
        callback=column,
        metavar="PX|auto|try:A:B:STEP",
        default="auto",
        show_default=True,
        help="Rotation axis: column of the unbinned detector (0: centre of the first column), or auto to find it. "
        "recon with try:80:90:0.5 draws one slice by each of these axes with its score (PNG), and ends.",
    ),
)
_AFTER = (
    heading(CORRECTIONS),
    click.option(
        "--tilt",
        callback=tilt_of,
        metavar="DEGREES|auto",
        help="By how much the rotation axis leans in the detector's plane (its column grows with the rows): views are "
        "turned. auto finds it by all rows. Default: views are used as they are, with a warning if they show a tilt.",
    ),
    click.option(
        "--distortion",
        type=click.Path(path_type=Path),
        callback=distortion_of,
        metavar="FILE",
        help="Radial distortion of the lens, which is taken out of the views: the text file that discorpy writes "
        "(backward model: xcenter, ycenter, factor0 ...).",
    ),
    heading(DATA),
    click.option(
        "--pixel-size-um",
        type=POSITIVE,
        help="Pixel size at the sample (cone beam: on the detector). Default: as in the file.",
    ),
    click.option(
        "--cone",
        callback=distances,
        metavar="SOD:SDD",
        help="Cone beam: mm from the source to the rotation axis and to the detector. Default: as in the file.",
    ),
    heading(CORRECTIONS),
    click.option(
        "--air",
        callback=air_of,
        metavar="auto|none|columns|LEFT,RIGHT|surface:ORDER",
        default="auto",
        show_default=True,
        help="Level the air of each view at zero. columns: take off the line through the air at both edges. "
        "LEFT,RIGHT: from so many columns. surface:0 to 3: take off a polynomial through all rays that miss the "
        "sample, too. auto: the surface where the views confirm it.",
    ),
    click.option(
        "--flags",
        type=click.Choice(["use", "judge", "ignore"]),
        default="use",
        show_default=True,
        help="use: leave out views with an alarm of the monitor, halve the weight of views or regions with a warning, "
        "correct views after a jump of the sample. judge: let the monitor look at the frames first. ignore: take "
        "all views alike.",
    ),
    click.option(
        "--references",
        type=click.Choice(["check", "accept"]),
        default="check",
        show_default=True,
        help="check: leave out groups of darks and flats that are saturated, dark, uneven or lit; refuse the scan if "
        "no group is left. accept: use all as they are.",
    ),
    click.option(
        "--noise",
        type=click.Choice(get_args(Noise)),
        default="auto",
        show_default=True,
        help="log: line integrals are logarithms of counts. counts: line integrals and weights carry the likelihood "
        f"of the photons counted, for few photons. auto: counts where a pixel of the open beam has fewer than "
        f"{FEW_PHOTONS}.",
    ),
    click.option(
        "--flat-fields",
        type=click.Choice(get_args(FlatFields)),
        default="groups",
        show_default=True,
        help="groups: interpolate the flat of a view between the means of groups of flats. dynamic: add the changes "
        "of the flats that the view shows, for a beam that moves (4 flats or more).",
    ),
    click.option(
        "--ring-current",
        type=click.Choice(["ignore", "use"]),
        default="ignore",
        show_default=True,
        help="use: views and flats are divided by the current of each frame in the file (control/data of NXtomo).",
    ),
    click.option(
        "--rings",
        type=click.Choice(get_args(Rings)),
        default="none",
        show_default=True,
        help="Stripes of the sinograms, which make rings. sort: small ones; vo: dead columns, large and small ones; "
        "wavelet: by their wavelets; auto: sort or vo where there are some, and says so.",
    ),
    click.option(
        "--phase",
        callback=phase_of,
        metavar="none|paganin:X",
        default="none",
        show_default=True,
        help="Phase retrieval from one distance (Paganin); X is delta/beta, or a material: a chemical formula or a "
        "name that scenes know.",
    ),
    click.option(
        "--distance-mm", type=POSITIVE, help="For --phase: from the sample to the detector. Default: as in the file."
    ),
    click.option("--energy-kev", type=POSITIVE, help="For --phase. Default: as in the file."),
    click.option(
        "--unsharp",
        callback=unsharp_mask,
        metavar="SIGMA:WEIGHT",
        help="For --phase: unsharp mask after it, which gives fine detail back; SIGMA in pixels.",
    ),
    click.option(
        "--hardening",
        callback=hardening_of,
        metavar="none|fit|MATERIAL:BEAM",
        default="none",
        show_default=True,
        help="Beam hardening of a sample of one material. fit: by its own views; BEAM: 60kV (a tube), 60kV,Al=1,Cu=0.1 "
        "(behind mm of filters), or a text file of lines: keV weight.",
    ),
    click.option(
        "--gain", type=POSITIVE, metavar="COUNTS", help="Counts a photon, for --noise. Default: as the flats vary."
    ),
)
