"""Write the package's meshes and URDFs from `author_geometry`: python author_urdf.py.

Masses are those of one density, chosen so that the BH8-280 weighs 1.1 kg (sources say 0.98 to 1.2); inertias follow
from the same solids.
"""

import math
from pathlib import Path

import author_geometry as geometry
import numpy as np
import trimesh
from manifold3d import Manifold

PACKAGE = Path(__file__).resolve().parent / "dexgrasp_barrett"
MASS = 1.1
COUNT = {"knuckle": 2, "inner": 3, "outer": 3}
INNER_EFFORT, OUTER_EFFORT, SPREAD_EFFORT = 1.9, 0.72, 2.4
NOTE = """
  Units m, kg, rad. Base frame: centre of the mounting face, +z out of the palm, finger 3 at +y.
  Efforts give the maker's 15 N at the tip. Inner joint: the tip's centre lies 112 mm from it, and 48 mm from the outer
  joint, which turns by a third, 22 deg aside: 15 N (0.112 + 0.048 / 3 cos 22 deg) m = 1.9 N m. Outer joint alone
  (breakaway): 15 N 0.048 m = 0.72 N m. Spread: 15 N at the tip of a straight finger, 0.157 m from its axis: 2.4 N m.
"""


def mesh(solid: Manifold) -> trimesh.Trimesh:
    """Return a solid in metres."""
    raw = solid.to_mesh()
    return trimesh.Trimesh(raw.vert_properties[:, :3] / 1000, raw.tri_verts)


def link(name: str, kind: str, body: trimesh.Trimesh, parts: int, density: float) -> str:
    """Return the URDF text of a link."""
    body.density = density
    inertia = body.moment_inertia
    entries = " ".join(f'i{"xyz"[i]}{"xyz"[j]}="{inertia[i, j]:.6g}"' for i in range(3) for j in range(i, 3))
    center = " ".join(f"{value:.6g}" for value in body.center_mass)
    color = "palm" if kind.startswith("base") else "finger"
    lines = [
        f'  <link name="{name}">',
        f'    <inertial><origin xyz="{center}"/><mass value="{body.mass:.6g}"/><inertia {entries}/></inertial>',
        f'    <visual><geometry><mesh filename="../meshes/{kind}.stl"/></geometry><material name="{color}"/></visual>',
    ]
    for part in range(parts):
        shape = f'<mesh filename="../meshes/{kind}_convex_{part}.stl"/>'
        lines.append(f"    <collision><geometry>{shape}</geometry></collision>")
    return "\n".join([*lines, "  </link>"])


def joint(
    name: str, parent: str, child: str, xyz: str, rpy: str, upper: float, effort: float, mimic: str = "", sign: int = -1
) -> str:
    """Return the URDF text of a revolute joint about z; `mimic` is its coupling."""
    return f"""  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 {sign}"/>
    <limit lower="0" upper="{upper!r}" effort="{effort}" velocity="2.0"/>{mimic}
  </joint>"""


def robot(model: str, links: list[str]) -> str:
    """Return the URDF text of a hand."""
    deck = geometry.DECK[model] / 1000
    right, half = repr(math.pi / 2), math.pi
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by author_urdf.py: change that, not this.{NOTE}-->",
        f'<robot name="bh{model}">',
        '  <material name="palm"><color rgba="0.35 0.36 0.38 1"/></material>',
        '  <material name="finger"><color rgba="0.72 0.73 0.75 1"/></material>',
        *links,
        '  <link name="palm"/>',
        '  <joint name="palm_face" type="fixed">\n    <parent link="base"/><child link="palm"/>',
        f'    <origin xyz="0 0 {geometry.FACE[model] / 1000}" rpy="0 0 0"/>\n  </joint>',
        joint("spread", "base", "finger_1_knuckle", f"-0.025 0 {deck}", f"0 0 {right}", half, SPREAD_EFFORT),
        joint(
            "finger_2_spread", "base", "finger_2_knuckle", f"0.025 0 {deck}", f"0 0 {right}", half, SPREAD_EFFORT,
            '\n    <mimic joint="spread" multiplier="1"/>', 1,
        ),
    ]  # fmt: skip
    for finger in ("finger_1", "finger_2", "finger_3"):
        parent, xyz, rpy = f"{finger}_knuckle", "-0.05 0 0.0339", f"{right} 0 0"
        if finger == "finger_3":
            parent, xyz, rpy = "base", f"0 0.05 {round(deck + 0.0339, 6)}", f"{right} 0 -{right}"
        inner, outer = f"{finger}_inner", f"{finger}_outer"
        third = f'\n    <mimic joint="{finger}" multiplier="{1 / 3!r}"/>'
        lines.append(joint(finger, parent, inner, xyz, rpy, math.radians(140), INNER_EFFORT))
        stretch = "-0.069936 0.003 0"
        lines.append(joint(outer, inner, outer, stretch, "0 0 0", math.radians(48), OUTER_EFFORT, third))
    return "\n".join([*lines, "</robot>\n"])


def main() -> None:
    """Write meshes/*.stl and urdf/*.urdf into the package."""
    for old in (PACKAGE / "meshes").glob("*.stl"):
        old.unlink()
    volumes = {kind: solid.volume() * 1e-9 for kind, solid in geometry.solids("280").items()}
    density = MASS / sum(volume * COUNT.get(kind, 1) for kind, volume in volumes.items())
    for model in geometry.DECK:
        bodies = {kind: mesh(solid) for kind, solid in geometry.solids(model).items()}
        parts = {kind: [mesh(part) for part in all_parts] for kind, all_parts in geometry.convex_parts(model).items()}
        for kind, body in bodies.items():
            body.export(PACKAGE / "meshes" / f"{kind}.stl")
            for number, part in enumerate(parts[kind]):
                part.export(PACKAGE / "meshes" / f"{kind}_convex_{number}.stl")
        names = {"base": f"base_{model}", "finger_1_knuckle": "knuckle", "finger_2_knuckle": "knuckle"}
        names |= {f"finger_{n}_{kind}": kind for n in (1, 2, 3) for kind in ("inner", "outer")}
        links = [link(name, kind, bodies[kind], len(parts[kind]), density) for name, kind in names.items()]
        (PACKAGE / "urdf" / f"bh{model}.urdf").write_text(robot(model, links))
        print(f"bh{model}: {sum(bodies[kind].volume for kind in names.values()) * density:.3f} kg,", end=" ")
        print(f"{sum(len(parts[kind]) for kind in names.values())} convex parts, {np.round(density)} kg/m3")


if __name__ == "__main__":
    main()
