"""The simulated controllers of all stages, for tests that every driver must pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.drivers import pm16c_rig, zaber_rig
from tests.drivers.stages import pi_gcs_rig
from tests.drivers.stages.rig import StageRig


def pi_gcs(**build: Any) -> StageRig:
    """Without latency: on a real terminal the virtual clock stands while a reply is on its way."""
    return pi_gcs_rig.Rig(wire={"latency": 0.0}, **build)


RigOf = Callable[..., StageRig]
RIGS: dict[str, RigOf] = {"pm16c": pm16c_rig.Rig, "pi_gcs": pi_gcs, "zaber": zaber_rig.Rig}
every_stage = pytest.mark.parametrize("rig_of", RIGS.values(), ids=RIGS.keys())
