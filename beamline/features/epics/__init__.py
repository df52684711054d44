"""EPICS: the state of the running scan as process variables."""

COMMANDS = {
    "ioc": ("Publish the state of the running scan as EPICS process variables.", False),
}
