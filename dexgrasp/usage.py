"""What a pipeline's `--help` says: what its YAML says of it, the choices that it has, and every setting."""

from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf


def text(_root_: DictConfig) -> str:
    """Resolve `${usage:}`: the help of the command whose config this is."""
    hydra = _root_.hydra
    about, own = documented(_source(str(hydra.job.config_name)))
    settings, told = OmegaConf.to_container(_root_), OmegaConf.to_container(OmegaConf.create(own))
    assert isinstance(settings, dict) and isinstance(told, dict)
    rest = {key: value for key, value in settings.items() if key != "hydra" and key not in told}
    usage = f"python -m dexgrasp {hydra.job.name} [key=value ...]"
    parts, choices = [about or usage], _choices(hydra.runtime.choices)
    if choices:
        parts += ["\nChoices (group=choice):\n", *choices]
    if own.strip():
        parts += ["\nSettings of its own (key=value) and their defaults:\n", own.strip()]
    if rest:
        parts += ["\nSettings of the choices (key=value) and their defaults:\n", OmegaConf.to_yaml(rest).rstrip()]
    return "\n".join(parts).replace("$", "$$")  # Hydra takes it for a template of its own


def documented(yaml: str) -> tuple[str, str]:
    """Return what a command's YAML says of it in its first comment, and its own keys with their comments."""
    lines = yaml.splitlines()
    head = next((number for number, line in enumerate(lines) if not line.startswith("#")), len(lines))
    about = "\n".join(line.lstrip("# ") for line in lines[:head])
    own, inside = [], False
    for line in lines[head:]:
        if line and not line.startswith((" ", "#")):
            inside = line.split(":")[0] not in ("defaults", "hydra")
        if inside:
            own.append(line)
    return about, "\n".join(own)


def _source(name: str) -> str:
    """Return the text of the command's YAML, wherever on the search path it lies."""
    sources = GlobalHydra.instance().config_loader().get_sources()
    files = [Path(source.path) / f"{name}.yaml" for source in sources if source.scheme() == "file"]
    return next((file.read_text() for file in files if file.is_file()), "")


def _choices(chosen: Any) -> list[str]:
    """Return a line for each group that the command looks at, such as ``objects@dataset.objects``."""
    loader = GlobalHydra.instance().config_loader()
    groups = sorted(key for key in chosen if not key.startswith("hydra/"))
    lines = []
    for group in groups:
        options = loader.get_group_options(group.split("@")[0])
        package = group.split("@")[-1]
        name = group if "@" in group and package != "_global_" else group.split("@")[0]
        lines.append(f"{name}: {', '.join(options)}")
    return lines
