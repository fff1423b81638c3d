"""Several exhibits on one page: scenes of a dataset, attempts of an evaluation."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dexgrasp.viewer.exhibit import Exhibit
from dexgrasp.viewer.grasp_view import GraspView
from dexgrasp.viewer.page import PORT, open_page, serve
from dexgrasp.viewer.sources import open_source

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


def show(
    path: str | Path,
    scene: int = 0,
    attempt: int = 1,
    view: int = 0,
    most: int = 30,
    port: int = PORT,
    host: str = "127.0.0.1",
) -> None:
    """Show what lies in a folder (see `open_source`) until Ctrl-C."""
    source = open_source(path, most, view)
    first = source.position(scene, attempt)
    source.make(first)  # what is wrong with it is told before a page is opened
    server = open_page(Path(path).absolute().name, port, host)
    Gallery(server, source.names, source.make, first)
    serve(server)
