"""python -m dexgrasp export: a network for other runtimes, or as weights of the package."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dexgrasp.checkpoint import WEIGHTS, find_checkpoint
from dexgrasp.errors import DexgraspError
from dexgrasp.model import load_model
from dexgrasp.report import write_results


def main(config: DictConfig) -> None:
    """Write and check the files of every kind and format, or ship weights; print what was found and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    if config.ship is not None:
        print(_ship(config))
        return
    files = list(_export(config, folder))
    write_results(folder, "export", {"title": f"{config.model}", "model": str(config.model), "files": files})
    print(folder)
    far = [each for each in files if each["beyond_share"] > config.share]
    if far:
        raise DexgraspError(
            f"at most {config.share:.2%} of the rows more than {config.tolerance:g} off the network",
            ", ".join(f"{each['file']}: {each['beyond_share']:.2%}" for each in far),
            "do not use these files; see results.json, and tell us",
        )


def _ship(config: DictConfig) -> Path:
    from dexgrasp.shipping import ship

    folder = WEIGHTS if config.to is None else Path(config.to).expanduser()
    results = [Path(each) for each in config.results]
    return ship(find_checkpoint(config.model), config.ship, folder, config.half, results, seed=config.seed)


def _export(config: DictConfig, folder: Path) -> Any:
    from dexgrasp.export import FORMATS, KINDS, trace
    from dexgrasp.export_check import compare, level_views, runner

    for name, known in (("kinds", KINDS), ("formats", FORMATS)):
        if not set(config[name]) <= set(known) or not config[name]:
            raise DexgraspError(f"{name} out of {', '.join(known)}", str(config[name]), f"set {name}")
    model = load_model(config.model)
    views = list(level_views(model, max(1, config.check), config.seed))
    if config.double:
        model, views = model.double(), [view.double() for view in views]
    for kind in config.kinds:
        began = time.perf_counter()
        graph = trace(model, views[0], kind)
        for suffix in config.formats:
            path = folder / f"{kind}.{suffix}"
            graph.write(path)
            text = f"{path.name}: {path.stat().st_size / 1e6:.1f} MB, made in {time.perf_counter() - began:.0f} s"
            row: dict[str, Any] = {"file": path.name, "kind": kind, "bytes": path.stat().st_size, "beyond_share": 0.0}
            if config.check:
                found = compare(model, kind, runner(path, graph.inputs), views, config.tolerance)
                share = found.beyond / max(1, found.rows)
                row |= {"tolerance": config.tolerance, **dataclasses.asdict(found), "beyond_share": share}
                text += (
                    f"; of {found.rows:,} rows of {found.views} views {found.beyond} differ by more than "
                    f"{config.tolerance:g}, the others by at most {max(found.largest.values()):.1e}"
                )
            print(text)
            yield row
            began = time.perf_counter()
