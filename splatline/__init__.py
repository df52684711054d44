"""What every package of the project may use: registries, which other packages add to. Standard library alone."""
