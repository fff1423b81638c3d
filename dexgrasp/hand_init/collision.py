"""What of a hand collides: convex parts, and how far they are from what one sees."""

import logging
from dataclasses import dataclass

import numpy as np
import trimesh

from dexgrasp.convex import Slow, convex_parts, deviation
from dexgrasp.hand_init.anatomy import Anatomy
from dexgrasp.hand_init.fingers import FingerGuess
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.mesh_files import placed
from dexgrasp.hand_init.model import Link, Model
from dexgrasp.progress import track
from dexgrasp.repair import halved, lightened
from dexgrasp.shapes.solid import fibonacci
from dexgrasp.urdf_geometry import DEPTH, convex_pieces, joined

FAR, FAR_TIP = 0.004, 0.002
"""Given collision shapes that are farther (95 %) from the visual ones are made anew, m; on distal links."""
CORNERS = 160
"""A convex part of more is simplified: closing slows down with them."""
MOST, COARSE = 12, 0.016
"""A link of more parts is cut less finely: slower for nothing; twice the depth of dents that may be filled, m."""
FACES, CUT = 20000, 3000
"""A mesh of more faces is simplified before it is written, and before it is cut."""
SECONDS, PIECES = 30, 6
"""Processor time that cutting a mesh may take; where that is not enough, hulls of so many slices stand for it."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Fit:
    """How well parts fit a link's visible surface, m (95 % of points are nearer)."""

    link: str
    source: str
    parts: int
    outside: float
    """How far the mesh stands out of the parts."""
    beyond: float
    """How far the parts stand out of the mesh."""

    @property
    def worst(self) -> float:
        """The larger of the two."""
        return max(self.outside, self.beyond)

    def __str__(self) -> str:
        return f"{self.parts} convex parts, {self.worst * 1e3:.1f} mm off"


def read_visuals(model: Model, guesses: Guesses) -> None:
    """Set what one sees of each link: its visual shapes, else its collision shapes."""
    for link in model.links.values():
        meshes = placed(link.visuals) or placed(link.collisions)
        link.visual = lightened(joined(meshes), FACES) if meshes else None


def drop_envelopes(anatomy: Anatomy, guesses: Guesses) -> None:
    """Take away shapes of the palm that enclose the fingers: zones of safety, no bodies."""
    model = anatomy.model
    poses = model.poses({})
    moving = [name for name in model.links if name not in anatomy.palm and model.links[name].mesh is not None]
    clouds = []
    for name in moving:
        mesh = model.links[name].mesh
        assert mesh is not None
        clouds.append(mesh.vertices @ poses[name][0, :3, :3].T + poses[name][0, :3, 3])
    for name in anatomy.palm:
        link = model.links[name]
        for shapes in (link.visuals, link.collisions):
            for shape in list(shapes):
                if shape.mesh is None or not clouds:
                    continue
                (mesh,) = placed([shape])
                points = (np.vstack(clouds) - poses[name][0, :3, 3]) @ poses[name][0, :3, :3]
                low, high = mesh.bounds
                if ((points > low) & (points < high)).all(axis=1).mean() > 0.6 and len(mesh.faces) <= 1280:
                    shapes.remove(shape)
                    guesses.add("collision", f"a shape of {name} encloses the fingers: left out", "likely")
    read_visuals(model, guesses)


def make_parts(model: Model, fingers: list[FingerGuess], guesses: Guesses) -> list[Fit]:
    """Set the convex parts of every link that has a shape: the given ones where they fit what one sees."""
    tips, fits = {finger.link for finger in fingers}, []
    made: dict[bytes, tuple[tuple[trimesh.Trimesh, ...], str]] = {}
    for link in track([link for link in model.links.values() if link.solid], "collision shapes"):
        given, seen = placed(link.collisions), placed(link.visuals)
        whole = lightened(joined(seen or given), FACES)
        limit = FAR_TIP if link.name in tips else FAR
        fit = None
        if given:
            link.parts = _parts(given, link, guesses, made)
            fit = _fit(link, "given", whole)
        if seen and (fit is None or fit.worst > limit):
            old, before = link.parts, fit
            link.parts = _parts([whole], link, guesses, made)
            fit = _fit(link, "from the visual mesh", whole)
            if before is None:
                text = f"{link.name} has no collision shape; {fit} of the visual mesh taken"
                guesses.add("collision", text, "likely" if fit.worst < FAR else "UNSURE")
            elif fit.worst > 0.6 * before.worst:
                text = f"{link.name}: the given shapes are kept, though {before.worst * 1e3:.1f} mm off the mesh"
                guesses.add("collision", f"{text}: parts of it are no better ({fit})", "likely")
                link.parts, fit = old, before
            else:
                text = f"{link.name}: {fit} of the visual mesh taken; the given shapes stand"
                guesses.add("collision", f"{text} {before.worst * 1e3:.1f} mm off it", "likely")
        assert fit is not None
        fits.append(fit)
    return fits


def _parts(
    meshes: list[trimesh.Trimesh],
    link: Link,
    guesses: Guesses,
    made: dict[bytes, tuple[tuple[trimesh.Trimesh, ...], str]],
) -> tuple[trimesh.Trimesh, ...]:
    """Return convex parts; the same mesh is cut once."""
    parts: list[trimesh.Trimesh] = []
    for mesh in meshes:
        key = np.round(mesh.triangles, 7).tobytes()
        if key not in made:
            made[key] = _cut(mesh, link.name)
        found, trouble = made[key]
        if trouble:
            guesses.add("collision", f"{link.name} {trouble}", "UNSURE")
        parts += found
    return tuple(parts)


def _cut(mesh: trimesh.Trimesh, link: str) -> tuple[tuple[trimesh.Trimesh, ...], str]:
    """Return a mesh as not too many convex parts, and what was in the way."""
    # An open mesh is closed by voxels first, whose time grows with the faces, and whose steps are no dents.
    mesh = lightened(mesh, CUT)
    depth = DEPTH if mesh.is_watertight else 2 * DEPTH
    try:
        parts = tuple(_few_corners(part) for part in convex_pieces(mesh, link, depth, SECONDS))
        return (parts if len(parts) <= MOST else convex_parts(mesh, COARSE, SECONDS)), ""
    except Slow:
        reason = f"could not be cut into convex parts within {SECONDS} s"
    except Exception as error:  # the decomposition has its own on broken meshes
        reason = "could not be cut into convex parts"
        log.debug("%s: %s", link, error)
    slices = tuple(_few_corners(hull) for hull in halved(mesh, PIECES))
    if slices:
        return slices, f"{reason}: the hulls of {len(slices)} slices of it were taken"
    return (_wrapped(mesh),), f"{reason}: its hull was taken"


def _few_corners(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a convex body of at most `CORNERS` corners: those that are farthest in as many directions."""
    if len(part.vertices) <= CORNERS:
        return part
    points = np.asarray(part.vertices)
    return trimesh.convex.convex_hull(points[np.unique((points @ fibonacci(CORNERS).T).argmax(axis=0))])


def _wrapped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    try:
        return mesh.convex_hull
    except Exception:  # flat: a thin box
        flat = trimesh.creation.box(np.maximum(mesh.extents, 1e-3))
        flat.apply_translation(mesh.bounds.mean(axis=0))
        return flat


def _fit(link: Link, source: str, mesh: trimesh.Trimesh) -> Fit:
    outside, _ = deviation(mesh, link.parts)
    points = np.vstack([trimesh.sample.sample_surface(part, 400, seed=0)[0] for part in link.parts])
    # Points of one part within another are no surface.
    depth = np.full(len(points), np.inf)
    for number, part in enumerate(link.parts):
        offset = np.einsum("ij,ij->i", part.face_normals, part.triangles[:, 0])
        signed = (points @ part.face_normals.T - offset).max(axis=1)
        signed[number * 400 : (number + 1) * 400] = np.inf
        depth = np.minimum(depth, signed)
    open_ = points[depth > -1e-4]
    if len(open_) == 0:
        return Fit(link.name, source, len(link.parts), float(np.quantile(outside, 0.95)), 0.0)
    beyond = np.asarray(trimesh.proximity.closest_point(mesh, open_)[1])
    # What lies within a closed mesh does not stand out of it.
    if mesh.is_watertight:
        beyond = np.where(mesh.contains(open_), 0.0, beyond)
    return Fit(link.name, source, len(link.parts), float(np.quantile(outside, 0.95)), float(np.quantile(beyond, 0.95)))
