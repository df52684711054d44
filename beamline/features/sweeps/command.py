"""`beamline sweep`: one slice with each value of an option of `beamline recon`, as a sheet with scores."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING

import click

from beamline.cli.options import (
    Declared,
    json_option,
    name_of,
    option,
)
from beamline.cli.recipe import names_given
from beamline.cli.recon import options_of, recon
from beamline.cli.terminal import answering
from beamline.core.errors import ScanStopped
from beamline.core.files import refuse_existing, refuse_not_utf8, write_whole
from beamline.core.text import aligned, csv_text, safe_name
from beamline.features.sweeps.values import SweptOption, combinations, swept_option
from beamline.report.metrics import METRICS
from recon.methods import BASELINE

if TYPE_CHECKING:
    from beamline.features.sweeps.sweep import Scores, SweptSlice
    from beamline.reconstruct.options import ReconOptions

_OF_A_VOLUME = frozenset(
    ("output", "report", "write-config", "json", "dry-run", "max-residual", "truth", "uncertainty",
     "roi", "follow", "earlier", "memory", "cluster", "checkpoint", "resume", "budget",
     "time", "moves", "beside-scan")
)  # fmt: skip
"""Options of `beamline recon` that a slice has no use for."""

Trials = list[tuple[Mapping[str, str], "ReconOptions"]]


def sweepable() -> dict[str, click.Option]:
    """The options of `beamline recon` that may have several values, by long name."""
    own = {name_of(param): param for param in recon.params if isinstance(param, click.Option)}
    of_one_call = {name for name, param in own.items() if isinstance(param, Declared) and param.of_one_call}
    return {name: own[name] for name in sorted(own.keys() - _OF_A_VOLUME - of_one_call)}


@click.command(context_settings={"ignore_unknown_options": True, "help_option_names": ["-h", "--help"]})
@click.argument("words", nargs=-1, type=click.UNPROCESSED, metavar="FILE|RUN NAME=VALUES [NAME=VALUES]")
@option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The sheet, a .png; the table of scores is beside it, a .csv. Default: FILE's stem + _sweep.png, in this "
    "folder.",
)
@json_option
def sweep(words: tuple[str, ...], output: Path | None, as_json: bool) -> None:
    """Reconstruct one slice of the scan in FILE with each value of an option of `beamline recon`, and draw them.

    NAME is the long name of the option; VALUES are A:B:STEP or a,b,c: tv-weight=0.5:4:0.5, rings=none,sort,vo,
    axis=84:88:0.5. Two options make a grid. All other options of `beamline recon` hold for every slice; the method is
    fbp without -m.

    One of eight views is held out, and each volume is judged by what it leaves of these. The best is marked, and those
    that chance does not tell from it. The middle row is shown, of the rows that the method needs around it, or of
    --rows. Ctrl-C keeps the slices that are done (exit code 4).
    """
    options, common = _parsed(words)
    path = output or Path(f"{safe_name(Path(common[0]).stem) if common else 'scan'}_sweep.png")
    if path.suffix.lower() != ".png":
        raise click.UsageError(f"-o {path}: the sheet is a picture; give a name such as {path.with_suffix('.png')}.")
    trials = _trials(options, common)
    table = path.with_suffix(".csv")
    refuse_not_utf8(common[0])
    refuse_existing(path)
    refuse_existing(table)
    slices, scores = _run(trials, options, path, as_json)
    if not as_json and scores is not None and scores.best is not None:
        best = [word for item in slices[scores.best].values.items() for word in _as_words(*item)]
        again = shlex.join(["beamline", "recon", *common, *best])
        click.echo(f"If the pictures agree: {again}", err=True)
    if len(slices) < len(trials):
        raise ScanStopped(f"The sweep was stopped after {len(slices)} of {len(trials)} slices; {path} holds them.")


def _parsed(words: Sequence[str]) -> tuple[list[SweptOption], list[str]]:
    """The options with their values, and the words of `beamline recon` that are the same for all, its scan first."""
    with click.Context(recon, info_name="sweep") as context:
        taken, further, _ = recon.make_parser(context).parse_args(list(words))
    if (file := taken.get("file")) is None or not further:
        raise click.UsageError("give a scan, and an option with its values, such as tv-weight=0.5:4:0.5.")
    rest = list(words)
    for word in (str(file), *further):
        rest.remove(word)
    try:
        options = [swept_option(word, sweepable()) for word in further]
        combinations(options)
    except ValueError as error:
        raise click.UsageError(f"{error}.") from error
    return options, [str(file), *rest]


def _as_words(name: str, value: str) -> list[str]:
    """An option with a value, as `beamline recon` takes it. UsageError: a flag that is neither on nor off."""
    switch = sweepable()[name]
    if not switch.is_flag:
        return [f"--{name}={value}"]
    if value not in ("true", "false"):
        raise click.UsageError(f"{name}={value}: it is on or off; expected {name}=false,true.")
    names = switch.opts if value == "true" else switch.secondary_opts
    return [max(names, key=len)] if names else []


def _trials(options: Sequence[SweptOption], common: Sequence[str]) -> Trials:
    """Each combination of values with the options of its reconstruction. UsageError: values that are not taken, or that
    change nothing."""
    trials: Trials = []
    for values in combinations(options):
        own = [word for item in values.items() for word in _as_words(*item)]
        with recon.make_context("sweep", [*common, *own]) as context:
            trials.append((values, _options(context)))
        if len(trials) == 1:
            with recon.make_context("sweep", list(common)) as alone:
                twice = names_given(alone) & values.keys()
            if twice:
                raise click.UsageError(f"--{min(twice)} is swept: give its values once.")
    told = [
        (repr((each.source, each.selection, each.method)), each.quality, each.seed, each.device) for _, each in trials
    ]
    if all(each == told[0] for each in told[1:]):
        names = " and ".join(option.name for option in options)
        raise click.UsageError(f"{names} changes nothing of a slice by {trials[0][1].method.name}.")
    return trials


def _options(context: click.Context) -> ReconOptions:
    """The options of one reconstruction, of which no volume is written."""
    from beamline.reconstruct.options import OutputPaths

    if foreign := sorted(names_given(context) & _OF_A_VOLUME):
        raise click.UsageError(f"--{foreign[0]} belongs to a volume, and a sweep makes slices.")
    target = OutputPaths(Path(gettempdir()) / "slice.h5", None, replace=True, written=False)
    return replace(options_of(context, BASELINE), target=target)


def _run(
    trials: Trials, options: Sequence[SweptOption], path: Path, as_json: bool
) -> tuple[list[SweptSlice], Scores | None]:
    """Write the sheet and the table of the slices, as far as they were made."""
    from beamline.features.sweeps.sweep import scores_of, sliced, sweep_sheet, sweep_slices

    slices: list[SweptSlice] = []
    with answering(as_json) as answer:
        cut = sliced([each for _, each in trials])
        planned = [(values, each) for (values, _), each in zip(trials, cut, strict=True)]
        try:
            for each in sweep_slices(planned, answer.sink, answer.clock, answer.counting("slices")):
                slices.append(each)
        except KeyboardInterrupt:
            if not slices:
                raise
        slab, direct = cut[0].selection.rows, not cut[0].method.fitted
        scores = scores_of(slices, direct=direct)
        for sentence in _remarks(slices, scores, options, direct=direct):
            answer.warn(sentence)
        where = "" if slab is None else f", row {sum(slab) // 2}"
        title = f"{Path(cut[0].source.path).name}{where}, {slices[0].views.geometry.n_views} views"
        rows, names = _rows(slices, scores), [*slices[0].values]
        write_whole(path.with_suffix(".csv"), csv_text([[*names, "residual_held_out", "verdict", "seconds"], *rows]))
        write_whole(path, sweep_sheet(slices, scores, options, title))
        best = None if scores is None or scores.best is None else dict(slices[scores.best].values)
        means = None if scores is None else scores.shares.tolist()
        facts = {"output": str(path), "table": str(path.with_suffix(".csv")), "best": best, "scores": means}
        lines = aligned([[*names, METRICS["residual_held_out"].label, "", "s"], *rows], ">")
        answer.done(facts, lines, f"sheet     {path}", f"table     {facts['table']}")
    return slices, scores


def _remarks(
    slices: Sequence[SweptSlice], scores: Scores | None, options: Sequence[SweptOption], *, direct: bool
) -> list[str]:
    if scores is None:
        return ["No score: the values change pixels or views, so the slices cannot be compared with the same views."]
    remarks = []
    if direct:
        remarks.append(f"{BASELINE} leaves mostly the blur of its filter; -m fista-tv tells values apart better.")
    if not scores.same_views:
        remarks.append(
            "These values change the views that judge the slices: each is compared with the views of every value, "
            "which favours the middle of a range. Look at the pictures first."
        )
    if scores.best is None:
        low, high = scores.shares.min(), scores.shares.max()
        return [*remarks, f"All scores are nearly the same ({low:.4g} to {high:.4g}): they name no value."]
    best = slices[scores.best].values
    for each in options if scores.same_views else ():
        if len(each.values) > 2 and each.numbers and best[each.name] in (each.values[0], each.values[-1]):
            remarks.append(f"The best {each.name} is at the end of the range, {best[each.name]}: try further.")
    return remarks


def _rows(slices: Sequence[SweptSlice], scores: Scores | None) -> list[list[str]]:
    """A row for each slice: values, residual of views held out, whether it is the best or not significantly different,
    and seconds."""
    judged = [("", "")] * len(slices)
    if scores is not None:
        judged = [(f"{share:.6g}", verdict) for share, verdict in zip(scores.shares, scores.verdicts, strict=True)]
    return [[*each.values.values(), *words, f"{each.seconds:.3g}"] for each, words in zip(slices, judged, strict=True)]
