"""References: flats are lit, complete and even, and darks are dark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence


def references_usable(scan: ScanEvidence) -> Iterator[Finding]:
    """Flats are lit, complete and even, and darks are dark; a faulty group is left out if there is a good one.

    An error where all groups of a kind are bad, a warning for others that have a fault, and for all that are accepted.
    """
    for finding in scan.findings:
        message = finding.message
        if finding.frames:
            name = f"{scan.table.kind(finding.frames[0]).name.lower()}s"
            if scan.accepted:
                message = f"--references accept: {message}"
            elif finding.severity == "error":
                message += (
                    f" It must not be reconstructed: take new {name}, or give others with --{name}; `beamline recon "
                    "--references accept` uses these as they are."
                )
            else:
                message += f" The other {name} are used instead."
        severity = "warning" if scan.accepted else finding.severity
        yield replace(finding, severity=severity, rule="bad-references", message=message)
