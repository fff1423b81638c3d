"""Look at a dataset, prediction, evaluation or hand in the browser, also over SSH."""

import argparse
from pathlib import Path


def main(argv: list[str]) -> int:
    """Serve one page until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m dexgrasp view", description=__doc__)
    parser.add_argument("path", help="what `dataset`, `predict` or `eval` printed, or the name of an installed hand")
    parser.add_argument("--scene", type=int, default=0, help="of a dataset or evaluation (default 0)")
    parser.add_argument("--view", type=int, default=0, help="which of the scene's views (default 0)")
    parser.add_argument("--attempt", type=int, default=1, help="of an evaluation's scene (default 1)")
    parser.add_argument("--top", type=int, default=30, help="grasps that are shown at most (default 30)")
    parser.add_argument("--port", type=int, default=8080, help="of the page (default 8080; 0: any that is free)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine alone)")
    chosen = parser.parse_args(argv)

    from dexgrasp.plugins import load_hand
    from dexgrasp.registry import names
    from dexgrasp.viewer import HandView, open_page, serve, show

    if Path(chosen.path).exists() or chosen.path not in names("hand"):
        places = chosen.scene, chosen.attempt, chosen.view
        show(chosen.path, *places, most=chosen.top, port=chosen.port, host=chosen.host)
    else:
        hand = load_hand(chosen.path)
        server = open_page(hand.name, chosen.port, chosen.host)
        HandView(server, hand)
        serve(server)
    return 0
