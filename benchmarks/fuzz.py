"""Every reader against inputs that nobody means well: `python -m benchmarks.fuzz [--inputs 100000] [--only NAME ...]`.

Coverage-guided by atheris (libFuzzer) from one good input of each kind, every reader in a process of its own. A finding
is whatever is neither data nor a `DexgraspError`: another exception, a crash, more than 10 s or 2 GiB. Needs
`pip install atheris`. Exit status 1 and the input's path where there is a finding.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FOUND = "fuzz-findings"
WATCHED = [
    "dexgrasp.sensing",
    "dexgrasp.cloud_file",
    "dexgrasp.interchange",
    "dexgrasp.dataset",
    "dexgrasp.checkpoint",
    "pickle",
    "yaml",
    "PIL",
]


def main(argv: list[str] | None = None) -> int:
    """Run all readers, or some; print a table and write JSON."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--one"]:  # before anything is imported that is to be watched
        return fuzz(argv[1], int(argv[2]), int(argv[3]))
    from dexgrasp.testing.readers import READERS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="in all")
    parser.add_argument("--only", nargs="*", choices=list(READERS), default=list(READERS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, default=Path("fuzz.json"))
    options = parser.parse_args(argv)
    each = -(-options.inputs // len(options.only))
    rows = []
    for name in options.only:
        began = time.perf_counter()
        words = [sys.executable, "-m", "benchmarks.fuzz", "--one", name, str(each), str(options.seed)]
        done = subprocess.run(words, capture_output=True, text=True)
        told = done.stdout + done.stderr
        stats = dict(re.findall(r"stat::(\w+):\s+(\d+)", told))
        covered = re.findall(r"cov: (\d+)", told)
        row = {
            "reader": name,
            "inputs": int(stats.get("number_of_executed_units", 0)),
            "covered": [int(covered[0]), int(covered[-1])] if covered else None,
            "peak_mb": int(stats.get("peak_rss_mb", 0)),
            "slowest_s": int(stats.get("slowest_unit_time_sec", 0)),
            "seconds": round(time.perf_counter() - began, 1),
            "finding": None if done.returncode == 0 else told[-4000:],
        }
        rows.append(row)
        print(
            *(f"{key} {row[key]}" for key in row if key != "finding"), "FINDING" if row["finding"] else "ok", flush=True
        )
        if row["finding"]:
            print(row["finding"])
    options.json.write_text(json.dumps({"rows": rows, "seed": options.seed}, indent=1))
    print(f"{sum(row['inputs'] for row in rows)} inputs, {sum(row['finding'] is not None for row in rows)} findings")
    return int(any(row["finding"] for row in rows))


def fuzz(name: str, runs: int, seed: int) -> int:
    """Fuzz one reader in this process; libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=WATCHED):
        import dexgrasp.cloud_file
        import dexgrasp.interchange.formats
        import dexgrasp.sensing.mask  # noqa: F401
        from dexgrasp.testing.readers import READERS, attempt

    reader, good = READERS[name]
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    (folder / "corpus").mkdir()
    for number, content in enumerate(good()):
        (folder / "corpus" / str(number)).write_bytes(content)
    Path(FOUND).mkdir(exist_ok=True)
    flags = [f"-runs={runs}", f"-seed={seed}", "-timeout=10", "-rss_limit_mb=4096", "-max_len=20000", "-len_control=0"]
    flags += [f"-artifact_prefix={FOUND}/{name}-", "-print_final_stats=1", str(folder / "corpus")]
    place = folder / "input"
    place.mkdir()
    atheris.Setup([sys.argv[0], *flags], lambda content: attempt(reader, content, place))
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
