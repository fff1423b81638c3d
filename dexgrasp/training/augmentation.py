"""Views turned about the vertical: the same things and grasps, seen by a camera that stands elsewhere."""

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.dataset.samples import Batch
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.heads import contact_points
from dexgrasp.representation import Representation
from dexgrasp.seeds import stream


def turns(batch: Batch, most: float, seed: int, step: int, shard: int) -> Float[Tensor, "B"]:
    """Return an angle (rad) from -`most` to `most` for each view of a micro-batch, the same in whatever process."""
    drawn = stream(seed, "turn", step, shard).uniform(-most, most, len(batch.cloud))
    return torch.from_numpy(drawn).to(batch.cloud)


@torch.no_grad()
def turned(batch: Batch, representation: Representation, angles: Float[Tensor, "B"]) -> Batch:
    """Return the views turned about the level frame's z by `angles` (rad), with what is then told of their grasps.

    What neighbours what does not change, so the indices stay. Contact frames do not turn along (METHOD section 1), so
    that grasps are decoded where they were told, turned, and told anew.
    """
    up = batch.cloud.new_tensor([0.0, 0.0, 1.0])
    rotation = axis_angle(up.expand(len(angles), 3), angles)
    points, normals = batch.cloud.split(3, dim=-1)
    cloud = torch.cat([points @ rotation.mT, normals @ rotation.mT], dim=-1)
    seeds = batch.plan["seeds"]
    rows = contact_points(batch.targets)
    view = rows // seeds.shape[1]
    at = batch.cloud[view, seeds.flatten()[rows]]
    told = batch.targets[rows]
    grasps = representation.decode(at[:, :3], at[:, 3:], representation.as_prediction(told))
    motion = pose(rotation, torch.zeros_like(points[:, 0]))[view]
    now = cloud[view, seeds.flatten()[rows]]
    anew = representation.encode(now[:, :3], now[:, 3:], grasps.replace(pose=motion @ grasps.pose))
    parameters, encodable = batch.targets.parameters.clone(), batch.targets.encodable.clone()
    parameters[rows], encodable[rows] = anew.parameters.to(parameters), anew.encodable
    return Batch(cloud, batch.plan, batch.targets.replace(parameters=parameters, encodable=encodable))
