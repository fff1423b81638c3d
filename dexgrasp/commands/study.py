"""python -m dexgrasp study: several methods made from the same data and judged by the same rules, in tables."""

import sys
import time
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from dexgrasp.commands.eval import plain
from dexgrasp.errors import DexgraspError
from dexgrasp.leaderboard.page import write_leaderboard
from dexgrasp.leaderboard.row import collect
from dexgrasp.study.study import Study
from dexgrasp.study.table import write_tables
from dexgrasp.study.work import work

CONFIG = "study.yaml"


def main(config: DictConfig) -> None:
    """Run what is not yet done of a study; print its tables and where they lie."""
    began = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir).absolute()
    if config.resume is not None:
        kept = folder / CONFIG
        if not kept.is_file():
            raise DexgraspError(f"the folder of a study with {CONFIG}", f"none in {folder}", "check `resume`")
        config = OmegaConf.load(kept)  # type: ignore[assignment]
    study = Study.read(plain(config))
    OmegaConf.save(config, folder / CONFIG)
    try:
        failed = work(study.jobs(folder))
    except KeyboardInterrupt:
        print(f"what is done is kept; go on with: python -m dexgrasp study resume={folder}", file=sys.stderr)
        raise
    table = write_tables(study, folder, failed)
    print(table.read_text())
    board = [folder / name for name in study.judgements if any((folder / name).glob("*/results.json"))]
    if board:
        print(f"leaderboard: {write_leaderboard(collect(board), folder)[0]}")
    print(f"{time.perf_counter() - began:.0f} s; tables: {table}\n{folder}")
    if failed:
        first = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        remedy = f"see their output.txt, mend it, and go on: python -m dexgrasp study resume={folder}"
        raise DexgraspError("all runs of the study to end", first, remedy)
