"""Evidence of a scan: each frame is read once, a running scan adds new ones, all accepted flats and darks are used."""

from itertools import chain

import numpy as np

from beamline.storage.frame_table import FrameTable
from beamline.storage.rules.angles_shown import angles_shown
from beamline.storage.rules.evidence import EvidenceRequest, ScanEvidence
from beamline.storage.rules.light import darks_beside_views, exposures_agree, one_intensity, references_usable
from tests.beamline.array_source import ArraySource, scan_of

BALLS = (12.0, 8.0), (-14.0, 5.0)  # column off the axis, radius
ANGLES = np.linspace(0, np.pi, 40, endpoint=False)


def scan(lit_dark: float = 0.0) -> ArraySource:
    """Two balls that turn, a slab of 32 x 64 pixels of noise; the last of four darks is lit so brightly."""
    rng, (rows, cols) = np.random.default_rng(0), np.indices((32, 64))
    depth = [
        sum(np.sqrt(np.clip(r**2 - (cols - 31.5 - x * np.cos(a)) ** 2 - (rows - 15.5) ** 2, 0, None)) for x, r in BALLS)
        for a in ANGLES
    ]
    darks, flats = np.full((4, 32, 64), 100.0), np.full((4, 32, 64), 2e4)
    darks[3] += lit_dark
    views = 2e4 * np.exp(-0.05 * np.array(depth))
    return scan_of(rng.poisson(darks), rng.poisson(flats), rng.poisson(views), ANGLES)


def rows_read(source: ArraySource) -> list[int]:
    return sorted(chain.from_iterable(rows for rows, _ in source.was_read))


def test_rules_on_light_and_angles_read_each_frame_once_for_all_of_them() -> None:
    source = scan()
    evidence = ScanEvidence(source)
    for rule in (references_usable, exposures_agree, one_intensity, angles_shown):
        assert not list(rule(evidence))
    read = rows_read(source)
    assert read == sorted(set(read)) and set(range(8)) <= set(read)
    before = len(source.was_read)
    assert (
        all(evidence.used_references)
        and 0 < evidence.illumination.brightest <= 1.1
        and evidence.illumination.without_beam(8 + 20) is not None
    )
    assert all(rows == [28] for rows, _ in source.was_read[before:])


def test_a_running_scan_adds_its_new_frames_to_what_was_seen() -> None:
    source = scan()
    whole = source.table
    source.table = whole.take(np.arange(6))  # 4 darks and 2 flats
    first = ScanEvidence(source)
    assert first.renewed() is first and [
        group.size for group in (*first.used_references.darks, *first.used_references.flats)
    ] == [4, 2]
    source.table = whole
    assert first.all_references.flats[0].size == 2  # what was taken stays
    more = first.renewed()
    assert more.used_references.flats[0].tolist() == [4, 5, 6, 7]
    assert not {0, 1, 2, 3, 4, 5} & set(chain.from_iterable(rows for rows, _ in source.was_read[6:]))


def test_faulty_references_are_left_out_or_accepted_as_they_are() -> None:
    source = scan(lit_dark=3000)
    checked, accepted = ScanEvidence(source), ScanEvidence(source, EvidenceRequest(accepted=True))
    assert checked.used_references.darks[0].tolist() == [0, 1, 2] and accepted.used_references.darks[0].tolist() == [
        0,
        1,
        2,
        3,
    ]
    (warned,), (taken,) = references_usable(checked), references_usable(accepted)
    assert warned.message.endswith("The other darks are used instead.")
    assert taken.message.startswith("--references accept: ") and {warned.severity, taken.severity} == {"warning"}
    assert checked.dark_and_flat is not None and accepted.dark_and_flat is not None
    np.testing.assert_allclose((accepted.dark_and_flat[0] - checked.dark_and_flat[0]).mean(), 750, rtol=0.02)
    assert not list(darks_beside_views(checked))


def test_without_references_or_counts_no_beam_is_known() -> None:
    source = scan()
    source.table = FrameTable.of(np.zeros(48), np.linspace(0, 3, 48))
    assert ScanEvidence(source).dark_and_flat is None and ScanEvidence(source).illumination.brightest == 1
    source = scan()
    source.quantity = "line_integrals"
    evidence = ScanEvidence(source)
    assert evidence.findings == () and evidence.dark_and_flat is None and not source.was_read
