"""Features: what a scan and its volume do not need. Each is a folder: commands, options, pages, and what they do.

A feature enters by its folder: `beamline.cli.main` reads `COMMANDS` of each. The core imports no feature, and no
feature another, so that a folder can be removed, with its tests. `[tool.splatline.features]` in pyproject.toml names
the folders of each.
"""
