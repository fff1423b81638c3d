"""The 6-D contact representation of CMG-Net (METHOD section 1), for any hand."""

from dexgrasp_contact.contact import Contact

__all__ = ["Contact"]
