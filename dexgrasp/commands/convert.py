"""Read a file of grasps, of any known format, say what is in it, and write it in another."""

import argparse
from pathlib import Path

from dexgrasp.errors import DexgraspError


def main(argv: list[str]) -> int:
    """Run the tool; raises DexgraspError for whatever is wrong in the file."""
    from dexgrasp.interchange.binding import bind, load_mapping, renamed
    from dexgrasp.interchange.format import Told
    from dexgrasp.interchange.formats import formats, read_grasps, write_grasps

    parser = argparse.ArgumentParser(
        prog="python -m dexgrasp convert",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="formats:\n" + "\n".join(f"  {each.name:14}{each.summary}" for each in formats().values()),
    )
    parser.add_argument("file", type=Path, help="file or folder of grasps")
    parser.add_argument("--from", dest="source", metavar="FORMAT", help="default: the first that knows the file")
    parser.add_argument("--to", type=Path, metavar="PATH", help="where to write; without it nothing is written")
    parser.add_argument("--format", metavar="FORMAT", help="to write; default: by the name of PATH")
    parser.add_argument("--joints", default="", help="names in the file's order, a,b,c, where it has none")
    parser.add_argument("--units", default="", help="m,rad (or cm, mm; deg) where the file holds bare numbers")
    parser.add_argument("--robot", default="", help="which hand, as the file names it, where it holds several")
    parser.add_argument("--object", default="", help="name of the object where the file has none")
    parser.add_argument("--scale", type=float, help="metres per unit of the object's mesh, where the file does not say")
    parser.add_argument("--map", type=Path, metavar="FILE", help="YAML: their joints and base to ours")
    parser.add_argument("--hand", help="check joints and limits against this installed hand, and write its name")
    options = parser.parse_args(argv)
    joints, units = (
        tuple(part.strip() for part in text.split(",") if part.strip()) for text in (options.joints, options.units)
    )
    told = Told(joints, units, options.robot, options.object, options.scale)
    grasps = renamed(read_grasps(options.file, told, options.source), load_mapping(options.map))
    bodies = grasps.bodies()
    shown = ", ".join(f"{name} x {scale:g}" for name, scale in bodies[:5]) + (", ..." if len(bodies) > 5 else "")
    print(f"{len(grasps)} grasps of {grasps.hand or 'a hand without a name'} on {len(bodies)} objects: {shown}")
    print(f"joints: {', '.join(grasps.joint_names)}")
    if options.hand:
        from dataclasses import replace

        from dexgrasp.plugins import load_hand

        bound = bind(grasps, load_hand(options.hand))
        print(f"all are grasps of {options.hand}; {bound.clamped} lie a little beyond a joint's limit;", end=" ")
        print(f"coupled joints differ from its coupling by {bound.uncoupled:.3g} at most")
        grasps = replace(grasps, hand=options.hand)
    if options.to is not None:
        print(write_grasps(grasps, options.to, options.format or _format(options.to)))
    return 0


def _format(path: Path) -> str:
    known = {".safetensors": "dexgrasp", ".yaml": "isaac", ".yml": "isaac"}
    if path.suffix not in known:
        raise DexgraspError("the format to write", f"none told for {path}", "--format isaac, dexgraspbench or dexgrasp")
    return known[path.suffix]
