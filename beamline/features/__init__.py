"""Features: parts of the program that are not needed to run and reconstruct a scan, such as the export of volumes or
the web pages.

Each feature is a folder with its commands, options and pages. `beamline.cli.main` finds it by reading `COMMANDS` of
each folder. The core imports no feature, and no feature imports another one, so a folder can be removed together with
its tests. `[tool.splatline.features]` in pyproject.toml lists the folders of each feature.
"""
