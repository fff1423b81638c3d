"""Looking at things in a browser. Needs the extra `view` (viser), imported only when something is shown."""

from dexgrasp.viewer.hand_view import HandView
from dexgrasp.viewer.page import open_page

__all__ = ["HandView", "open_page"]
