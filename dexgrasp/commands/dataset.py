"""`dataset`: make the data of a config. `dataset inspect|verify|merge|export|card`: what one can do with it."""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from omegaconf import DictConfig

from dexgrasp.errors import DexgraspError

SCHEMA = 1
"""Of results.json: {schema, command, stages: [{stage, items, bytes, seconds, folder}]}."""


def main(config: DictConfig) -> None:
    """Make what is missing, print the summary and where it lies."""
    from hydra.core.hydra_config import HydraConfig

    from dexgrasp.dataset import pipeline
    from dexgrasp.dataset.making import Share

    try:
        share = Share(config.part, config.parts)
        dataset = pipeline.ensure(config.dataset, config.hand, config.repr if config.labels else None, share)
    except KeyboardInterrupt:
        print("what is done is kept; go on with the same command", file=sys.stderr)
        raise
    rows = pipeline.summary(dataset)
    print(pipeline.table(rows))
    run = Path(HydraConfig.get().runtime.output_dir)
    stages = [{**vars(row), "folder": str(row.folder)} for row in rows]
    dataset.save(run / "dataset.json")
    (run / "results.json").write_text(json.dumps({"schema": SCHEMA, "command": "dataset", "stages": stages}, indent=1))
    print(f"card: {dataset.card}")
    print(run)


def tool(arguments: Sequence[str]) -> int:
    """Run one of the tools; raises DexgraspError for paths that hold no dataset and for damaged ones."""
    options = _parser().parse_args(arguments)
    return int(options.run(options) or 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m dexgrasp dataset", description=__doc__)
    tools = parser.add_subparsers(required=True, metavar="inspect|verify|merge|export|card")
    where = "a dataset: its dataset.json, its run's folder, its root or the folder of one stage"

    one = tools.add_parser("inspect", help="counts, distributions and pictures, of any stage")
    one.add_argument("paths", nargs="+", type=Path, metavar="PATH", help=f"{where}, also one that is being made")
    one.add_argument("--picture", type=Path, metavar="FILE", help="draw distributions, a scene and its view (PNG, PDF)")
    one.add_argument("--scene", type=int, default=0, help="which scene is drawn (default 0)")
    one.set_defaults(run=_inspect)

    one = tools.add_parser("verify", help="checksums and schema of everything; grasps and scenes tested again")
    one.add_argument("paths", nargs="+", type=Path, metavar="PATH", help=where)
    one.add_argument("--grasps", type=int, default=500, help="grasps evaluated and closed again (default 500)")
    one.add_argument("--scenes", type=int, default=10, help="scenes whose grasps are tested again (default 10)")
    one.add_argument("--seed", type=int, default=0, help="of the draw of those")
    one.set_defaults(run=_verify)

    one = tools.add_parser("merge", help="join datasets of one hand and the same settings into one that trains")
    one.add_argument("paths", nargs="+", type=Path, metavar="PATH", help=f"{where}; two or more")
    one.add_argument("--to", type=Path, required=True, metavar="DIR", help="a new folder")
    one.set_defaults(run=_merge)

    one = tools.add_parser("export", help="write views as WebDataset, or grasps as Parquet")
    one.add_argument("paths", nargs=1, type=Path, metavar="PATH", help=where)
    one.add_argument("--format", required=True, choices=("webdataset", "parquet"))
    one.add_argument("--to", type=Path, required=True, metavar="DIR", help="a new folder")
    one.set_defaults(run=_export)

    one = tools.add_parser("card", help="write the data card: counts, settings, cost, licence of every object")
    one.add_argument("paths", nargs=1, type=Path, metavar="PATH", help=where)
    one.add_argument("--to", type=Path, metavar="FILE", help="Markdown; default: beside the dataset's description")
    one.set_defaults(run=_card)
    return parser


def _inspect(options: argparse.Namespace) -> None:
    from dexgrasp.dataset.dataset import Dataset
    from dexgrasp.dataset.inspection import description, figure
    from dexgrasp.dataset.store import Store

    for folder in _stores(options.paths):
        print("\n".join(description(Store.open(folder, complete=False))))
    if options.picture is not None:
        print(figure(Dataset.open(options.paths[0]), options.picture, options.scene))


def _verify(options: argparse.Namespace) -> int:
    from dexgrasp.dataset.dataset import Dataset
    from dexgrasp.dataset.store import Store
    from dexgrasp.dataset.verification import checked, rechecked

    for folder in _stores(options.paths):
        print(f"{folder}: {checked(Store.open(folder))}")
    good = True
    for path in options.paths:
        try:
            dataset = Dataset.open(path)
        except DexgraspError as error:
            print(f"{path}: no grasp is tested again: {error.expected}: {error.found}")
            continue
        for check in rechecked(dataset, options.grasps, options.scenes, options.seed):
            good = good and check.good
            print(check)
    return 0 if good else 1


def _merge(options: argparse.Namespace) -> None:
    from dexgrasp.dataset.dataset import Dataset
    from dexgrasp.dataset.merging import merge

    print(merge([Dataset.open(path) for path in options.paths], options.to))


def _export(options: argparse.Namespace) -> None:
    from dexgrasp.dataset.dataset import Dataset

    dataset = Dataset.open(options.paths[0])
    if options.format == "webdataset":
        from dexgrasp.dataset.webdataset_export import export_webdataset as export
    else:
        from dexgrasp.dataset.parquet_export import export_parquet as export
    for path in export(dataset, options.to):
        print(path)


def _card(options: argparse.Namespace) -> None:
    from dexgrasp.dataset.card import write_card
    from dexgrasp.dataset.dataset import Dataset

    dataset = Dataset.open(options.paths[0])
    print(write_card(dataset, options.to or dataset.card))


def _stores(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield the folders of all stores that the paths lead to."""
    from dexgrasp.dataset.dataset import Dataset
    from dexgrasp.dataset.store import MANIFEST

    for path in paths:
        folder = path.parent if path.name == MANIFEST else path
        if (folder / MANIFEST).exists():
            yield folder
            continue
        found = sorted(p.parent for p in folder.glob(f"*/{MANIFEST}"))
        if not found:
            try:
                found = list(Dataset.open(path).folders.values())
            except DexgraspError as cause:
                remedy = "give the folder that `dataset` printed"
                raise DexgraspError(f"a store ({MANIFEST}) or a dataset in {path}", "none", remedy) from cause
        yield from found
