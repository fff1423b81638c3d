"""python -m dexgrasp fit: teach a planner on a dataset."""

import time
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dexgrasp.commands.eval import plain
from dexgrasp.dataset.pipeline import ensure, summary, table
from dexgrasp.errors import DexgraspError
from dexgrasp.plugins import build_hand, build_planner
from dexgrasp.report import write_results


def main(config: DictConfig) -> None:
    """Make the dataset where it is missing, fit `config.planner` to it; all it learns lies in the run's folder."""
    began = time.perf_counter()
    if config.get("planner") is None:
        raise DexgraspError("the planner to teach", "none", "add planner=NAME; `python -m dexgrasp plugins planner`")
    folder = Path(HydraConfig.get().runtime.output_dir)
    hand = build_hand(config.hand)
    planner = build_planner(config.planner, hand)
    if not planner.learns:
        raise DexgraspError("a planner that learns", f"{config.planner.name}, which does not", "use it as it is: eval")
    dataset = ensure(config.dataset, config.hand, config.repr)
    print(table(summary(dataset)))
    made = time.perf_counter()
    facts = planner.fit(dataset, config.seed, folder)
    fitted = time.perf_counter()
    results = {
        "title": f"{config.hand.name}, {config.planner.name}, seed {config.seed}",
        "planner": plain(config.planner),
        "hand": hand.name,
        "seed": config.seed,
        "facts": facts,
        "times": {"data": made - began, "fit": fitted - made},
    }
    write_results(folder, "fit", results)
    print(f"data {made - began:.0f} s, fit {fitted - made:.0f} s")
    print(f"use it: python -m dexgrasp eval planner={config.planner.name} planner.weights={folder} hand={hand.name}")
    print(folder)
