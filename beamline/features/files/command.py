"""`beamline info`, `validate`, `ingest`: describe, check and convert scans and volumes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import POSITIVE, as_scan, json_option, scan_argument
from beamline.cli.recipe import DATA, OUTPUT, Grouped, heading
from beamline.cli.selection_options import dose_request, light_options, scan_options
from beamline.cli.terminal import answering
from beamline.core.errors import DataError
from beamline.core.events import RuleBroken
from beamline.core.files import refuse_existing, write_whole
from beamline.core.text import SENTENCE, aligned, count, one_line, printable

if TYPE_CHECKING:
    from beamline.projections.scan_statistics import DoseRequest
    from beamline.storage.readers.open import SourceOptions

_PATH = click.Path(path_type=Path)


@click.command(
    cls=Grouped,
    first=(
        "statistics", "output", "truth", "masks", "as_json", "quantity", "angles", "darks", "flats", "data_path",
    ),
)  # fmt: skip
@scan_argument
@heading(DATA)
@scan_options
@heading(OUTPUT)
@click.option(
    "--statistics",
    is_flag=True,
    help="For a scan: print range, percentiles, mean and saturated pixels of the stored values, before any correction.",
)
@click.option(
    "-o", "--output", metavar="PNG", type=_PATH, help="With --statistics: write the histograms to this PNG file."
)
@light_options
@click.option(
    "--truth",
    metavar="FILE",
    help="For a volume: print PSNR and SSIM against this ground truth (FILE, or FILE:FIRST:END for some slices).",
)
@click.option(
    "--masks",
    metavar="FILE",
    type=_PATH,
    help="For a volume: print SNR and CNR in the regions of this label image, in which 1 is dense and 2 is empty.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event to stdout.")
def info(
    file: Path,
    statistics: bool,
    output: Path | None,
    truth: str | None,
    masks: Path | None,
    as_json: bool,
    photons_per_count: float | None,
    dose_in: str | None,
    **scan_facts: Any,
) -> None:
    """Describe the scan or volume in FILE: frames, angles, geometry, and problems of the file.

    \b
    beamline info SCAN.h5
    beamline info SCAN.h5 --statistics -o histograms.png
    beamline info VOLUME.h5 --truth TRUTH.h5

    --statistics reads up to 64 darks, 64 flats and 64 projections, spread over the scan. --masks takes regions that
    you have drawn, for example as a TIFF of labels. "SSIM 3D" is the value that reports show. "SSIM whole slices" is
    computed from means and variances of whole slices, without windows.
    """
    from beamline.features.files.validate import describe
    from beamline.storage.readers.open import SourceOptions

    requested_dose = dose_request(photons_per_count, dose_in)
    if (output is not None or requested_dose is not None) and not statistics:
        raise click.UsageError("-o and --photons-per-count work only with --statistics.")
    if statistics and (truth or masks):
        raise click.UsageError(
            "--statistics is for scans, --truth and --masks are for volumes: leave out the options that do not fit."
        )
    if statistics:
        _print_statistics(SourceOptions(file, **scan_facts), output, requested_dose, as_json)
    elif truth or masks:
        _print_measured(file, truth, masks, as_json)
    else:
        with answering(as_json) as answer:
            facts = dict(describe(SourceOptions(file, **scan_facts)))
            answer.done(facts, *_described(facts))


def _described(facts: Mapping[str, Any]) -> list[str]:
    """The facts about a scan or a volume as lines."""
    from beamline.storage.flag_legend import counted

    listed_separately = ("attributes", "not_used", "findings")
    shown = {name: value for name, value in facts.items() if name not in listed_separately}
    if shown.get("flags") is not None:
        shown["flags"] = counted(shown["flags"])
    for name in listed_separately[:2]:
        shown |= facts.get(name, {})
    width = max(map(len, shown)) + 2
    lines = [f"{name:<{width}}{_text(value)}" for name, value in shown.items()]
    return [*lines, *(f"! {message}" for message in facts["findings"])]


def _print_statistics(
    scan: SourceOptions, output: Path | None, requested_dose: DoseRequest | None, as_json: bool
) -> None:
    from beamline.monitor.digest import LARGEST
    from beamline.projections.scan_statistics import histograms, photon_dose_of, statistics_of, table
    from beamline.storage.readers.open import open_scan

    with answering(as_json) as answer:
        if output is not None:
            refuse_existing(output)
        with open_scan(scan) as source:
            if requested_dose is not None:
                requested_dose.refuse_impossible(source)
            statistics = statistics_of(source, answer.counting("statistics"))
            dose = [] if requested_dose is None else photon_dose_of(source, statistics, requested_dose).in_words()
        rows = table(statistics)
        if output is not None:
            write_whole(output, histograms(statistics))
        facts = {kind: dict(zip(rows[0][1:], figures, strict=True)) for kind, *figures in rows[1:]}
        lines = [aligned(rows, ">"), *(f"light   {line}" for line in dose)]
        missing_text = (
            f"! Not included above: pixels without data (not finite, or above {LARGEST:g}, which no detector counts)."
        )
        lines += [missing_text] * any(each.not_finite for each in statistics)
        lines += [] if output is None else [f"output  {output}"]
        answer.done({**facts, "light": dose, "output": output}, *lines)


def _print_measured(file: Path, truth: str | None, masks: Path | None, as_json: bool) -> None:
    from beamline.reconstruct.truth import measured_file
    from beamline.report.metrics import METRICS, formatted

    with answering(as_json) as answer:
        values = measured_file(file, truth, masks)
        answer.done(values, *(f"{METRICS[name].label:<20}{formatted(name, value)}" for name, value in values.items()))


def _text(value: Any) -> str:
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{n} {name}" for name, n in value.items())
    if isinstance(value, tuple | list):
        return " x ".join(str(v) for v in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    text = printable("; ".join(str(value).splitlines()))
    return text if len(text) <= 160 else text[:157] + "..."


@click.command()
@scan_argument
@scan_options
@click.option(
    "--deep",
    is_flag=True,
    help="Also read every frame and compare its pixels with the stored checksum. The check then takes longer.",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print JSON to stdout instead of text: one event per finding, then the counts.",
)
def validate(file: Path, deep: bool, as_json: bool, **scan_facts: Any) -> None:
    """Check whether the scan in FILE can be reconstructed, or whether a volume file is intact.

    \b
    beamline validate SCAN.h5
    beamline validate SCAN.h5 --deep    also read and check every frame

    Prints one line per finding: an error (it cannot be reconstructed as it is), a warning, or information.

    Exit code: 0 no error (but there may be warnings), 5 errors.
    """
    from beamline.features.files.validate import validate as findings_of
    from beamline.storage.readers.open import SourceOptions

    with answering(as_json) as answer:
        progress = answer.counting("validate") if deep else None
        findings, now = findings_of(SourceOptions(file, **scan_facts), progress), answer.clock.now()
        counts = {severity: sum(f.severity == severity for f in findings) for severity in ("error", "warning", "info")}
        for finding in findings:
            answer.sink(RuleBroken(finding.severity, finding.rule, finding.message, time=now))
        errors = count(counts["error"], "error")
        lines = [
            f"{finding.severity:<9}{finding.rule:<16}{one_line(finding.message, SENTENCE)}" for finding in findings
        ]
        answer.done(
            {"file": file, **counts},
            *lines,
            f"{one_line(str(file), SENTENCE)}: {errors}, {count(counts['warning'], 'warning')}",
        )
    if counts["error"]:
        raise DataError(f"{file} has {errors}; stdout lists them.")


@click.command(
    cls=Grouped,
    first=(
        "pixel_size_um", "energy_kev", "sample", "no_data", "angles", "darks", "flats", "data_path", "quantity",
        "as_json",
    ),
)  # fmt: skip
@click.argument("source", type=_PATH, metavar="IN", callback=as_scan)
@click.argument("output", type=_PATH, metavar="OUT.h5")
@heading(DATA)
@scan_options
@heading(OUTPUT)
@click.option(
    "--pixel-size-um",
    type=POSITIVE,
    help="Pixel size at the sample in µm, if the file IN states none or a wrong value.",
)
@click.option("--energy-kev", type=POSITIVE, help="Photon energy in keV, if the file IN states none or a wrong value.")
@click.option(
    "--sample", help="Name of the sample, which the file will state. Default: the name in IN, or its file name."
)
@click.option(
    "--no-data", type=float, help='Pixel value that means "no data". These pixels are not counted in the statistics.'
)
@json_option
def ingest(
    source: Path,
    output: Path,
    pixel_size_um: float | None,
    energy_kev: float | None,
    sample: str | None,
    no_data: float | None,
    as_json: bool,
    **scan_facts: Any,
) -> None:
    """Convert the scan IN of any format into one new HDF5 file, OUT.h5.

    \b
    beamline ingest IMAGES SCAN.h5 --angles angles.txt --flats FLATS

    IN is a multi-page TIFF, a folder or .zip of images, .npy, Zarr, .txrm or HDF5 (with --data-path, if its layout is
    not known). Frames are copied one at a time, each with statistics and a preview. No file is overwritten.
    """
    from beamline.features.files.ingest import ingest as ingest_scan
    from beamline.storage.readers.open import SourceOptions

    with answering(as_json) as answer:
        refuse_existing(output)
        done = ingest_scan(
            SourceOptions(source, **scan_facts),
            output,
            pixel_size_mm=None if pixel_size_um is None else pixel_size_um * 1e-3,
            energy_kev=energy_kev,
            sample=sample,
            no_data=no_data,
            progress=answer.counting("ingest"),
        )
        seconds = answer.seconds
        answer.done(
            {**vars(done), "output": done.path, "seconds": seconds},
            f"output   {done.path} ({done.definition})",
            f"frames   {done.frames} ({done.invalid_frames} of them without a valid pixel)",
            *(f"! {doubt}" for doubt in done.doubts),
            f"speed    {done.pixel_bytes / max(seconds, 1e-9) / 1e6:.0f} MB/s",
        )
