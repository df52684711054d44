"""Trials: compare methods, settings and options on a scan, and measure the loss with fewer projections."""

COMMANDS = {
    "tradeoff": ("Compare methods and settings on a scan: quality against time and memory.", True),
    "sweep": ("Reconstruct one slice with each value of an option, and draw the slices with their scores.", True),
    "study": ("Measure how much quality a scan loses with fewer, limited-angle, random or averaged projections.", True),
}
