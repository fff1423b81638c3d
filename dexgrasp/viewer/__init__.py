"""Looking at things in a browser. Needs the extra `view` (viser), imported only when something is shown."""

from dexgrasp.viewer.gallery import Gallery, show
from dexgrasp.viewer.grasp_view import GraspView
from dexgrasp.viewer.hand_view import HandView
from dexgrasp.viewer.page import address, open_page, serve

__all__ = ["Gallery", "GraspView", "HandView", "address", "open_page", "serve", "show"]
