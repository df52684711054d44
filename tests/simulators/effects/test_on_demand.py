"""On demand: a scene pays for no effect that it does not name, effects leave each other's random numbers alone, and a
frame is the same whether it is computed alone or in sequence."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from simulators.effects.catalogue import CATALOGUE, Domain, load_effect
from simulators.frame.shot import Shot, fixed_rng, frame_rng
from tests.simulators.effects import on_demand
from tests.simulators.effects.parameters import PARAMETERS

CHECKOUT = Path(__file__).parents[3]
ADDITIVE = ("dark_current", "hot_pixels", "zingers", "read_noise")


def test_every_effect_has_parameters_and_every_parameter_an_effect() -> None:
    assert not (missing := set(CATALOGUE) - set(PARAMETERS)), f"add to parameters.py: {sorted(missing)}"
    assert not (unknown := set(PARAMETERS) - set(CATALOGUE)), f"parameters.py names no effects: {sorted(unknown)}"


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_shows_in_some_frame(name: str) -> None:
    """Otherwise what follows would prove nothing of it."""
    assert not on_demand.same(on_demand.frames(on_demand.scene([name])), on_demand.frames(on_demand.scene([])))


@pytest.mark.slow
def test_without_its_effects_named_a_module_is_not_imported_and_the_frames_are_the_same_without_it() -> None:
    """For each module: a scene with all other effects, with the module and without it, in one other process."""
    program = [sys.executable, "-m", "tests.simulators.effects.without_its_module"]
    ran = subprocess.run(program, cwd=CHECKOUT, capture_output=True, text=True, timeout=200)
    assert ran.returncode == 0, ran.stderr
    report = json.loads(ran.stdout)
    assert report["wrong"] == {}
    assert report["taken"] == sorted({row.module for row in CATALOGUE.values()})


def test_an_effect_draws_the_same_numbers_whatever_else_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """And asks for none but its own; each frame has others."""
    states: dict[str, dict[int, str]] = defaultdict(dict)

    def noted(effect: str, shot: Shot) -> np.random.Generator:
        rng = frame_rng(effect, shot)
        states[effect][shot.frame] = str(rng.bit_generator.state)
        return rng

    for module in {load_effect(name).__module__ for name in CATALOGUE}:
        if "frame_rng" in vars(sys.modules[module]):
            monkeypatch.setattr(sys.modules[module], "frame_rng", noted)
    on_demand.frames(on_demand.scene(list(CATALOGUE)), range(4))
    among = dict(states)
    assert {"photon_noise", "runout", "read_noise"} <= set(among)
    for name, drawn in among.items():
        states.clear()
        on_demand.frames(on_demand.scene([name]), range(4))
        assert states == {name: drawn}
        assert len(set(drawn.values())) == len(drawn) >= 2


def test_no_two_of_effects_seeds_and_frames_share_random_numbers() -> None:
    """Nor with a phantom of the same seed, nor where a seed needs more than 32 bits."""
    seeds = (0, 1, 2, 2**32, 2**32 + 1)
    shots_of = [replace(on_demand.shot(0), seed=seed, frame=frame) for seed in seeds for frame in range(4)]
    generators = [np.random.default_rng(seed) for seed in seeds]
    for name in CATALOGUE:
        generators += [frame_rng(name, shot) for shot in shots_of]
        generators += [fixed_rng(name, seed) for seed in seeds]
    first = [int(rng.integers(2**64, dtype=np.uint64)) for rng in generators]
    assert len(set(first)) == len(first) == 5 + 25 * len(CATALOGUE)


@pytest.mark.parametrize("name", CATALOGUE)
def test_what_stays_is_drawn_for_the_effect_and_its_own_seed_alone(name: str) -> None:
    """Whoever asks numpy for a generator of his own has its numbers in common with others of that seed."""
    source = Path(sys.modules[load_effect(name).__module__].__file__ or "").read_text(encoding="utf-8")
    assert "default_rng" not in source


@pytest.mark.parametrize(("first", "second"), list(combinations(ADDITIVE, 2)))
def test_contributions_of_two_effects_add_up(first: str, second: str) -> None:
    shot = on_demand.shot(2)

    def added(*names: str) -> np.ndarray:
        return on_demand.scene(names).chain.apply(Domain.ELECTRONS, np.zeros(shot.detector.shape), shot)

    np.testing.assert_allclose(added(first, second), added(first) + added(second), atol=1e-9)


def test_a_frame_alone_is_the_frame_in_sequence() -> None:
    names = list(CATALOGUE)
    in_sequence = on_demand.frames(on_demand.scene(names), range(5))
    assert not on_demand.same(in_sequence[2:3], in_sequence[3:4])
    for number in (4, 0, 3):
        assert on_demand.same(on_demand.frames(on_demand.scene(names), [number]), in_sequence[number : number + 1])
