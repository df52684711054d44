"""Collects bluesky documents as a subscriber receives them."""

from typing import Any
from urllib.parse import unquote, urlsplit

import h5py
import numpy as np
import pytest

event_model = pytest.importorskip("event_model")


class Heard:
    """Documents; each one is validated by event-model when it arrives."""

    def __init__(self) -> None:
        self.all: list[tuple[str, dict[str, Any]]] = []

    def __call__(self, name: str, document: dict[str, Any]) -> None:
        event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
        self.all.append((name, document))

    def of(self, name: str) -> list[dict[str, Any]]:
        return [document for found, document in self.all if found == name]

    def read(self, key: str, run: int = -1) -> np.ndarray:
        """The data of a key as a client reads it, only from resource and datums. `run`: number of the run (-1: the
        last)."""
        resources = [document for document in self.of("stream_resource") if document["data_key"] == key]
        assert run >= 0 or len(resources) == 1
        resource = resources[run]
        mine = [datum for datum in self.of("stream_datum") if datum["stream_resource"] == resource["uid"]]
        path = unquote(urlsplit(resource["uri"]).path)
        with h5py.File(path, "r", swmr=resource["parameters"]["swmr"]) as file:
            dataset = file[resource["parameters"]["dataset"]]
            return np.concatenate([dataset[d["indices"]["start"] : d["indices"]["stop"]] for d in mine])
