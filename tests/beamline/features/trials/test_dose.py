"""`beamline study dose`: plans of equal time and equal dose, taken by the simulated instrument."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.config.load import config_folder
from beamline.features.trials import dose, runner
from beamline.features.trials.dose import plans_of
from beamline.features.trials.trial import Outcome, Trial
from beamline.features.trials.worker import DATA, VOLUME, TrialData, dump, load, run
from tests.beamline.cli.small_scan import beamline


def test_all_plans_of_a_kind_have_equal_dose_and_equal_time() -> None:
    plans = plans_of(360, 0.05, 0.1)
    for kind in {plan.kind for plan in plans}:
        some = [plan for plan in plans if plan.kind == kind]
        assert len({round(plan.views * plan.period, 9) for plan in some}) == 1  # of a step scan the least time
        assert len({round(plan.views * plan.exposure * plan.light, 9) for plan in some}) == 1
    assert max(plan.exposure * plan.light for plan in plans) == pytest.approx(0.05), "no frame is brighter"
    doses = {plan.kind: plan.views * plan.exposure * plan.light for plan in plans}
    assert doses["fly"] == pytest.approx(doses["step"]) == pytest.approx(doses["fly, short, bright"])
    assert doses["fly, short"] == pytest.approx(doses["fly"] / 4)


def test_each_plan_is_a_row_with_its_time_dose_and_blur(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dose, "_ONE_IN", (1, 4))
    monkeypatch.setattr(dose, "_KINDS", dose._KINDS[:2])
    monkeypatch.setattr(dose, "_LIGHT", 0.25)
    text = (config_folder() / "simulated.yaml").read_text(encoding="utf-8")
    for there, here in (
        ("[1080, 1968, 144, 160]", "[1148, 1968, 8, 160]"), ("views: 360", "views: 48"),
        ("low_deg: -5", "low_deg: -20"), ("acceleration_deg_s2: 60", "acceleration_deg_s2: 600"),
    ):  # fmt: skip
        text = text.replace(there, here, 1)
    (folder / "mine.yaml").write_text(text.replace("period_s: 0.1 ", "period_s: 0.2 ", 1), encoding="utf-8")
    prepared: list[TrialData] = []

    def trial(trial: Trial, work: Path, seed: int, limit: float, *, keep: bool) -> Outcome:
        prepared.append(data := load(work / DATA))
        figures, volume = run(trial, data, seed)
        dump(work / VOLUME, volume)
        return Outcome(trial, "done", **figures)

    monkeypatch.setattr(runner, "run_trial", trial)
    result = beamline("study", "dose", "mine.yaml", "-m", "fbp")
    assert result.exit_code == 0, result.output
    with (folder / "mine_dose" / "study.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["status"]: row["message"] for row in rows} == {"done": ""}
    assert [row["row"].partition(":")[0] for row in rows] == ["fly"] * 2 + ["step"] * 2 + ["step, in the time of fly"]
    many, few, stepped, _, in_time = (
        {name: float(row[name]) for name in ("views", "scan time", "dose", "blur", "psnr", "residual_held_out")}
        for row in rows
    )
    assert (many["views"], few["views"]) == (48, 12)
    assert few["dose"] == pytest.approx(many["dose"]) == pytest.approx(stepped["dose"])
    assert few["scan time"] == pytest.approx(many["scan time"], rel=0.1)
    assert in_time["scan time"] == pytest.approx(many["scan time"], rel=0.1)
    assert in_time["dose"] < few["dose"]
    assert few["blur"] == pytest.approx(4 * many["blur"]) and stepped["blur"] == 0 < many["blur"]
    assert stepped["psnr"] > few["psnr"] + 1 and stepped["residual_held_out"] < few["residual_held_out"]
    data = prepared[0]
    assert data.prepared.held_out is not None
    used, unseen = data.geometry.angles, data.prepared.held_out[1].angles
    assert np.abs(np.subtract.outer(unseen, used)).min() > 1e-3, "no plan took the views that judge"
    names: set[Any] = {path.name for path in (folder / "mine_dose").iterdir()}
    assert {"study.csv", "report.html", "quality.png", "slices_fbp.png"} <= names
