"""Markdown and HTML reports of an evaluation, with pictures of what was tried."""

import base64
import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from dexgrasp.checkpoint import replace_file
from dexgrasp.evaluation import Episode
from dexgrasp.geometry import look_at
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import ObjectSet
from dexgrasp.picture import picture

PALETTE = ((0.86, 0.45, 0.35), (0.40, 0.62, 0.80), (0.55, 0.74, 0.44), (0.85, 0.70, 0.35), (0.62, 0.52, 0.76))
HAND = (0.35, 0.37, 0.42)


def write_results(folder: Path, kind: str, results: Mapping[str, Any], version: int = 1) -> Path:
    """Write results.json of a command; the schemas are documented in docs/results.md."""
    path = folder / "results.json"
    content = {"schema": f"dexgrasp.{kind}/{version}", **results}
    replace_file(path, (json.dumps(content, indent=1, allow_nan=False, default=str) + "\n").encode())
    return path


def write_report(folder: Path, results: Mapping[str, Any], images: Sequence[tuple[str, Path]] = ()) -> Path:
    """Write report.md and report.html beside results.json; return the HTML's path."""
    lines = [f"# {results['title']}", "", *_table(results), "", *_reasons(results), ""]
    for caption, path in images:
        lines += [f"## {caption}", "", f"![{caption}]({path.name})", ""]
    (folder / "report.md").write_text("\n".join(lines))
    target = folder / "report.html"
    target.write_text(_page(results, images))
    return target


def _percent(entry: Mapping[str, Any], digits: int = 1, scale: float = 100.0) -> str:
    if entry["value"] is None:
        return "none tried"
    value, low, high = (f"{scale * entry[key]:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"


def rows(results: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the lines of the summary table: what, value with its 95 % interval, out of how many."""
    summary = results["summary"]
    table = [
        ("success rate SR, %", _percent(summary["success_rate"]), f"{summary['attempts']} attempts"),
        ("completion rate CR, %", _percent(summary["completion_rate"]), f"{summary['objects']} objects"),
        ("epsilon of executed grasps", _percent(summary["epsilon"], 3, 1.0), f"{summary['epsilon']['trials']} grasps"),
    ]
    for kind, entry in results.get("ceilings", {}).items():
        table.append((f"ceiling: {kind.replace('_', ' ')} label, %", _percent(entry), f"{entry['trials']} attempts"))
    told = results.get("reliability", {"trials": 0})
    for name in ("calibration_error", "brier_skill", "roc_area") if told["trials"] else ():
        value = "-" if told[name] is None else f"{told[name]:.3f}"
        table.append((f"score told: {name.replace('_', ' ')}", value, f"{told['trials']} grasps"))
    for stage, seconds in summary["seconds"].items():
        table.append((f"{stage}, median s", "-" if seconds is None else f"{seconds:.3f}", ""))
    return table


def _table(results: Mapping[str, Any]) -> list[str]:
    head = [f"Protocol **{results['protocol']}**, seed {results['seed']}, {results['summary']['scenes']} scenes."]
    body = [f"| {what} | {value} | {count} |" for what, value, count in rows(results)]
    return [*head, "", "| | value [95 % interval] | of |", "|---|---|---|", *body]


def _reasons(results: Mapping[str, Any]) -> list[str]:
    reasons = sorted(results["summary"]["reasons"].items(), key=lambda item: -item[1])
    return ["| outcome | attempts |", "|---|---|", *[f"| {name} | {count} |" for name, count in reasons]]


def _page(results: Mapping[str, Any], images: Sequence[tuple[str, Path]]) -> str:
    cells = "".join(
        f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td><td>{html.escape(c)}</td></tr>"
        for a, b, c in rows(results)
    )
    reasons = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{count}</td></tr>"
        for name, count in sorted(results["summary"]["reasons"].items(), key=lambda item: -item[1])
    )
    figures = "".join(
        f"<h2>{html.escape(caption)}</h2><img alt='{html.escape(caption)}' "
        f"src='data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}'>"
        for caption, path in images
    )
    style = (
        "body{font:16px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem;color:#222}"
        "table{border-collapse:collapse;margin:1rem 0}td,th{border-bottom:1px solid #ddd;padding:.3rem 1rem;"
        "text-align:left}img{max-width:100%}"
    )
    title = html.escape(str(results["title"]))
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{title}</title><style>{style}</style>"
        f"<h1>{title}</h1><p>Protocol <b>{html.escape(str(results['protocol']))}</b>, seed {results['seed']}, "
        f"{results['summary']['scenes']} scenes.</p><table><tr><th></th><th>value [95 % interval]</th><th>of</th></tr>"
        f"{cells}</table><table><tr><th>outcome</th><th>attempts</th></tr>{reasons}</table>{figures}</html>\n"
    )


def draw_attempts(
    folder: Path, episodes: Sequence[Episode], objects: ObjectSet, hand: Hand, most: int = 8
) -> list[tuple[str, Path]]:
    """Draw the executed grasps as strips of successes and failures; return captions and files."""
    shown: dict[bool, list[tuple[str, UInt8[np.ndarray, "H W 3"]]]] = {True: [], False: []}
    for episode in episodes:
        drawn = [attempt for attempt in episode.attempts if attempt.score is not None]
        for attempt, strip in zip(drawn, episode.strips, strict=False):
            tiles = shown[attempt.success]
            if len(tiles) < most:
                caption = f"scene {attempt.scene}: {attempt.reason.replace('_', ' ')}, score {attempt.score:.2f}"
                tiles.append((caption, draw_grasp(strip, objects, hand)))
    files = []
    for success, name in ((True, "successes"), (False, "failures")):
        if shown[success]:
            files.append((name.capitalize(), _mosaic(folder / f"{name}.png", shown[success])))
    return files


def draw_grasp(
    strip: Mapping[str, Any], objects: ObjectSet, hand: Hand, size: tuple[int, int] = (240, 320)
) -> UInt8[np.ndarray, "H W 3"]:
    """Render a scene with the hand at one grasp, seen from the camera's side, closer and lower."""
    grasp: Grasps = strip["grasp"]
    bodies = [
        (objects[name].mesh, pose.double().numpy(), PALETTE[i % len(PALETTE)])
        for i, (name, pose) in enumerate(zip(strip["names"], strip["poses"], strict=True))
        if pose.isfinite().all()
    ]
    links, base = hand.link_poses(grasp.joints.double()), grasp.pose[0].double()
    bodies += [(mesh, (base @ links[link][0]).numpy(), HAND) for link, mesh in hand.visuals.items()]
    at = base[:3, 3] * 0.5
    away = strip["view"].world_T_camera[:3, 3].double() - at
    away[2] = away[2].clamp(max=0.7 * float(away[:2].norm()))
    return picture(bodies, look_at(at + 0.62 * away / away.norm(), at).numpy(), size)


def _mosaic(path: Path, tiles: Sequence[tuple[str, UInt8[np.ndarray, "H W 3"]]]) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(4, len(tiles))
    lines = -(-len(tiles) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.7 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    for place, (caption, image) in enumerate(tiles):
        axes = figure.add_subplot(lines, columns, place + 1)
        axes.imshow(image)
        axes.set_title(caption, fontsize=8)
        axes.axis("off")
    figure.savefig(path, dpi=110)
    return path
