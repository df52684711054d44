"""Scan, check, scan again: the monitor checks a quick scan. With alarms it is repeated; then the full scan runs.

python inspect_and_rescan.py my.yaml cathode-3
"""

import sys

from beamline import api

config, sample = sys.argv[1:]

with api.connect(config) as instrument:
    for attempt in (1, 2, 3):
        quick = instrument.scan(sample=f"{sample}_look-{attempt}", set={"scan.angles.views": 45}, live=False)
        verdict = api.monitor(quick.path)
        if verdict.clean:
            break
        for kind in verdict.kinds:
            print(f"{kind.check}, {kind.level}: {len(kind.frames)} frames. {kind.worst.advice}")
        for fault in verdict.references:
            print(fault)
    else:
        sys.exit(f"{sample}: three attempts had alarms; the last one is {quick.path}")

    full = instrument.scan(sample=sample)

print(f"{full.path}: {full.frames} frames, volume {full.volume}")
