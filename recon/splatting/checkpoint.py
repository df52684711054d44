"""Checkpoint of a fit: its complete state as plain arrays, which restore the fit bit for bit. Nothing is pickled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.splatting import optimise as fit
from recon.splatting.backend import Backend, Cpu
from recon.splatting.optimise import FitState, settle
from recon.splatting.problem import FitProblem
from recon.splatting.settings import NAMES, FitSettings

_GROUPS = ("parameters", "first", "second")
_COUNTS = ("limit", "step", "views_shown")
_SCALARS = ("unit", "loss", "residual")
_WORDS = 4  # 64-bit words for state and increment of PCG64


def arrays_of(state: FitState, backend: Backend[Any] | None = None) -> dict[str, NDArray[Any]]:
    """The complete state of a fit, as arrays by name.

    Raises:
        ValueError: the random generator is not numpy's default, PCG64.
    """
    settle(state)
    device = backend or Cpu()
    arrays: dict[str, NDArray[Any]] = {"statistic": device.numpy(state.statistic)}
    for group in _GROUPS:
        for name in NAMES:
            arrays[f"{group}.{name}"] = device.numpy(getattr(state, group)[name])
    arrays["counts"] = np.array([getattr(state, name) for name in _COUNTS], np.int64)
    arrays["scalars"] = np.array([float(getattr(state, name)) for name in _SCALARS], np.float64)
    arrays["kernel_exponent"] = np.array(state.kernel.exponent)
    arrays["drawn"] = np.array(state.drawn, np.int64)
    generator = state.rng.bit_generator.state
    if generator["bit_generator"] != "PCG64":
        raise ValueError(
            f"a checkpoint must hold the state of the random generator PCG64, not of {generator['bit_generator']}"
        )
    inner = generator["state"]
    words = [inner[key] >> shift & (2**64 - 1) for key in ("state", "inc") for shift in (0, 64)]
    arrays["generator"] = np.array([*words, generator["has_uint32"], generator["uinteger"]], np.uint64)
    return arrays


def state_from(arrays: Mapping[str, NDArray[Any]], backend: Backend[Any] | None = None) -> FitState:
    """The state of a fit from the arrays of `arrays_of`. The fit then continues as if it had not been interrupted.

    Raises:
        ValueError: arrays are missing, have different lengths, or contain values that are not finite.
    """
    _refuse_damaged(arrays)
    device = backend or Cpu()
    parts = {group: {name: device.array(arrays[f"{group}.{name}"]) for name in NAMES} for group in _GROUPS}
    limit, step, views_shown = (int(v) for v in arrays["counts"])
    unit, loss, residual = (float(v) for v in arrays["scalars"])
    kernel = Kernel.of_exponent(float(arrays["kernel_exponent"]))
    words = [int(word) for word in arrays["generator"]]
    rng = np.random.default_rng(0)
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": words[0] | words[1] << 64, "inc": words[2] | words[3] << 64},
        "has_uint32": words[4],
        "uinteger": words[5],
    }
    return FitState(
        parts["parameters"], parts["first"], parts["second"], device.array(arrays["statistic"]), unit, rng, limit,
        kernel=kernel, step=step, drawn=arrays["drawn"].tolist(), views_shown=views_shown, loss=loss, residual=residual,
    )  # fmt: skip


def _refuse_damaged(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError if the arrays are not a valid checkpoint, see `state_from`."""
    wanted = [f"{group}.{name}" for group in _GROUPS for name in NAMES]
    others = ("statistic", "counts", "scalars", "kernel_exponent", "drawn", "generator")
    missing = [key for key in (*wanted, *others) if key not in arrays]
    if missing:
        raise ValueError(f"this is not the checkpoint of a fit, because {missing} are missing")
    n = len(arrays["parameters.raw"])
    widths = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "raw": (n,)}
    shapes: dict[str, tuple[int, ...]] = {key: widths[key.split(".")[1]] for key in wanted}
    shapes |= {
        "statistic": (n,),
        "counts": (len(_COUNTS),),
        "scalars": (len(_SCALARS),),
        "generator": (_WORDS + 2,),
        "kernel_exponent": (),
    }
    for key, shape in shapes.items():
        if np.shape(arrays[key]) != shape:
            raise ValueError(f"{key} of the checkpoint has shape {np.shape(arrays[key])}, expected {shape}")
    for key in wanted:
        if not np.isfinite(arrays[key]).all():
            raise ValueError(f"{key} of the checkpoint contains values that are not finite")


_BEST = "best."  # prefix of the names of the best model's arrays in a checkpoint


@dataclass(eq=False)
class HeldOutTracker:
    """Tracks the residual in held-out projections, and keeps the model with the lowest residual."""

    problem: FitProblem | None
    settings: FitSettings
    value: float = float("nan")
    best: float = float("inf")
    best_step: int = 0
    best_state: dict[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def over(
        cls, problem: FitProblem | None, settings: FitSettings, step: int, resume: Mapping[str, NDArray[Any]]
    ) -> HeldOutTracker:
        """A tracker for a fit at `step`: new, or with the values from a checkpoint."""
        if problem is None or "watch" not in resume:
            return cls(problem, settings, best_step=step)
        best, best_step = resume["watch"]
        best_state = {name.removeprefix(_BEST): values for name, values in resume.items() if name.startswith(_BEST)}
        return cls(problem, settings, best=float(best), best_step=int(best_step), best_state=best_state)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The tracker as arrays of a checkpoint."""
        if self.problem is None:
            return {}
        best = {_BEST + name: values for name, values in self.best_state.items()}
        return {"watch": np.array([self.best, self.best_step]), **best}

    def measure(self, state: FitState, keep: bool) -> None:
        if self.problem is None:
            return
        self.value = fit.misfit_of(state, self.problem, self.settings)
        if self.value < self.best:
            self.best, self.best_step = self.value, state.step
            if keep:
                self.best_state = arrays_of(state, self.problem.backend)
