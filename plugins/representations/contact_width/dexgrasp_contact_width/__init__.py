"""Parallel jaws told from one contact: baseline, approach and width."""

from dexgrasp_contact_width.contact_width import ContactWidth

__all__ = ["ContactWidth"]
