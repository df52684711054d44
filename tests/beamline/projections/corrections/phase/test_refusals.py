"""Command lines that end with an error, as in refusals.txt."""

from tests.beamline.transcript import refusals

test_refusals = refusals(__file__)
