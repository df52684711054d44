"""EPICS: the running scan as process variables."""

COMMANDS = {
    "ioc": ("Serve the running scan as EPICS process variables.", False),
}
