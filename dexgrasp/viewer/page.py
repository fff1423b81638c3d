"""The page in the browser: a viser server, or a clear word that viser is not installed."""

import getpass
import socket
import time
from contextlib import closing
from typing import TYPE_CHECKING

from dexgrasp.errors import DexgraspError

if TYPE_CHECKING:
    from viser import ViserServer

PORT = 8080


def open_page(title: str, port: int = PORT, host: str = "127.0.0.1") -> "ViserServer":
    """Start a server for one page; its address is ``http://{host}:{server.get_port()}``.

    Raises DexgraspError where viser is not installed or the port is taken.
    """
    try:
        import viser
    except ImportError as error:
        raise DexgraspError(
            "the viewer viser, to show something in the browser",
            f"it is not installed ({error})",
            "pip install 'dexgrasp[view]' (or: pip install 'viser>=1.1')",
        ) from error
    with closing(socket.socket()) as test:
        test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            test.bind((host, port))
        except OSError as error:
            raise DexgraspError(f"a free port {port} for the viewer", str(error), "give another by --port") from error
        port = test.getsockname()[1]  # 0 asks for any
    server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    server.scene.set_up_direction("+z")
    return server


def serve(server: "ViserServer") -> None:
    """Tell where the page is, also to somebody on another machine, and keep it until Ctrl-C."""
    print(address(server.get_host(), server.get_port()), flush=True)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        server.stop()


def address(host: str, port: int) -> str:
    """Return where the page is, and how it is reached from another machine, as text."""
    lines = [f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{port}  (Ctrl-C ends)"]
    if host in ("127.0.0.1", "localhost"):
        here = f"{getpass.getuser()}@{socket.gethostname()}"
        lines.append(f"from another machine: ssh -L {port}:localhost:{port} {here}, then open the same address there")
    return "\n".join(lines)
