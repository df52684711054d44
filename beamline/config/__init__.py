"""Configuration: YAML, environment and overrides become one frozen model, or errors with file and line."""
