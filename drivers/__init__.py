"""Device drivers of splatline, and the Protocols (interfaces) of all devices."""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)  # another folder drivers/ without __init__.py on the path adds its modules
