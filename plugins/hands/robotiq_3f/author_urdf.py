"""Write the package's meshes and URDF from `author_geometry`: python author_urdf.py.

The mass, 2.3 kg, is spread evenly over the solids; inertias follow from them.
"""

import math
from pathlib import Path

import author_geometry as geometry
import trimesh

PACKAGE = Path(__file__).resolve().parent / "dexgrasp_robotiq_3f"
MASS, COUNT = 2.3, 3
EFFORT, SCISSOR_EFFORT = 5.8, 4.0
FINGERS = {"finger_1": (-0.0455, 0.036), "finger_2": (-0.0455, -0.036), "finger_middle": (0.0455, 0.0)}
"""Where the fingers stand on the palm, x and z, m."""
HEIGHT = 0.0214
NOTE = """
  Units m, kg, rad. Base frame as in the public ROS description: +y out of the palm, middle finger at +x.
  Efforts give the maker's 60 N at the pads: the parallel fingertip moves 96 mm per radian of joint 1, 5.8 N m; the
  scissor's 4 N m is a guess (30 N at the fingertips).
  Coupling: as long as nothing but a fingertip touches, joint 2 rests at 0 and joint 3 turns back by joint 1, so that
  the fingertip keeps its direction.
"""


def link(name: str, kind: str, body: trimesh.Trimesh, density: float) -> str:
    """Return the URDF text of a link."""
    body.density = density
    inertia = body.moment_inertia
    entries = " ".join(f'i{"xyz"[i]}{"xyz"[j]}="{inertia[i, j]:.6g}"' for i in range(3) for j in range(i, 3))
    center = " ".join(f"{value:.6g}" for value in body.center_mass)
    shape = f'<geometry><mesh filename="../meshes/{kind}.stl"/></geometry>'
    return "\n".join(
        [
            f'  <link name="{name}">',
            f'    <inertial><origin xyz="{center}"/><mass value="{body.mass:.6g}"/><inertia {entries}/></inertial>',
            f'    <visual>{shape}<material name="{"palm" if kind == "palm" else "finger"}"/></visual>',
            f"    <collision>{shape}</collision>",
            "  </link>",
        ]
    )


def joint(
    name: str, parent: str, child: str, xyz: str, rpy: str, limits: tuple[float, float] | None, axis: str = "0 0 1",
    effort: float = EFFORT, mimic: str = "",
) -> str:  # fmt: skip
    """Return the URDF text of a joint: revolute within `limits`, or fixed; `mimic` is a joint that it mirrors."""
    lines = [f'    <parent link="{parent}"/><child link="{child}"/>', f'    <origin xyz="{xyz}" rpy="{rpy}"/>']
    if limits:
        lines.append(f'    <axis xyz="{axis}"/>')
        lines.append(f'    <limit lower="{limits[0]}" upper="{limits[1]}" effort="{effort}" velocity="2.0"/>')
    if mimic:
        lines.append(f'    <mimic joint="{mimic}" multiplier="-1"/>')
    return "\n".join([f'  <joint name="{name}" type="{"revolute" if limits else "fixed"}">', *lines, "  </joint>"])


def main() -> None:
    """Write meshes/*.stl and urdf/robotiq_3f.urdf into the package."""
    bodies = {kind: body.apply_scale(0.001) for kind, body in geometry.solids().items()}
    volume = sum(body.volume * (1 if kind == "palm" else COUNT) for kind, body in bodies.items())
    for kind, body in bodies.items():
        body.export(PACKAGE / "meshes" / f"{kind}.stl")
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by author_urdf.py: change that, not this.{NOTE}-->",
        '<robot name="robotiq_3f">',
        '  <material name="palm"><color rgba="0.30 0.31 0.33 1"/></material>',
        '  <material name="finger"><color rgba="0.62 0.63 0.65 1"/></material>',
        link("palm", "palm", bodies["palm"], MASS / volume),
    ]
    right, half = repr(math.pi / 2), repr(math.pi)
    for finger, (x, z) in FINGERS.items():
        names = [f"{finger}_link_{number}" for number in range(4)]
        lines += [link(name, name[-6:], bodies[name[-6:]], MASS / volume) for name in names]
        place, scissor = f"{x} {HEIGHT} {z}", f"palm_{finger}_joint"
        if finger == "finger_middle":
            lines.append(joint(scissor, "palm", names[0], place, f"0 0 {right}", None))
        else:
            first = finger == "finger_1"
            limits, mimic = ((-0.1784, 0.192), "") if first else ((-0.192, 0.1784), "palm_finger_1_joint")
            turn = f"0 {half} -{right}"
            lines.append(joint(scissor, "palm", names[0], place, turn, limits, "0 1 0", SCISSOR_EFFORT, mimic))
        one = f"{finger}_joint_1"
        lines.append(joint(one, names[0], names[1], "0.020 0 0", "0 0 0", (0.0495, 1.2218)))
        lines.append(joint(f"{finger}_joint_2", names[1], names[2], "0.050 -0.028 0", f"0 0 {-geometry.TILT}", None))
        lines.append(
            joint(f"{finger}_joint_3", names[2], names[3], "0.039 0 0", "0 0 0", (-1.2218, -0.0495), mimic=one)
        )
    lines += [
        '  <link name="palm_face"/>',
        '  <joint name="palm_face_joint" type="fixed">\n    <parent link="palm"/><child link="palm_face"/>',
        f'    <origin xyz="0 0.0508 0" rpy="-{right} 0 0"/>\n  </joint>',
    ]
    (PACKAGE / "urdf" / "robotiq_3f.urdf").write_text("\n".join([*lines, "</robot>\n"]))
    print({kind: round(body.volume * 1e6, 1) for kind, body in bodies.items()}, round(MASS / volume), "kg/m3")


if __name__ == "__main__":
    main()
