"""The lazy hull against qhull, closed forms, explicit Minkowski sums, and hulls that rounding could tear."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.spatial import ConvexHull, QhullError

from dexgrasp.errors import DexgraspError
from dexgrasp.quality import epsilon, nearest_facet, reaches, volume, wrenches
from dexgrasp.seeds import stream

SHARES = {2: 2500, 3: 36000, 4: 7500, 5: 2800, 6: 1600, 8: 900, 10: 400, 12: 200, 16: 70, 20: 40}
"""Contacts -> sets: 52,010, of which some are flat."""


def sets_of(fingers, count, rng):
    """Yield wrench sets: contacts on balls, boxes (exactly coplanar, parallel cones) and cylinders; all else drawn."""
    for _ in range(count):
        points = rng.normal(size=(fingers, 3))
        shape = rng.integers(3)
        if shape == 0:
            points /= np.linalg.norm(points, axis=1, keepdims=True)
            normals = points + 0.3 * rng.normal(size=points.shape)
        elif shape == 1:
            side = np.abs(points).argmax(axis=1)
            normals = np.sign(points[range(fingers), side])[:, None] * np.eye(3)[side]
            points = np.round(8 * points / np.abs(points).max(axis=1, keepdims=True)) / 8
        else:
            points[:, :2] /= np.linalg.norm(points[:, :2], axis=1, keepdims=True)
            normals = points * [1, 1, 0]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Two hard fingers span 5-D; qhull takes seconds for many soft ones.
        torsion = rng.uniform(0.05, 0.5) if fingers == 2 or (fingers < 5 and rng.random() < 0.03) else 0.0
        friction, scale = rng.uniform(0.1, 1), rng.uniform(0.5, 2)
        edges = int(rng.integers(4, 11, size=2).min())  # 4 to 10, rather few: qhull's time grows steeply with them
        yield wrenches(points[None], normals[None], points.mean(axis=0), scale, friction, edges, torsion)[0]


def qhull(points):
    try:
        hull = ConvexHull(points)
    except QhullError:  # flat, or qhull gave up
        return None
    return max(0.0, -hull.equations[:, -1].max())


def agreement(shares, key):
    worst, compared, closures = 0.0, 0, 0
    for fingers, count in shares.items():
        for points in sets_of(fingers, count, stream(0, key, fingers)):
            expected = qhull(points)
            if expected is None:
                continue
            found = float(epsilon(points[None])[0])
            worst, compared, closures = max(worst, abs(found - expected)), compared + 1, closures + (expected > 0)
    return worst, compared, closures


def test_agrees_with_qhull():
    shares = {fingers: min(count, 2500 // fingers**2) for fingers, count in SHARES.items()}
    worst, compared, closures = agreement(shares, "some")
    assert worst <= 1e-10
    assert compared > 0.95 * sum(shares.values())
    assert closures > 100


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("fingers", "least"), [((3,), 34_200), (set(SHARES) - {3}, 15_800)], ids=["3", "others"])
def test_agrees_with_qhull_on_fifty_thousand(fingers, least):
    """In two halves, for two workers."""
    worst, compared, closures = agreement({count: SHARES[count] for count in sorted(fingers)}, "many")
    print(f"{compared} sets, {closures} with closure, largest difference {worst:.1e}")
    assert worst <= 1e-9
    assert compared >= least
    assert closures > 5_000


def minkowski(points, fingers):
    corners = np.zeros((1, 6))
    for cone in points.reshape(fingers, -1, 6):
        cone = np.concatenate([np.zeros((1, 6)), cone])
        corners = (corners[:, None] + cone).reshape(-1, 6)
    return corners


@pytest.mark.parametrize(("fingers", "edges", "torsion"), [(3, 4, 0.0), (3, 6, 0.0), (4, 4, 0.0), (2, 3, 0.2)])
def test_linf_is_the_hull_of_the_minkowski_sum(fingers, edges, torsion):
    rng, closures = stream(1, fingers, edges), 0
    for _ in range(6):
        points = rng.normal(size=(1, fingers, 3))
        points /= np.linalg.norm(points, axis=-1, keepdims=True)
        points[:, 1] = -points[:, 0]
        sets = wrenches(points, points, np.zeros(3), 1.2, 0.9, edges, torsion)
        hull = ConvexHull(minkowski(sets[0], fingers))
        expected = max(0.0, -hull.equations[:, -1].max())
        closures += expected > 1e-9
        assert epsilon(sets, contacts=fingers)[0] == pytest.approx(expected, abs=1e-10)
        assert volume(sets, fingers)[0] == pytest.approx(hull.volume, rel=1e-6)
    assert closures or fingers == 2


def test_linf_of_axes_is_a_box_and_between_l1_and_its_multiple():
    cross = np.stack([np.eye(6), -np.eye(6)], axis=1).reshape(1, 12, 6)
    assert epsilon(cross, contacts=6)[0] == pytest.approx(1.0, abs=1e-12)  # sum of segments: the cube
    assert volume(cross, contacts=6)[0] == pytest.approx(64.0, rel=1e-7)
    sets = np.stack([points for points in sets_of(4, 60, stream(2)) if len(points) == 32])
    l1, linf = epsilon(sets), epsilon(sets, contacts=4)
    assert (linf >= l1 - 1e-11).all()
    assert (linf <= 4 * l1 + 1e-11).all()


def test_volume_agrees_with_qhull_and_closed_forms():
    cross = np.concatenate([np.eye(6), -np.eye(6)])
    cube = np.array(list(product([-1.0, 1.0], repeat=6)))
    simplex = np.concatenate([np.zeros((1, 6)), np.eye(6)]) + 3.0  # the origin far outside
    for points, expected in ((cross, 64 / 720), (cube, 64.0), (simplex, 1 / 720), (cross * [1, 1, 1, 1, 1, 0], 0.0)):
        assert volume(points[None])[0] == pytest.approx(expected, rel=1e-7)
    for points in sets_of(4, 60, stream(3)):
        if qhull(points) is not None:
            assert volume(points[None])[0] == pytest.approx(ConvexHull(points).volume, rel=1e-6, abs=1e-12)


def test_degenerate_sets_give_exactly_zero_by_every_hull():
    cross = np.concatenate([np.eye(6), -np.eye(6)])
    turned = cross @ np.linalg.qr(stream(4).normal(size=(6, 6)))[0]
    flat = turned - turned @ np.outer(turned[0], turned[0])  # rank 5, in no axis's way
    on_facet = turned - turned[:6].mean(axis=0)  # a facet of the cross runs through the origin
    at_corner = turned - turned[0]
    away = turned + 2 * turned[0]
    sets = np.stack([flat, on_facet, at_corner, away, np.zeros_like(cross)])
    assert epsilon(sets).tolist() == [0.0] * 5
    assert epsilon(sets, 0.05).tolist() == [0.0] * 5
    assert not reaches(sets, 1e-6).any()
    assert epsilon(sets[[0, 3, 4]], contacts=1).tolist() == [0.0] * 3
    shifted = turned - 0.25 * turned[0]  # facets on that side are at 0.75 / sqrt(6)
    assert epsilon(shifted[None])[0] == pytest.approx(0.75 / math.sqrt(6), abs=1e-12)


@pytest.mark.parametrize("noise", [1e-12, 1e-11, 1e-10, 1e-8])
def test_wrenches_that_are_almost_coplanar(noise):
    rng = stream(7)
    for fingers in (3, 6):
        for points in sets_of(fingers, 12, rng):
            points = points + noise * rng.normal(size=points.shape)
            hull = ConvexHull(points)
            assert epsilon(points[None])[0] == pytest.approx(max(0.0, -hull.equations[:, -1].max()), abs=1e-9)
            if hull.volume > 1e-6:
                assert volume(points[None])[0] == pytest.approx(hull.volume, rel=1e-5)


def test_nearest_facet_is_told():
    sets = np.stack([points for points in sets_of(4, 60, stream(5)) if len(points) == 32])
    radius, normal, names = nearest_facet(sets)
    assert np.array_equal(radius > 0, epsilon(sets) > 0)
    for points, r, n, rows in zip(sets, radius, normal, names, strict=True):
        if r > 0:
            assert np.linalg.norm(n) == pytest.approx(1)
            np.testing.assert_allclose(points[rows] @ n, r, atol=1e-10)
            assert (points @ n).max() <= r + 1e-10
        else:
            assert (points @ n).max() <= 1e-10


def test_bits_do_not_depend_on_company_and_large_sets_find_room():
    sets = stream(6).normal(size=(3, 400, 6))
    together = epsilon(sets)
    assert [epsilon(one[None])[0] for one in sets] == together.tolist()
    np.testing.assert_allclose(together[:1], [qhull(sets[0][np.abs(sets[0]).sum(axis=1) > 2])], atol=1e-10)


def test_contacts_must_share_the_wrenches():
    with pytest.raises(DexgraspError, match="every contact"):
        epsilon(np.zeros((1, 8, 6)), contacts=3)
