"""Features: everything that running and reconstructing a scan does not need, such as export or the pages.

Each feature is a folder with its commands, options and pages. `beamline.cli.main` finds it by reading `COMMANDS` of
each folder. The core imports no feature, and no feature imports another one, so a folder can be removed together with
its tests. `[tool.splatline.features]` in pyproject.toml lists the folders of each feature.
"""
