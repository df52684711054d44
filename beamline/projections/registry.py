"""Registry of the correction steps, one line per step. For a new correction, add a file and a line here. A plug-in
needs no line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from typing import TYPE_CHECKING, Any

from beamline.projections.protocols import GeometryStep, PlaceStep, PrepStep, ScanStep, ViewStep
from beamline.projections.step import StepDone, key_of, options_of
from recon.base.registry import Registry, in_folders

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.storage.recon_record import Value

_OF_FEATURES = in_folders("beamline.projections.corrections", "STEPS")
REGISTRY: dict[str, str] = {
    "TiltAndLens": "corrections.resampling",
    "Air": "corrections.air",
    "Preparation": "preparation",
    "PosesOfFile": "corrections.poses",
    "Width": "corrections.width",
    **{step: f"corrections.{module}" for step, module in _OF_FEATURES.items()},
}
"""Classes of the steps and their modules. Help lists options in this order. A folder in `corrections` lists its own
steps in STEPS.
"""


@cache
def registered() -> tuple[type[PrepStep], ...]:
    """Every step in the order of the registry. Steps of add-ons come last."""
    ours: list[type[PrepStep]] = [
        getattr(import_module(f"beamline.projections.{module}"), cls) for cls, module in REGISTRY.items()
    ]
    by_name = {step.name: step for step in ours}
    taken = {option.name for step in ours for option in options_of(step).values()}

    def fitting(name: str, step: type[PrepStep]) -> type[PrepStep]:
        names_of_options = {option.name for option in options_of(step).values()}
        if step.name != name or not isinstance(step(), ViewStep | PlaceStep | ScanStep):
            raise ValueError(
                f"{step.__name__} is not a ViewStep, PlaceStep or ScanStep with the name of the entry point"
            )
        if names_of_options & taken:
            raise ValueError(
                f"rename the options {sorted(names_of_options & taken)} of the step, because other correction steps "
                "have options of the same names"
            )
        if not by_name.keys() >= set(step.follows):
            raise ValueError(
                "the attribute `follows` of the step names unknown steps: "
                f"{sorted(set(step.follows) - by_name.keys())}; known steps are {sorted(by_name)}"
            )
        taken.update(names_of_options)
        return step

    return tuple(Registry("correction", by_name, fitting).values())


@cache
def all_steps() -> tuple[type[PrepStep], ...]:
    """Every step, each after the steps that it `follows`."""
    by_name: dict[str, type[PrepStep]] = {step.name: step for step in registered()}
    order = TopologicalSorter({name: step.follows for name, step in by_name.items()}).static_order()
    return tuple(by_name[name] for name in order if name in by_name)  # a step may follow a step that a feature provides


def in_order(selection: Selection) -> list[PrepStep]:
    """Every step with the settings of the selection, each after the steps that it `follows`."""
    return [selection.step(kind) for kind in all_steps()]


def geometry_steps(selection: Selection) -> list[GeometryStep]:
    """The steps that can find the geometry from the projections, with the settings of the selection."""
    return [step for step in in_order(selection) if isinstance(step, GeometryStep)]


def steps_of(values: Mapping[str, Any]) -> tuple[PrepStep, ...]:
    """All steps with these values of their options. The keys are those of `key_of`.

    Raises:
        ValueError: options of a step exclude each other.
    """
    return tuple(
        step(**{field: values[key_of(option.name)] for field, option in options_of(step).items()})
        for step in registered()
    )


def recorded(steps: Sequence[PrepStep], done: Mapping[str, StepDone]) -> dict[str, Value]:
    """What the file of a volume records about the steps, by name."""
    records: dict[str, Value] = {}
    options = {step.name: _options(step) for step in steps}
    for name in {**options, **done}:
        did = done.get(name, StepDone())
        sentence = {f"{name}_said": did.sentence} if did.sentence else {}
        records |= options.get(name, {}) | sentence if did.parameters is None else did.parameters
    return records


def _options(step: PrepStep) -> dict[str, Value]:
    """The values of a step's options."""
    values = {key_of(option.name): getattr(step, field) for field, option in options_of(type(step)).items()}
    return {key: value if isinstance(value, int | float) else str(value) for key, value in values.items()}
