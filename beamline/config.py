"""Configuration: a YAML file, overrides and environment into one frozen Config."""

from beamline.config_models import Config

__all__ = ["Config"]
