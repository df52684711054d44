"""Devices of splatline: their Protocols, and the drivers of real devices."""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)  # a lab's folder drivers/ without __init__.py adds its modules
