"""The first look of an evaluation in one picture: depth, cloud with graspability, top grasps."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexgrasp.campaign import Campaign
from dexgrasp.cloud import prepare
from dexgrasp.evaluation import Episode, present
from dexgrasp.geometry import look_at
from dexgrasp.level import carried, level_frame
from dexgrasp.model import load_model
from dexgrasp.picture import picture
from dexgrasp.report import PALETTE
from dexgrasp.scene import View
from dexgrasp.table import find_table

RANKS = ((0.25, 0.60, 0.32), (0.85, 0.70, 0.35), (0.80, 0.40, 0.33))
"""Colours of the hand at the best, second and third grasp; more hide each other."""


def draw_look(folder: Path, campaign: Campaign, episodes: Sequence[Episode]) -> list[tuple[str, Path]]:
    """Draw the first look whose attempts are kept, if any; return captions and files.

    Graspability is the network's; a planner tells none, and its cloud is coloured by height.
    """
    kept = [(episode.scene, strip) for episode in episodes for strip in episode.strips[:1]]
    if not kept:
        return []
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene, strip = kept[0]
    figure = Figure(figsize=(13.5, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    standing = present(strip["poses"])
    objects = [campaign.dataset.objects[strip["names"][i]] for i in standing]
    depth = campaign.depth(scene, objects, strip["poses"][standing], strip["seed"])
    image = left.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r")
    left.set_title("measured depth, m; white: nothing measured", fontsize=9)
    figure.colorbar(image, ax=left, shrink=0.8)
    points, values, told = _cloud(campaign, strip["view"])
    order = np.argsort(values)
    x, y, z = points[order].T
    drawn = middle.scatter(x / z, y / z, c=values[order], s=5, linewidths=0, cmap="RdYlGn" if told else "viridis")
    middle.set_aspect("equal")
    middle.invert_yaxis()
    middle.set_title("cloud with graspability" if told else "cloud with height, m", fontsize=9)
    figure.colorbar(drawn, ax=middle, shrink=0.8)
    right.imshow(_top(campaign, strip, standing))
    offered = len(strip["offered"])
    right.set_title(f"the best {min(len(RANKS), offered)} of {offered} grasps: green, yellow, red", fontsize=9)
    for axes in (left, middle, right):
        axes.set_xticks([])
        axes.set_yticks([])
    path = folder / "look.png"
    figure.savefig(path, dpi=100)
    return [(f"Scene {scene}: what was seen, and the grasps for it", path)]


def _cloud(campaign: Campaign, view: View) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return points (camera frame), a number for each, and whether it is the network's graspability."""
    if campaign.model is None:
        height = view.points.double() @ view.world_T_camera[2, :3].double() + view.world_T_camera[2, 3].double()
        return view.points.double().numpy(), height.numpy(), False
    network = load_model(campaign.model)
    cloud = prepare(view.points, view.normals, network.points, campaign.seed)
    level = level_frame(cloud, find_table(cloud, campaign.seed))
    _, seeds, grasps = network.told(carried(cloud, level))
    return cloud[seeds, :3].double().numpy(), grasps[0].quality.double().numpy(), True


def _top(campaign: Campaign, strip: dict[str, Any], standing: list[int]) -> np.ndarray:
    """Render the scene from the camera's side, with the hand at the best grasps."""
    hand, objects = campaign.dataset.hand, campaign.dataset.objects
    bodies = [
        (objects[strip["names"][i]].mesh, strip["poses"][i].double().numpy(), PALETTE[i % len(PALETTE)])
        for i in standing
    ]
    grasps = strip["offered"][: len(RANKS)].to(torch.float64)
    links = hand.link_poses(grasps.joints)
    for i in range(len(grasps)):
        bodies += [(mesh, (grasps.pose[i] @ links[link][i]).numpy(), RANKS[i]) for link, mesh in hand.visuals.items()]
    at = grasps.pose[:, :3, 3].mean(dim=0) * 0.5
    away = strip["view"].world_T_camera[:3, 3].double() - at
    return picture(bodies, look_at(at + 0.7 * away / away.norm(), at).numpy(), (360, 480))
