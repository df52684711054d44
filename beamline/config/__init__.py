"""Configuration: combines YAML file, environment and overrides into one frozen model, or reports errors with file
and line.
"""
