"""The extensions of a site, one of each kind; `pyproject.toml` has their entry points."""
