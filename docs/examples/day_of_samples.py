"""A day of samples: scans each one and prints a table at the end. If one fails, the others are still scanned.

python day_of_samples.py my.yaml cathode-1 cathode-2 cathode-3
"""

import sys

from beamline import api

config, *samples = sys.argv[1:]
done = []

with api.connect(config) as instrument:
    for sample in samples:
        # Change the sample here: with a robot, or by hand, with input("Mount it, close the hutch, press Enter ").
        try:
            done.append(instrument.scan(sample=sample))
        except api.DataError as error:  # missing frames, or a full disk; a device that fails ends the script
            print(f"{sample}: {error}")
            if instrument.last is not None:
                done.append(instrument.last)

for scan in done:
    print(f"{scan.sample:<20}{scan.status:<10}{scan.frames:>6} frames, {scan.alarms} with an alarm  {scan.path}")
