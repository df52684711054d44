"""Configuration: combines a YAML file, environment variables and overrides into one frozen model, or reports errors
with file and line.
"""
