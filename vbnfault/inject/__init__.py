"""Put faults into images that exist already: of a user's own camera, of another renderer, of an archive."""

from .injector import Injected, Injector, inject

__all__ = ["Injected", "Injector", "inject"]
