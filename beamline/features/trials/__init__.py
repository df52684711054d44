"""Trials: methods, settings and options compared on a scan, and what fewer views would cost."""

COMMANDS = {
    "tradeoff": ("Compare methods and settings on a scan: quality against time and memory.", True),
    "sweep": ("Reconstruct one slice with each value of an option, as a sheet with scores.", True),
    "study": ("Say what fewer views, narrower sectors, random angles or averaged views cost on a scan.", True),
}
