"""python -m dexgrasp dataset estimate: time and disk of a dataset, from a small sample of every stage."""

import json
import math
import time
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dexgrasp.dataset.estimation import Predicted, estimate

SCHEMA = 2
"""Of results.json: {schema, command, took, seconds, bytes, idle, error, stages: [{stage, items, seconds, bytes, basis,
idle, error}]}; `error` is one standard error of `seconds`."""
BUSY = 0.85
"""Where the sample had a smaller share than this of its cores, the estimate for idle ones is told too."""


def main(config: DictConfig) -> None:
    """Print the estimate, stage by stage; nothing of the dataset is made."""
    began = time.perf_counter()
    rows = estimate(config.dataset, config.hand, config.repr if config.labels else None, config.seconds)
    took = time.perf_counter() - began
    print(table(rows))
    print(f"measured in {took:.0f} s")
    run = Path(HydraConfig.get().runtime.output_dir)
    total = {name: sum(getattr(row, name) for row in rows) for name in ("seconds", "bytes", "idle")}
    total |= {"took": took, "error": math.hypot(*(row.error for row in rows))}
    content = {"schema": SCHEMA, "command": "estimate", **total, "stages": [vars(row) for row in rows]}
    (run / "results.json").write_text(json.dumps(content, indent=1))
    print(run)


def table(rows: list[Predicted]) -> str:
    """Return the estimate as text."""
    lines = [f"{'stage':10}{'items':>8}{'time':>11}{'+-':>6}{'disk':>12}  measured on"]
    lines += [
        f"{row.stage:10}{row.items:8d}{row.seconds:9.0f} s{2 * row.error:6.0f}{row.bytes / 1e6:9.1f} MB  {row.basis}"
        for row in rows
    ]
    seconds, size = sum(row.seconds for row in rows), sum(row.bytes for row in rows)
    error = 2 * math.hypot(*(row.error for row in rows))
    told = f"{seconds / 60:.1f} min, {size / 1e9:.2f} GB"
    lines.append(f"{'in all':18}{seconds:9.0f} s{error:6.0f}{size / 1e6:9.1f} MB  {told}")
    if seconds:
        share = f"{100 * error / seconds:.0f} %"
        lines.append(f"+- two standard errors: expect the time within {share} as long as the machine is as busy as now")
    idle = sum(row.idle for row in rows)
    if idle < BUSY * seconds:
        lines.append(f"the cores were busy with other work; had they been idle: {idle:.0f} s ({idle / 60:.1f} min)")
    return "\n".join(lines)
