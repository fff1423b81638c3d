"""Near-duplicates, order and coverage of grasps."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.dataset.spread import coverage, distinct, spread
from dexgrasp.dataset.surface import Surface
from dexgrasp.distance import DistanceField
from dexgrasp.grasps import Grasps
from dexgrasp.objects import Object


def grasps(positions, quality):
    pose = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1)
    pose[:, :3, 3] = torch.as_tensor(positions, dtype=torch.float64)
    found = Grasps.build(pose, torch.zeros(len(positions), 4, dtype=torch.float64), 3)
    contacts = pose[:, None, :3, 3].expand(-1, 3, -1).clone()
    return found.replace(contacts=contacts, quality=torch.as_tensor(quality, dtype=torch.float64))


def test_the_best_of_a_cell_stays(hand):
    step = [0.0, 0.001, 0.05, 0.051, 0.1]
    some = grasps([[x + 0.002, 0.002, 0.002] for x in step], [0.1, 0.3, 0.2, 0.1, 0.4])
    assert distinct(some, hand, 0.01, 0.2, 0.2).tolist() == [1, 2, 4]
    assert distinct(some[:0], hand, 0.01, 0.2, 0.2).tolist() == []


def test_every_region_comes_before_any_comes_again():
    some = grasps([[0.001, 0, 0], [0.002, 0, 0], [0.003, 0, 0], [0.1, 0, 0]], [0.1, 0.3, 0.2, 0.05])
    assert spread(some).tolist() == [1, 3, 2, 0]


def test_coverage_counts_what_is_near_and_aligned(hand):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    item = Object("box", "test", mesh, (mesh,))
    surface = Surface.sample(item, DistanceField.build(mesh), 0.003, np.random.default_rng(0))
    top = surface.points[surface.normals[:, 2] > 0.9]
    some = grasps(top, torch.ones(len(top))).replace(normals=torch.tensor([0.0, 0.0, 1.0]).expand(len(top), 3, 3))
    reached = coverage(hand, surface, some.to(torch.float64))
    assert reached.surface == pytest.approx(1 / 6, abs=0.02)  # the top, nothing round its edges
    assert reached.directions == 1 / 200  # all come from one side
    turned = some.replace(normals=-some.normals).to(torch.float64)
    assert coverage(hand, surface, turned).surface == 0
    assert coverage(hand, surface, some[:0]).surface == 0
