"""Device drivers of splatline, and the Protocols (interfaces) of all devices."""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)  # a lab's folder drivers/ without __init__.py adds its modules
