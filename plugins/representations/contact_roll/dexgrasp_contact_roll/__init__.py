"""The lossless contact representation: a finger's direction and roll at the point that it touches."""

from dexgrasp_contact_roll.contact_roll import ContactRoll

__all__ = ["ContactRoll"]
