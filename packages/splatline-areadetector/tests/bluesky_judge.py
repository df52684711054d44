"""ophyd-async's own areaDetector client, as a program: bluesky_judge.py ca://PREFIX|pva://PREFIX FOLDER N.

It stages, prepares N frames, starts, waits, collects and unstages, then takes one more as a step scan does. It prints a
line of JSON: shape, type, files and indices of its documents, and the names of its attributes.
"""

import asyncio
import json
import sys
from pathlib import Path

from ophyd_async.core import StaticPathProvider, TriggerInfo, UUIDFilenameProvider
from ophyd_async.epics.adcore import ADWriterFactory
from ophyd_async.epics.adsimdetector import SimDetector


async def main(prefix: str, folder: str, n: int) -> None:
    paths = StaticPathProvider(UUIDFilenameProvider(), Path(folder))
    detector = SimDetector(prefix, ADWriterFactory.hdf(paths), name="det")
    await detector.connect(timeout=20)
    await detector.stage()
    await detector.prepare(TriggerInfo(number_of_events=n, livetime=0.01, deadtime=0.05))
    described = await detector.describe()
    await detector.kickoff()
    await detector.complete()
    documents = [each async for each in detector.collect_asset_docs(await detector.get_index())]
    await detector.unstage()
    await detector.stage()
    await detector.trigger()
    await detector.unstage()
    print(json.dumps({
        "shape": list(described["det"]["shape"]), "dtype": described["det"]["dtype_numpy"],
        "keys": sorted(described),
        "uri": next(d["uri"] for name, d in documents if name == "stream_resource"),
        "indices": [d["indices"] for name, d in documents if name == "stream_datum"],
    }))  # fmt: skip


asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
