"""Writes docs/public_names.md: the public names and their required parameters, from the modules.

python -m tests.public_names        # in an environment with all extras

"""

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from recon.methods import REGISTRY

PAGE = Path(__file__).parents[1] / "docs" / "public_names.md"

# For scripts: everything in `__all__`.
FOR_SCRIPTS = ("recon", "beamline.api")

# With the extra `bluesky`; ophyd-async defines which methods of these classes can be called.
FOR_BLUESKY = {
    "beamline.bluesky.devices": ("Rotation", "TomoScan", "fly", "tomography"),
    "beamline.bluesky.camera": ("CameraDetector",),
}

# For packages that add and test devices, formats and methods.
FOR_PACKAGES = {
    "beamline.cli.options": (
        "as_scan", "json_events", "json_option", "parsed", "say", "set_option", "volume_argument", "volume_path",
    ),
    "beamline.cli.recipe": ("Repeatable", "typed_line"),
    "beamline.cli.terminal": ("Answer", "PageBeside", "Terminal", "answering"),
    "beamline.core.errors": (
        "AlarmError", "BeamlineError", "ConfigError", "DataError", "InstrumentError", "QualityError", "ScanStopped",
        "user_message",
    ),
    "beamline.core.files": ("parts_of", "refuse_existing", "text_in", "atomic_file", "write_together", "write_whole"),
    "beamline.core.text": ("count", "csv_text", "memory_size", "rounded", "safe_name", "size", "spans"),
    "beamline.core.quantities": ("VoxelKind",),
    "beamline.core.events": (
        "BlockDone", "BlockStarted", "Event", "RunStarted", "Sink", "StateEntered", "Warned", "json_of",
    ),
    "beamline.core.machine": ("free_memory",),
    "beamline.core.run_result": ("RunResult",),
    "beamline.core.sinks": ("Note",),
    "beamline.core.stop": ("ScanAborted", "StopRequest", "stop_signals"),
    "beamline.config.beam": ("NoBeamMonitor",),
    "beamline.config.load": ("load_as", "override_of", "resolved_yaml"),
    "beamline.config.models": (
        "Config", "Degrees", "Fields", "OpticsSection", "ReconSection", "SampleSection", "Seconds", "StorageSection",
        "TargetSection", "Views",
    ),
    "beamline.config.monitor": ("MonitorSection", "ReferencesSection"),
    "beamline.config.section": ("Section", "section_of"),
    "beamline.gaussians": ("Model", "read_model"),
    "beamline.monitor.digest": ("preview_shape",),
    "beamline.page.followed_run": ("PERIOD", "FollowedRun", "RunValues", "Severity", "StampedValues", "choice_of"),
    "beamline.plan.passes": ("Choice",),
    "beamline.plan.plan": ("Block", "FieldPlan", "Mode", "Place", "ScanPlan", "Timeline"),
    "beamline.report.figures": ("WIDTH", "draw_slice", "finish", "new_figure", "planes", "png"),
    "beamline.report.html": ("Picture", "render"),
    "beamline.scan.series": ("scans_of",),
    "beamline.scenes.scene_file": ("open_scene",),
    "beamline.scan.control": ("State", "Verb", "ask"),
    "beamline.scan.ledger": ("EXTRA", "LedgerError"),
    "beamline.scan.live_process": ("Standby",),
    "beamline.scan.measurement": ("FrameSource", "Measurement"),
    "beamline.scan.preflight": ("ReadyScan", "ready_scan"),
    "beamline.scan.run": ("record_scan",),
    "beamline.scan.runs": ("newest",),
    "recon.base.method": ("Method", "ReconProblem"),
    "recon.base.greys": ("html", "middle_slices"),
    "recon.base.method_kinds": ("Direct", "Iterative", "Series"),
    "recon.base.masks": ("masked",),
    "recon.base.setting": ("Count", "NonNegative", "Positive", "Setting", "setting"),
    "recon.base.view_data": ("Views",),
    "recon.features.reference.particle_states": (
        "STEPS", "ReferenceParticles", "ParticleFit", "StateNumbers", "fit_state", "numbers_of", "reference_particles",
    ),
    "recon.splatting.initialise": ("first_volume",),
    "recon.voxels.voxel_problem": ("density_unit",),
    "recon.testing": ("MethodConformance",),
    "beamline.projections.prepare": ("prepare_projections",),
    "beamline.projections.protocols": ("PlaceStep", "ScanPart", "ScanStep", "ViewStep"),
    "beamline.projections.selection": ("SelectedScan",),
    "beamline.projections.step": ("StepDone", "StepMemory", "option"),
    "beamline.projections.views": ("select",),
    "beamline.storage.interrupted": ("volume_file",),
    "beamline.storage.hdf5": ("created", "look_again", "open_hdf5", "readable"),
    "beamline.storage.frame_table": ("FrameTable",),
    "beamline.storage.readers.base": ("WHOLE", "ScanFormat", "ScanSource", "frame_indices"),
    "beamline.storage.readers.open": ("open_scan", "scan_format"),
    "beamline.storage.readers.reference_files": ("load_images",),
    "beamline.storage.scan_file": ("ScanFile", "opened"),
    "beamline.storage.writers.layout": ("ANGLE", "COUNT_TIME", "KIND", "TIME"),
    "beamline.storage.writers.nxtomo": ("ScanInfo",),
    "beamline.storage.writers.recon_file": ("new_plot",),
    "beamline.storage.volumes.files": ("opened_volume", "write_volume"),
    "beamline.storage.volumes.base": ("Pixels", "Slices", "VolumeFormat", "bare_record"),
    "beamline.monitor.check": ("Check", "CheckResult", "Flag", "Level", "Policy", "ScanContext"),
    "beamline.testing": ("ReaderConformance",),
    "drivers.base.clock": ("Clock", "SystemClock"),
    "drivers.base.errors": ("DeviceError", "DeviceRefused", "DeviceTimeout"),
    "drivers.base.frame": ("Frame", "FrameKind"),
    "drivers.base.protocols": (
        "Camera", "CameraFrame", "CameraSettings", "CameraTiming", "RotationStage", "StageLimits",
        "TriggerSource", "TriggerTrain",
    ),
    "beamline.config.devices": ("CameraDriver",),
    "drivers.epics.channel": ("ProcessVariable", "open_channel", "waited"),
    "drivers.stages.settings": ("StageDriver", "StageSettings"),
    "drivers.testing.camera": ("CameraConformance",),
    "drivers.testing.stages": ("StageConformance", "StepStageConformance"),
    "recon.post": ("clusters",),
    "recon.prep.matter": ("HEAVIEST", "edges_of"),
    "simulators.effects.catalogue": ("Domain",),
    "simulators.frame.sensor": ("largest_count",),
    "simulators.light": ("Beam",),
    "simulators.samples.materials.parts": ("Mixture",),
    "simulators.samples.materials.spectrum": ("light",),
    "simulators.scenes.expose": ("Scan", "expose"),
}  # fmt: skip

_OURS = ("beamline", "recon", "drivers", "simulators")


def lines(module: str) -> list[str]:
    """A line for each public name of a module, and one for each public member of its classes.

    After a name come its parameters without a default, in their order; those after a star are given by name.
    """
    loaded = import_module(module)
    named = {**FOR_BLUESKY, **FOR_PACKAGES}.get(module) or {*loaded.__all__}
    if module == "recon":  # including the methods in the folders of its features
        named = {*named, *(entry.cls for entry in REGISTRY.values())}
    told: list[str] = []
    for name in sorted(named):
        value = getattr(loaded, name)
        told.append(name + required(value))
        if inspect.isclass(value) and not name.endswith("Conformance") and module not in FOR_BLUESKY:
            told += [f"{name}.{member}" for member in members(value)]
    return told


def members(cls: type) -> Iterator[str]:
    """Our fields and methods of a class (not those of Python or a library); for a reconstruction method, its
    settings."""
    fields = {each.name for each in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set[str]()
    own = {name for base in cls.__mro__ if base.__module__.split(".")[0] in _OURS for name in vars(base)}
    for name in sorted(fields if fields and "takes" in own else fields | own):
        if not name.startswith("_"):
            member = inspect.getattr_static(cls, name, None)
            is_called = isinstance(member, staticmethod | classmethod) or inspect.isfunction(member)
            yield name + (required(getattr(cls, name), method=inspect.isfunction(member)) if is_called else "")


def required(value: Any, *, method: bool = False) -> str:
    """The parameters without a default, in brackets; "" for values that are not called, or are defined by a library.

    Args:
        method: leave the first one out.
    """
    if not callable(value) or hasattr(value, "__origin__") or (inspect.isclass(value) and not _has_parameters(value)):
        return ""
    parameters = list(inspect.signature(value).parameters.values())[1 if method else 0 :]
    needed = [each for each in parameters if each.default is each.empty and each.kind not in _SEVERAL]
    words = [each.name for each in needed if each.kind is not inspect.Parameter.KEYWORD_ONLY]
    by_name = [each.name for each in needed if each.kind is inspect.Parameter.KEYWORD_ONLY]
    return f"({', '.join([*words, *(['*', *by_name] if by_name else [])])})"


_SEVERAL = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def _has_parameters(cls: type) -> bool:
    """Whether scripts create objects of the class, with parameters that we define."""
    abstract = getattr(cls, "_is_protocol", False) or inspect.isabstract(cls)
    made_by = next(base for base in cls.__mro__ if "__init__" in vars(base) or "__new__" in vars(base))
    return not abstract and made_by.__module__.split(".")[0] in _OURS


def recorded(module: str) -> set[str]:
    """The lines of a module on the page."""
    match = re.search(rf"(?s)### {re.escape(module)}\n\n```text\n(.*?)\n```", PAGE.read_text(encoding="utf-8"))
    told: set[str] = set()
    for block in re.split(r"\n(?! )", match[1]) if match else ():
        head, *rest = re.sub(r"\n +", " ", block).split(": ", 1)
        told |= {head, *(f"{head.partition('(')[0]}.{member}" for each in rest for member in each.split("; "))}
    return told


def page() -> str:
    """The page as Markdown."""
    parts = [
        "# Public names",
        "With this page you can see which Python names you may rely on. The names below and their required parameters\n"
        "stay the same within a major version ([releases](releases.md#what-a-version-promises)). The required\n"
        "parameters are in brackets after the name; pass those after a star by keyword. A later version may add\n"
        "optional parameters. Any name that is not on this page may change with any version.\n\n"
        "Each entry is a function, a class or a value. The names after the colon are the public fields and methods of\n"
        "the class; for a reconstruction method, they are its settings.",
        "`python -m tests.public_names` writes this page, and a test compares it with the modules.",
        "## For scripts and notebooks",
        *map(_section, FOR_SCRIPTS),
        "## For plans of bluesky",
        *map(_section, FOR_BLUESKY),
        "## For packages that add devices, formats and methods",
        "A package registers what it adds under entry points: `splatline.method`, `splatline.correction`, and in the\n"
        "same way `reader`, `volume_format`, `stage`, `wire`, `camera`, `check` and `effect`\n"
        "([contributing](contributing.md)).",
        *map(_section, FOR_PACKAGES),
    ]
    return "\n\n".join(parts) + "\n"


def _section(module: str) -> str:
    blocks: dict[str, list[str]] = {}
    for line in lines(module):
        name, is_member, _ = line.partition("(")[0].partition(".")
        if is_member:
            head = next(each for each in blocks if each.partition("(")[0] == name)
            blocks[head].append(line.removeprefix(f"{name}."))
        else:
            blocks[line] = []
    told = [f"{head}: {'; '.join(each)}" if each else head for head, each in blocks.items()]
    wrapped = [
        line
        for each in told
        for line in textwrap.wrap(each, 110, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    ]
    return f"### {module}\n\n```text\n" + "\n".join(wrapped) + "\n```"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
