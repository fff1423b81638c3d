"""List the installed plugins, without importing any."""

import argparse

from rich.console import Console
from rich.table import Table

from dexgrasp import registry


def main(argv: list[str]) -> int:
    """Print kind, name, distribution and one line for every installed plugin."""
    parser = argparse.ArgumentParser(prog="python -m dexgrasp plugins", description=__doc__)
    parser.add_argument("kind", nargs="?", choices=list(registry.GROUPS), help="only this kind")
    kind = parser.parse_args(argv).kind
    table = Table("kind", "name", "distribution", "what it is", box=None, header_style="bold", pad_edge=False)
    for plugin in registry.installed(kind):
        table.add_row(plugin.kind, plugin.name, plugin.distribution, plugin.summary)
    console = Console()
    if not console.is_terminal:
        console.width = 200
    console.print(table)
    return 0
