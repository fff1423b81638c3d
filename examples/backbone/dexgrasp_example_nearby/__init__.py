"""Features averaged over nearby points."""

from dexgrasp_example_nearby.nearby import Nearby

__all__ = ["Nearby"]
