"""Several exhibits on one page: scenes of a dataset, attempts of an evaluation."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from dexgrasp.viewer.exhibit import Exhibit
from dexgrasp.viewer.grasp_view import GraspView

if TYPE_CHECKING:
    from viser import ViserServer


class Gallery:
    """A menu of exhibits, each made when it is asked for.

    Args:
        server: the page (`open_page`).
        names: of the exhibits.
        make: returns the exhibit of a position in `names`.
        first: which is shown first.
    """

    def __init__(
        self, server: "ViserServer", names: Sequence[str], make: Callable[[int], Exhibit], first: int = 0
    ) -> None:
        self.server, self.names, self.make = server, tuple(names), make
        self.menu = server.gui.add_dropdown("show", self.names, initial_value=self.names[first])
        self.menu.visible = len(self.names) > 1
        self.menu.on_update(lambda event: self.show(self.names.index(event.target.value)))
        self.view = GraspView(server, make(first))

    def show(self, number: int) -> None:
        """Show another exhibit."""
        made = self.make(number)
        self.view.close()
        self.view = GraspView(self.server, made)
