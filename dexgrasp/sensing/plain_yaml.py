"""YAML that is data and no more: no tags, and no aliases, with which a small file stands for a huge one."""

import re
from typing import Any

import yaml


class PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases, which also reads 1e-05 as a number, as YAML 1.2 does."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("an alias (*name): write the value itself")
        return super().compose_node(parent, index)


PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?$|[-+]?\.(?:inf|Inf)$|\.(?:nan|NaN)$"),
    list("-+0123456789."),
)


def read_yaml(text: str) -> Any:
    """Return the data of a YAML text; raises yaml.YAMLError, ValueError or RecursionError for what is none."""
    return yaml.load(text, PlainLoader)
