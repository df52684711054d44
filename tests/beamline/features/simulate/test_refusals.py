"""What is refused, as refusals.txt says."""

from tests.beamline.transcript import refusals

test_refusals = refusals(__file__)
