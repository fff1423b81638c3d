"""Shapes of a loaded hand: its size, what is seen against what is met, fingertips where the mesh has them."""

from collections.abc import Iterator

import numpy as np
import torch
import trimesh

from dexgrasp.convex import deviation
from dexgrasp.doctor.finding import Finding, error, note, warning
from dexgrasp.doctor.solid import bodies, closed_by, outside, way_out
from dexgrasp.hand import Hand
from dexgrasp.repair import lightened
from dexgrasp.urdf_geometry import joined

SMALL, LARGE = 0.04, 0.6
"""Lengths of a hand, m, that are strange; a third and three times that are wrong."""
OFF, FAR_OFF = 0.008, 0.02
"""How far collision geometry may be from what is seen, m (90 % of the surface)."""
FINE = 400
"""Corners of one convex part that make closing slow."""
LIGHT = 20_000
"""Faces of a mesh that is looked at; finer ones are simplified."""
LOOSE, WRONG = 0.002, 0.006
"""How far the fingertip circle may be off the link's surface, m."""
AWAY = 0.03
"""Distance of a link's shape from the joint that carries it, or from the next one, that is strange, m."""


def the_whole_has_the_size_of_a_hand(hand: Hand) -> Iterator[Finding]:
    """The open hand is as large as hands are."""
    poses = hand.link_poses(closed_by(hand, 0.0))
    points = [np.asarray(mesh.vertices) @ poses[link][0, :3, :3].numpy().T + poses[link][0, :3, 3].numpy()
              for link, mesh in _shapes(hand)]  # fmt: skip
    if not points:
        return
    length = float(np.ptp(np.concatenate(points), axis=0).max())
    if SMALL <= length <= LARGE:
        return
    wrong = not SMALL / 3 <= length <= 3 * LARGE
    yield (error if wrong else warning)(
        hand.name,
        f"the open hand is {length:.3g} m long",
        "hands are 0.05 to 0.4 m long; objects of datasets are 2 to 30 cm",
        "write meshes and joint origins in metres; where the URDF holds an arm, name the hand's base link as `root`",
    )


def shapes_hang_together(hand: Hand) -> Iterator[Finding]:
    """Each link's shape lies near the joint that carries it or near those that it carries."""
    tree = getattr(hand, "tree", ())
    for number, record in enumerate(tree):
        for tag, meshes in (("visual", hand.visuals), ("collision", hand.collisions)):
            shape = meshes.get(record.name)
            if shape is None:
                continue
            mesh = shape if isinstance(shape, trimesh.Trimesh) else joined(shape)
            joints = [r.parent_T_joint[:3, 3] for r in tree if r.parent == number]
            joints += [np.zeros(3)] if record.parent >= 0 or not joints else []
            low, high = mesh.bounds
            gaps = [float(np.linalg.norm(np.maximum(np.maximum(low - p, p - high), 0))) for p in joints]
            if min(gaps) > max(AWAY, 0.5 * float(mesh.extents.max())):
                yield error(
                    f"{record.name} ({tag})",
                    f"its shape lies {min(gaps):.3g} m from the nearest of its joints",
                    "the shape is at the wrong place: fingers are met where there are none",
                    f"correct <origin> and scale of its <{tag}>; a mirrored hand needs mirrored meshes",
                )


def collision_follows_what_is_seen(hand: Hand) -> Iterator[Finding]:
    """Collision geometry lies where the visual mesh is, and is there for every link that is seen."""
    fingers = {finger.link for finger in hand.fingers}
    poses = {link: pose[0].numpy() for link, pose in hand.link_poses(closed_by(hand, 0.0)).items()}
    for carrier, links in bodies(hand).items():
        seen = [
            lightened(hand.visuals[link], LIGHT).apply_transform(poses[link]) for link in links if link in hand.visuals
        ]
        parts = [part.copy().apply_transform(poses[link]) for link in links for part in hand.collisions.get(link, ())]
        if not seen:
            continue
        visual = joined(seen)
        if not parts:
            if not fingers & set(links) and visual.extents.max() > 0.005:  # of fingertips, the laws say so
                yield warning(
                    carrier,
                    "is seen, but has no collision geometry",
                    "it passes through objects, table and other links, in search and in physics",
                    "add <collision> with the visual mesh (it is cut into convex parts), or boxes and cylinders",
                )
            continue
        bare = float(np.quantile(deviation(visual, tuple(parts))[0], 0.9))
        points, _ = trimesh.sample.sample_surface(joined(parts), 1000, seed=0)
        skin = trimesh.proximity.closest_point(visual, points)[1]
        beyond = float(np.quantile(np.where(_within(seen, points), 0.0, skin), 0.9))
        worst = max(bare, beyond)
        if worst > OFF:
            tell = error if worst > max(FAR_OFF, 0.3 * float(visual.extents.max())) else warning
            yield tell(
                carrier,
                f"collision geometry is up to {worst * 1e3:.0f} mm off the visual mesh ({bare * 1e3:.0f} mm of the "
                f"mesh stand out, {beyond * 1e3:.0f} mm of the collision parts)",
                "grasps that look right touch nothing, or penetrate what is seen",
                "correct <origin> or scale of <collision>; or take the visual mesh (`collision: visual` in the YAML)",
            )


def collision_parts_are_coarse(hand: Hand) -> Iterator[Finding]:
    """Convex parts have few corners."""
    for link, parts in hand.collisions.items():
        most = max(len(part.vertices) for part in parts)
        if most > FINE:
            yield note(
                link,
                f"a convex collision part has {most:,} corners",
                "closing and physics slow down with them and gain nothing",
                "simplify it to some 60 corners",
            )


def fingertips_lie_on_the_mesh(hand: Hand) -> Iterator[Finding]:
    """The fingertip circle touches the distal link's surface from inside, somewhere from pad to tip."""
    for finger in hand.fingers:
        parts = hand.collisions.get(finger.link)
        if not parts:
            continue
        center = finger.tip_center.numpy()
        u, w = finger.tip_axis, finger.closing_axis
        pad = -torch.linalg.cross(w, u)
        angles = torch.deg2rad(torch.arange(0.0, 75.0, 15.0, dtype=torch.float64))[:, None]
        rays = (angles.cos() * pad - angles.sin() * u).numpy()
        away = float(outside(parts, center[None])[0])
        lies = " ".join(f"{1e3 * value:.1f}" for value in center)
        why = "contacts are told from this circle: grasps would be off by as much"
        mend = (
            "leave tip_center and tip_radius out of the YAML (they are fitted), or measure them in link coordinates, m"
        )
        if away > LOOSE:
            yield error(
                finger.name,
                f"the fingertip's centre ({lies} mm) lies {away * 1e3:.1f} mm outside {finger.link}",
                why,
                mend,
            )
            continue
        gaps = np.array([way_out(parts, center, ray) for ray in rays]) - finger.tip_radius
        best = float(gaps[np.abs(gaps).argmin()])
        if abs(best) > LOOSE:
            where = "inside the mesh" if best > 0 else "out of the mesh"
            yield (error if abs(best) > WRONG else warning)(
                finger.name,
                f"the fingertip circle (radius {finger.tip_radius * 1e3:.1f} mm about {lies} mm) lies "
                f"{abs(best) * 1e3:.1f} mm {where} of {finger.link} all the way from pad to tip",
                why,
                mend,
            )


def _shapes(hand: Hand) -> Iterator[tuple[str, trimesh.Trimesh]]:
    yield from hand.visuals.items()
    for link, parts in hand.collisions.items():
        for part in parts:
            yield link, part


def _within(meshes: list[trimesh.Trimesh], points: np.ndarray) -> np.ndarray:
    """Whether points lie inside one of some meshes; of one that is not closed, inside its hull."""
    solids = [mesh if mesh.is_watertight else mesh.convex_hull for mesh in meshes]
    return np.any([solid.contains(points) for solid in solids], axis=0)
