"""Dose: scans of the simulated instrument by plans of equal time or equal dose, as the rows of a study."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from beamline.config.load import load, plan_of, scene_mapping
from beamline.core.errors import ConfigError
from beamline.core.files import refuse_existing
from beamline.core.sinks import Warn
from beamline.features.trials.runner import ComparedScan, table_of
from beamline.features.trials.trial import TrialTable
from beamline.features.trials.view_choices import DOSE, SCAN_TIME, ViewChoice
from beamline.features.trials.worker import TrialData
from beamline.instrument.connect import connect
from beamline.instrument.simulated import axis_col_of, scene_of
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.plan import times_of
from beamline.scan.run import run_scan
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.ray_width import NO_WIDTH
from recon.base.volume import Grid

_ONE_IN = 1, 2, 4, 8  # of the configured views
_SHORTER = 4.0  # exposures of the last two kinds
_LIGHT = 1 / _ONE_IN[-1]  # a frame of the fewest views then has as much light as one of the configuration
_KINDS = (
    ("fly", 1.0, 1.0),
    ("step", 1.0, 1.0),
    ("fly, short", _SHORTER, 1.0),
    ("fly, short, bright", _SHORTER, _SHORTER),
)
_LEAST = 0.1  # of an exposure is left where a step scan is to take no longer than a fly scan
_JUDGES = 16  # standing views, between those of all plans, that judge them, and frames of each


@dataclass(frozen=True)
class DosePlan:
    """How a scan is taken: `mode` and what is special; exposure and period in s; `light` over the configuration's."""

    kind: str
    views: int
    exposure: float
    period: float
    light: float
    frames_per_view: int = 1
    start: float = 0.0  # offset of the first view, in steps between views

    @property
    def label(self) -> str:
        """Of its row."""
        return f"{self.kind}: {self.views} views of {self.exposure:.3g} s"


def plans_of(views: int, exposure: float, period: float) -> list[DosePlan]:
    """Plans with falling numbers of views and equal light in all of them; step scans as fast as the stage can."""
    return [
        DosePlan(
            kind, views // n, exposure * n / shorter, (exposure if kind == "step" else period) * n, _LIGHT * brighter
        )
        for kind, shorter, brighter in _KINDS
        for n in _ONE_IN
    ]


@dataclass(frozen=True, eq=False)
class _Instrument:
    """The simulated instrument: its scene, in which motion blurs, and the first angle and the range in degrees."""

    scan: ComparedScan
    scene: Mapping[str, Any]
    start: float
    span: float
    axis_col: float

    def take(self, plan: DosePlan, warn: Warn, begun: int = 0) -> tuple[PreparedProjections, ViewChoice, F32]:
        """The corrected views, the choice of views of this row, counted from `begun`, and the truth [z, y, x].

        Raises:
            ConfigError: the instrument cannot take such a scan.
        """
        start = self.start + plan.start * self.span / plan.views
        beam = {**self.scene["beam"], "photons_per_s": self.scene["beam"]["photons_per_s"] * plan.light}
        overrides = {
            "scan.mode": plan.kind.partition(",")[0], "scan.exposure_s": plan.exposure, "scan.period_s": plan.period,
            "scan.frames_per_view": plan.frames_per_view, "scan.energies": None,
            "scan.angles": {"scheme": "fixed", "views": plan.views, "start_deg": start, "span_deg": self.span},
            "simulation.scene": {**self.scene, "beam": beam}, "simulation.clock": "virtual",
        }  # fmt: skip
        words = [f"{key}={json.dumps(value)}" for key, value in overrides.items()]
        config = load(self.scan.source.path, words, rehearse=True)
        selection = replace(self.scan.selection, axis_col=self.axis_col)
        with TemporaryDirectory() as folder, connect(config) as instrument:
            path = run_scan(config, Path(folder), instrument=instrument).path
            with replace(self.scan.source, path=path, frames_per_view=plan.frames_per_view).open() as source:
                prepared = prepare_projections(source, selection, warn).without_warnings
                seconds = float(np.ptp(times_of(source, prepared.projections.view_ids, warn))) + plan.exposure
                rows = source.shape[0]
            assert instrument.truth is not None  # of a simulated instrument
            grid, (first, end) = Grid.matching(prepared.geometry), selection.rows or (0, rows)
            if not prepared.geometry.is_cone:  # heights are those from the middle of these rows
                last = first + (end - first) // selection.binning * selection.binning
                z, y, x = grid.centre
                pitch = grid.spacing[0] / selection.binning
                grid = replace(grid, centre=(z + (first + last - rows) / 2 * pitch, y, x))
            truth = instrument.truth(grid).data
        turning = math.radians(self.span) / plan.views / plan.period if plan.kind.startswith("fly") else 0.0
        blur = abs(turning) * plan.exposure * prepared.geometry.reach / prepared.geometry.sample_pitch
        photons = plan.views * plan.exposure * plan.light * self.scene["beam"]["photons_per_s"]
        facts = {"exposure": plan.exposure, "light": plan.light, SCAN_TIME: seconds, DOSE: photons, "blur": blur}
        views = [[begun + view] for view in range(prepared.geometry.n_views)]
        return prepared, ViewChoice(plan.label, views, facts=facts, arc=prepared.geometry.width.arc), truth


def taken_scans(scan: ComparedScan, title: str, warn: Warn) -> tuple[TrialData, TrialTable, Sequence[ViewChoice]]:
    """Scans by all plans as one set of views, with views held out that no plan took, and the views of each plan.

    Args:
        scan: its source is a configuration; a real instrument's is rehearsed.
        title: of the table.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    refuse_existing(scan.folder)
    config = load(scan.source.path, ["simulation.clock=virtual"], rehearse=True)
    scene, angles, planned = dict(scene_mapping(config)), config.scan.angles, plan_of(config)
    effects = scene.get("effects") or []
    if not any("motion_blur" in (each, *(each if isinstance(each, dict) else ())) for each in effects):
        scene["effects"] = ["motion_blur", *effects]
    instrument = _Instrument(
        scan,
        scene,
        getattr(angles, "start_deg", 0.0),
        getattr(angles, "span_deg", 180.0),
        axis_col_of(config, scene_of(config)),
    )
    judges = DosePlan(
        "step", _JUDGES, planned.exposure, planned.period, 1.0, _JUDGES, start=0.382
    )  # of the golden ratio: no fraction
    judge, _, truth = instrument.take(judges, warn)
    taken, choices = list[tuple[DosePlan, PreparedProjections, ViewChoice]](), list[ViewChoice]()

    def take(plan: DosePlan) -> None:
        try:
            prepared, choice, _ = instrument.take(plan, warn, sum(each.n_views for _, _, each in taken))
        except ConfigError as error:
            choices.append(ViewChoice(plan.label, None, reason=str(error)))
        else:
            taken.append((plan, prepared, choice))
            choices.append(choice)

    for plan in plans_of(planned.n_views // planned.frames_per_view, planned.exposure, planned.period):
        take(plan)
    flown = next((choice.facts[SCAN_TIME] for plan, _, choice in taken if plan.kind == "fly"), math.inf)
    for plan, _, choice in [each for each in taken if each[0].kind == "step"]:
        exposure = plan.exposure - (choice.facts[SCAN_TIME] - flown) / plan.views
        if _LEAST * plan.exposure <= exposure < plan.exposure:
            take(replace(plan, kind="step, in the time of fly", exposure=exposure, period=exposure))
    if not taken:
        raise ConfigError(f"{scan.source.path}: no plan can be taken. {choices[-1].reason}")
    prepared = joined([each for _, each, _ in taken])
    unseen = judge.projections.data, judge.geometry.seen_with(NO_WIDTH)
    data = TrialData(replace(prepared, held_out=unseen), truth)
    return data, table_of(scan, "study", title, prepared, {"configuration": str(scan.source.path)}), choices


def joined(parts: Sequence[PreparedProjections]) -> PreparedProjections:
    """The views of several scans of one set-up as those of one, without the width of their rays."""
    names = ("data", "view_ids", "air", *(() if parts[0].projections.weights is None else ("weights",)))
    of_views: dict[str, Any] = {
        name: np.concatenate([getattr(each.projections, name) for each in parts]) for name in names
    }
    measured = [each.measured for each in parts if each.measured is not None]
    return replace(
        parts[0],
        projections=replace(parts[0].projections, **of_views),
        geometry=reduce(Geometry.followed_by, (each.geometry for each in parts)).seen_with(NO_WIDTH),
        measured=np.logical_and.reduce(measured) if measured else None,
    )
