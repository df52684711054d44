"""EPICS on loopback with its own ports, so that tests can run in parallel."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.free_ports import free_ports

sys.path.insert(0, str(Path(__file__).parent))  # for the fakes beside the tests


@cache
def _ports_of_channel_access() -> list[int]:
    """Of servers and of beacons: its client reads them once in a process."""
    return free_ports(2)


@pytest.fixture(scope="module")
def loopback() -> Iterator[dict[str, str]]:
    """The environment of EPICS's clients and servers, which this process has, too, meanwhile."""
    (pva, server), (ca, beacons) = free_ports(2), _ports_of_channel_access()
    environment = {
        "EPICS_PVA_ADDR_LIST": "127.0.0.1", "EPICS_PVA_AUTO_ADDR_LIST": "NO", "EPICS_PVA_BROADCAST_PORT": f"{pva}",
        "EPICS_PVAS_BROADCAST_PORT": f"{pva}", "EPICS_PVAS_INTF_ADDR_LIST": "127.0.0.1",
        "EPICS_PVA_SERVER_PORT": f"{server}", "EPICS_CA_SERVER_PORT": f"{ca}", "EPICS_CA_REPEATER_PORT": f"{beacons}",
        "EPICS_CA_ADDR_LIST": "127.0.0.1", "EPICS_CA_AUTO_ADDR_LIST": "NO", "EPICS_CAS_INTF_ADDR_LIST": "127.0.0.1",
        "EPICS_CAS_BEACON_ADDR_LIST": "127.0.0.1", "EPICS_CAS_AUTO_BEACON_ADDR_LIST": "NO",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield environment
