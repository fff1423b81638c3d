"""Where meshes come from and under which licence, as a manifest beside them says."""

import json
from pathlib import Path


def origins(root: Path) -> dict[Path, tuple[str, str]]:
    """Return source and licence of mesh files, from a ``manifest.json`` in their folder or the one above it.

    It is {"objects": [{"file": path beside it, "licence": ..., "source_repo": ..., "source_path": ...}]}, where every
    key but `file` may be absent ("" in the result). Files that it does not name are not in the result.
    """
    for folder in (root.resolve(), root.resolve().parent):
        try:
            listed = json.loads((folder / "manifest.json").read_text())["objects"]
            return {(folder / entry["file"]).resolve(): _origin(entry) for entry in listed}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # no manifest, or somebody else's
    return {}


def _origin(entry: dict[str, object]) -> tuple[str, str]:
    source = " ".join(str(entry[key]) for key in ("source_repo", "source_path") if entry.get(key))
    return source, str(entry.get("licence") or entry.get("license") or "")
