"""The viewer: in Python, and in a real headless Chromium where there is one."""

import base64
import json
import math
import shutil
import subprocess
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from dexgrasp.errors import DexgraspError
from dexgrasp.evaluation import Attempt, Episode
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.replay import FILE, read_replay, write_replay
from dexgrasp.scene import View
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.viewer.exhibit import LIFT, Body, Exhibit, planned
from dexgrasp.viewer.marks import CONE, contacts, friction_cone, shades, skeleton

FLAGS = """--headless=new --no-sandbox --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader
--enable-unsafe-swiftshader --ignore-gpu-blocklist --remote-debugging-port=0 --window-size=700,400 --no-first-run"""


def three(hand) -> Grasps:
    """Grasps from above, side by side; contacts of the first two fingers are known."""
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)).repeat(3, 1, 1)
    pose[:, 0, 3], pose[:, 2, 3] = torch.tensor([-0.25, 0.0, 0.25]), 0.15
    joints = hand.clamp(torch.full((3, 4), 0.8, dtype=torch.float64))
    made = Grasps.build(pose, joints, 3, quality=torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64))
    points, normals = made.contacts.clone(), made.normals.clone()
    points[:, :2] = pose[:, None, :3, 3] - torch.tensor([0, 0, 0.1])
    normals[:, 0], normals[:, 1] = torch.tensor([1.0, 0, 0]).double(), torch.tensor([-1.0, 0, 0]).double()
    return made.replace(contacts=points, normals=normals, object=torch.tensor([0, 0, -1]))


@pytest.fixture
def exhibit(hand) -> Exhibit:
    pose = np.eye(4)
    pose[2, 3] = 0.03
    body = Body("cube", trimesh.creation.box((0.06, 0.06, 0.06)), pose)
    cloud = np.random.default_rng(0).uniform(-0.1, 0.1, (300, 3)) * [1, 1, 0]
    colours = {"one": np.full((300, 3), 90, np.uint8)}
    return Exhibit("a cube", hand, (body,), three(hand), ("first", "second", "third"), cloud, colours, floor=np.eye(4))


def test_a_motion_leads_through_the_grasp_and_lifts_its_object(exhibit):
    motion, grasp = planned(exhibit, 0), exhibit.grasps[0]
    assert list(dict.fromkeys(motion.phases)) == ["approach", "close", "lift"]
    arrived, closed = motion.phases.index("close") - 1, motion.phases.index("lift") - 1
    pose, joints = grasp.pose[0].numpy(), grasp.joints[0].numpy()
    assert np.allclose(motion.base[arrived], pose) and np.allclose(motion.joints[closed], joints)
    assert (motion.joints[arrived, 1:] < joints[1:]).all() and np.allclose(
        motion.joints[: arrived + 1], motion.joints[0]
    )
    assert np.isclose(np.linalg.norm(motion.base[0, :3, 3] - pose[:3, 3]), 0.10)
    assert np.allclose(motion.base[-1, :3, 3] - pose[:3, 3], [0, 0, LIFT])
    assert np.allclose(motion.bodies[-1, 0, :3, 3] - motion.bodies[0, 0, :3, 3], [0, 0, LIFT])
    assert np.allclose(planned(exhibit, 2).bodies, motion.bodies[:1]), "whose object is unknown lifts none"


def test_friction_cones_hold_the_forces_that_friction_bears(exhibit):
    points, normals = contacts(exhibit.grasps[1])
    assert len(points) == 2
    cone = friction_cone(points[0], 3.0 * normals[0], 0.5)
    away = cone.vertices - points[0]
    tip = np.linalg.norm(away, axis=1).argmin()
    assert np.allclose(away[tip], 0, atol=1e-9) and cone.is_volume
    rim = away[np.linalg.norm(away, axis=1) > 1.01 * CONE]
    angles = np.arccos(rim @ normals[0] / np.linalg.norm(rim, axis=1))
    assert len(rim) >= 12 and np.allclose(angles, math.atan(0.5), atol=1e-6)


def test_colours_rank():
    assert shades(np.array([0.0, 1.0]))[1, 1] > shades(np.array([0.0, 1.0]))[0, 1]
    assert (shades(np.array([0.5, 0.5]))[0] == shades(np.array([0.0, 1.0]))[1]).all() and shades(np.zeros(0)).size == 0


def test_replays_are_kept_and_read(tmp_path, hand, tiny):
    dataset, grasps = tiny[1], three(hand)
    view = View(torch.rand(50, 3), torch.rand(50, 3), torch.arange(50) % 3 - 1, torch.eye(4))
    poses = torch.full((2, 4, 4), math.nan, dtype=torch.float64)
    poses[0] = torch.eye(4)
    strip = {"names": (), "poses": poses, "grasp": grasps[1], "offered": grasps, "view": view, "seed": 0}
    told = dict(scene=3, target=None, lifted=None, epsilon=None, seconds={})
    tried = Attempt(number=0, success=True, reason="success", score=0.5, **told)
    none = Attempt(number=1, success=False, reason="no_grasp", score=None, **told)
    write_replay(tmp_path, [Episode(3, (), (), (tried, none), (strip,))], dataset)
    (kept,) = read_replay(tmp_path)
    assert (kept.scene, kept.number) == (3, 0) and torch.equal(kept.grasp.pose, grasps[1].pose)
    assert torch.equal(kept.poses[0], poses[0]) and kept.poses[1].isnan().all() and len(kept.offered) == 3
    assert torch.allclose(kept.points, view.points, atol=3e-4) and torch.equal(kept.instance, view.instance)
    assert type(dataset).open(tmp_path).objects.names == dataset.objects.names
    (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:100])
    with pytest.raises(DexgraspError, match="readable"):
        read_replay(tmp_path)


def test_scenes_of_a_dataset_are_shown_and_carried_out(tiny):
    from dexgrasp.viewer.sources import scene

    dataset = tiny[1]
    number = next(i for i in range(dataset.scenes) if len(dataset.scene_grasps(i)))
    shown = scene(dataset, number, most=4)
    grasps = shown.grasps
    assert 0 < len(grasps) <= 4 and len(shown.notes) == len(grasps) and len(shown.bodies) == len(dataset.scene(number))
    assert (grasps.quality.diff() <= 0).all() and f"{float(grasps.quality[0]):.3f}" in shown.notes[0]
    assert {"objects", "graspable points"} == set(shown.colours) and shown.points.shape == (len(shown.points), 3)
    assert np.isfinite(shown.points).all() and shown.points[:, 2].min() > -0.1, "world frame"
    there = dataset.scene(number)
    items = [dataset.objects[name] for name in there.objects]
    protocol = load_protocol("lift-v1")
    outcome = MujocoSimulator().execute(
        items, there.poses.double(), dataset.hand, grasps[0], protocol, fixtures=there.fixtures
    )
    motion = shown.simulate(0)
    assert motion.verdict == f"lift-v1: {Reason(int(outcome.reason[0])).name.lower().replace('_', ' ')}"
    final = outcome.final[0].numpy()
    assert np.allclose(motion.bodies[-1], final, atol=1e-6), "the recording ends where the evaluation's attempt ends"
    with pytest.raises(DexgraspError, match="a scene from 0"):
        scene(dataset, 99)


def test_what_is_not_there_is_told(tmp_path):
    from dexgrasp.viewer.page import address
    from dexgrasp.viewer.sources import open_source

    with pytest.raises(DexgraspError, match="something to look at"):
        open_source(tmp_path / "nowhere")
    (tmp_path / "results.json").write_text(json.dumps({"schema": "dexgrasp.evaluation/1"}))
    with pytest.raises(DexgraspError, match="evaluate again"):
        open_source(tmp_path)
    assert "ssh -L 8081:localhost:8081" in address("127.0.0.1", 8081)


class Chromium:
    """A headless browser, led by the DevTools protocol."""

    def __init__(self, folder: Path) -> None:
        from websockets.sync.client import connect

        command = [shutil.which("chromium") or "", *FLAGS.split(), f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        told = folder / "DevToolsActivePort"
        wait(lambda: told.exists() and len(told.read_text().split()) == 2)
        port, path = told.read_text().split()
        self.socket, self.count, self.session = connect(f"ws://127.0.0.1:{port}{path}", max_size=None), 0, None
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def ask(self, method: str, **parameters):
        """Send a command and return its answer."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        self.socket.send(json.dumps(message | ({"sessionId": self.session} if self.session else {})))
        while (answer := json.loads(self.socket.recv(120))).get("id") != self.count:
            pass
        return answer["result"]

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at a pixel."""
        for kind, button in (("mouseMoved", "none"), ("mousePressed", "left"), ("mouseReleased", "left")):
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=int(button == "left"))

    def picture(self) -> np.ndarray:
        """Return what is seen, RGB (H, W, 3)."""
        data = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(BytesIO(data)).convert("RGB"), dtype=np.int64)


def wait(true, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.05)


def test_a_click_on_a_grasp_changes_the_scene(exhibit, tmp_path):
    pytest.importorskip("viser", reason="needs the extra `view`")
    pytest.importorskip("websockets.sync.client")
    if shutil.which("chromium") is None:
        pytest.skip("needs Chromium on the PATH")
    from viser.transforms import SO3

    from dexgrasp.viewer import GraspView, open_page

    server = open_page("test", 0)
    view = GraspView(server, exhibit)
    browser = Chromium(tmp_path)
    try:
        browser.ask("Page.navigate", url=f"http://127.0.0.1:{server.get_port()}")
        wait(lambda: any(client.camera.image_width for client in server.get_clients().values()))
        wait(lambda: len(np.unique(browser.picture()[:, :300].reshape(-1, 3), axis=0)) > 200)
        camera = next(iter(server.get_clients().values())).camera
        mesh = skeleton(exhibit.hand, exhibit.grasps[1])
        seen = (mesh.vertices - camera.position) @ SO3(camera.wxyz).as_matrix()
        focal = camera.image_height / 2 / math.tan(camera.fov / 2)
        places = focal * seen[:, :2] / seen[:, 2:] + np.array([camera.image_width, camera.image_height]) / 2
        before = browser.picture()
        browser.click(*map(float, places[0]))
        wait(lambda: view.slider.value != 1)
        assert view.chosen == 1 and view.slider.value == 2 and "second" in view.text.content
        assert np.allclose(view.hand.base.position, exhibit.grasps.pose[1, :3, 3])
        wait(lambda: (np.abs(browser.picture() - before).max(axis=2) > 40).mean() > 0.02)
    finally:
        browser.socket.close()
        browser.process.terminate()
        browser.process.wait()
        server.stop()


def test_another_exhibit_takes_the_place_of_the_first(exhibit):
    pytest.importorskip("viser", reason="needs the extra `view`")
    from dataclasses import replace

    from dexgrasp.viewer import Gallery, open_page

    server = open_page("test", 0)
    try:
        shown = [exhibit, replace(exhibit, grasps=exhibit.grasps[:0], notes=(), points=None, colours={})]
        gallery = Gallery(server, ("three", "none"), lambda index: shown[index])
        first = gallery.view
        first.show(planned(exhibit, 0), 0)
        assert first.phase.value == "approach" and not any(mark.visible for mark in first.marks)
        gallery.show(1)
        assert first.closed and len(gallery.view.markers) == 0 and not gallery.view.hand.base.visible
        gallery.show(0)
        assert gallery.view.hand.base.visible and len(gallery.view.marks) == 4, "two contacts and their cones"
    finally:
        server.stop()
