"""A short scan, and the places of the keys of its documents in its file."""

SHORT = (
    "scan.angles={scheme: fixed, views: 40}",
    "scan.period_s=0.5",
    "scan.flats={count: 3, at: both}",
    "scan.darks={count: 2}",
    "recon.live=false",
)

PATHS = {
    "tomo": "entry/instrument/detector/data",
    "tomo-angle": "entry/sample/rotation_angle",
    "tomo-kind": "entry/frame_log/kind",
}
