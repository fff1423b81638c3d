"""Mending surfaces that are not one closed body."""

from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from scipy.ndimage import binary_fill_holes, distance_transform_edt


def manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices, dtype=float), mesh.faces.astype(np.uint64)))


def joined(bodies: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The union's surface: bodies that overlap would count their common volume twice."""
    return _surface(manifold3d.Manifold.batch_boolean([manifold(body) for body in bodies], manifold3d.OpType.Add))


def _surface(body: manifold3d.Manifold) -> trimesh.Trimesh:
    surface = body.to_mesh64()
    faces = np.asarray(surface.tri_verts).astype(np.int64)
    return trimesh.Trimesh(np.asarray(surface.vert_properties)[:, :3], faces, process=False)


def lightened(mesh: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """Return a copy of at most some `most` faces: edges are collapsed; where that ends early (many small bodies, loose
    triangles), corners are gathered in ever larger cells."""
    import fast_simplification

    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    cell = float(mesh.extents.max()) / 256
    while len(mesh.faces) > most:
        points, faces = fast_simplification.simplify(
            np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.int32), target_count=most
        )
        mesh = trimesh.Trimesh(points.astype(float), faces)
        if len(mesh.faces) <= 1.2 * most:
            break
        _, first, place = np.unique(np.round(mesh.vertices / cell), axis=0, return_index=True, return_inverse=True)
        mesh = trimesh.Trimesh(mesh.vertices[first], place.ravel()[mesh.faces])
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
        mesh.remove_unreferenced_vertices()
        cell *= 1.6
    return mesh


def halved(mesh: trimesh.Trimesh, count: int) -> list[trimesh.Trimesh]:
    """Return the hulls of pieces of a surface whose longest piece is cut in two, again and again, into `count`.

    Works on any surface, closed or not; each hull covers its piece, and fills its dents.
    """
    pieces = [mesh]
    for _ in range(count - 1):
        longest = max(range(len(pieces)), key=lambda i: float(pieces[i].extents.max()))
        piece = pieces.pop(longest)
        axis, middle = np.eye(3)[int(np.argmax(piece.extents))], piece.bounds.mean(axis=0)
        cuts = [trimesh.intersections.slice_mesh_plane(piece, side * axis, middle) for side in (1, -1)]
        pieces += [cut for cut in cuts if len(cut.faces)] or [piece]
    hulls = []
    for piece in pieces:
        try:
            hulls.append(piece.convex_hull)
        except Exception:  # flat: covered by the hulls beside it, nearly
            continue
    return hulls


def repaired(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, float]:
    """Return a closed version of an open mesh and how far its surface moved (m, 95th percentile, both ways).

    Holes are filled where that is enough; else the outside is rebuilt from voxels of 1/96 of the extent (an open
    vessel then gets a wall as thick as a voxel).
    """
    mended = mesh.copy()
    mended.update_faces(mended.unique_faces())
    trimesh.repair.fill_holes(mended)
    trimesh.repair.fix_normals(mended)
    if not mended.is_volume:
        mended = _remeshed(mesh)
    forth = trimesh.sample.sample_surface(mesh, 4000, seed=0)[0]
    back = trimesh.sample.sample_surface(mended, 4000, seed=0)[0]
    moved = [_distance(mended, forth), _distance(mesh, back)]
    return mended, float(max(np.percentile(side, 95) for side in moved))


def _distance(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    return np.abs(trimesh.proximity.closest_point(mesh, points)[1])


def _remeshed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The surface's shell of voxels, its inside filled, as a smooth closed mesh."""
    pitch = float(mesh.extents.max()) / 96
    grid = mesh.voxelized(pitch)
    solid = np.pad(binary_fill_holes(grid.matrix), 3)
    origin = grid.translation - 3 * pitch
    field = pitch * (distance_transform_edt(solid) - distance_transform_edt(~solid)) - 0.5 * pitch
    top = origin + pitch * (np.array(solid.shape) - 1.001)
    # Plain floats and one flat list: the level set asks for one point at a time, some 10^5 of them.
    values, (_, ny, nz), (ox, oy, oz) = field.ravel().tolist(), solid.shape, origin.tolist()
    last = [size - 2 for size in solid.shape]

    def inside(x: float, y: float, z: float) -> float:
        fx, fy, fz = (x - ox) / pitch, (y - oy) / pitch, (z - oz) / pitch
        i, j, k = (min(max(int(f), 0), most) for f, most in zip((fx, fy, fz), last, strict=True))
        fx, fy, fz = fx - i, fy - j, fz - k
        here = (i * ny + j) * nz + k
        lines = [
            values[at] * (1 - fz) + values[at + 1] * fz
            for at in (here, here + nz, here + ny * nz, here + (ny + 1) * nz)
        ]
        return (lines[0] * (1 - fy) + lines[1] * fy) * (1 - fx) + (lines[2] * (1 - fy) + lines[3] * fy) * fx

    return _surface(manifold3d.Manifold.level_set(inside, [*origin, *top], 1.5 * pitch))
