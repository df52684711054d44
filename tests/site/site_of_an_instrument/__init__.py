"""What a site adds to splatline, one of each kind; `pyproject.toml` says by which entry points."""
