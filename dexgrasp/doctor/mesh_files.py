"""Mesh files of a URDF: there, whole, in metres, not too fine, not inside out."""

from collections.abc import Iterator

import numpy as np

from dexgrasp.doctor.description import Description, MeshFile
from dexgrasp.doctor.finding import Finding, error, note, warning

LONGEST, LONG = 2.0, 0.6
"""Extents of a hand's link (m) that are refused, and that are strange."""
SHORTEST = 0.001
FINE, TOO_FINE = 100_000, 1_000_000
"""Faces that make loading slow, and that make it very slow."""
SCALES = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}


def meshes_are_there(hand: Description) -> Iterator[Finding]:
    """Every mesh file that the URDF names exists and can be read."""
    for path, problem, links in _bad(hand):
        yield error(
            ", ".join(links),
            f"mesh {path} is {problem}",
            "the link has no shape there: nothing is seen of it, or it passes through objects",
            "copy the file to where the URDF says; package://name/rest is looked up in the folders above the URDF and "
            "in ROS_PACKAGE_PATH"
            if problem == "missing"
            else "export the mesh again",
        )


def meshes_are_in_metres(hand: Description) -> Iterator[Finding]:
    """Meshes have the size of a hand's links."""
    for file in _whole(hand):
        assert file.mesh is not None
        extent = float(file.mesh.extents.max())
        if SHORTEST <= extent <= LONG:
            continue
        tell = error if extent > LONGEST or extent < SHORTEST else warning
        told = " ".join(f"{value:g}" for value in file.scale)
        if extent < SHORTEST:
            guess = f"it may be scaled twice: scale={told!r} of a file that is in metres already; remove the scale"
        else:
            unit = next((u for u, s in SCALES.items() if 0.005 <= extent * s <= 0.3), "another unit")
            factor = SCALES.get(unit, 1e-3)
            guess = f'it is probably in {unit}: write scale="{factor:g} {factor:g} {factor:g}" in the URDF'
        yield tell(
            f"{file.link} ({file.tag})",
            f"{file.filename} is {extent:.4g} m long (scale {told})",
            "everything here is in metres; at the wrong scale every grasp penetrates or misses",
            guess,
        )


def meshes_are_of_moderate_size(hand: Description) -> Iterator[Finding]:
    """Meshes are not so fine that they only cost time."""
    seen = set()
    for file in _whole(hand):
        assert file.mesh is not None
        faces = len(file.mesh.faces)
        if faces > FINE and file.path not in seen:
            seen.add(file.path)
            tell = error if faces > TOO_FINE and file.tag == "collision" else warning
            yield tell(
                f"{file.link} ({file.tag})",
                f"{file.filename} has {faces:,} faces",
                "loading, fingertip fits and convex parts take long and gain nothing above some thousand faces",
                "simplify it (trimesh: mesh.simplify_quadric_decimation(face_count=5000)), or give collision shapes of "
                "their own",
            )


def meshes_are_right_side_out(hand: Description) -> Iterator[Finding]:
    """Faces look outward; mirrored meshes (a negative scale) are told."""
    mirrored: dict[str, set[str]] = {}
    for file in _whole(hand):
        assert file.mesh is not None
        if np.prod(file.scale) < 0:
            mirrored.setdefault(file.link, set()).add(file.tag)
            continue
        if file.mesh.is_watertight and file.mesh.volume < 0:
            yield error(
                f"{file.link} ({file.tag})",
                f"{file.filename} is inside out (volume {file.mesh.volume * 1e6:.2f} cm3)",
                "inside and outside are exchanged: contacts and inertias computed from it have the wrong sign",
                "flip its faces (trimesh: mesh.invert()) and export it again",
            )
    for link, tags in mirrored.items():
        both = {file.tag for file in hand.meshes if file.link == link}
        if tags != both:
            yield error(
                link,
                f"the {' and '.join(tags)} mesh is mirrored (negative scale), the {' and '.join(both - tags)} mesh not",
                "what is seen and what is met lie on different sides: a left hand with a right hand's collision shapes",
                "mirror both or none",
            )
    if mirrored:
        yield note(
            ", ".join(mirrored),
            f"{len(mirrored)} links have mirrored meshes (scale with an odd number of minus signs)",
            "loaded right here (faces are flipped), but some simulators show them inside out or refuse them",
            "export mirrored files if another program complains",
        )


def _whole(hand: Description) -> list[MeshFile]:
    return [file for file in hand.meshes if file.mesh is not None]


def _bad(hand: Description) -> Iterator[tuple[str, str, list[str]]]:
    bad: dict[tuple[str, str], list[str]] = {}
    for file in hand.meshes:
        if file.problem:
            bad.setdefault((file.filename, file.problem), []).append(f"{file.link} ({file.tag})")
    for (name, problem), links in bad.items():
        yield name, problem, links
