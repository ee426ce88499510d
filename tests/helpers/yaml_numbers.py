"""Plain data as YAML with the numbers of YAML 1.2, whatever they are."""

import math
from typing import Any

import yaml

_Fastest: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # where PyYAML came with libyaml


class _Dumper(_Fastest):  # type: ignore[misc]
    """Without aliases, which are refused, and with numbers as YAML 1.2 reads them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _number(dumper: _Dumper, value: float) -> yaml.ScalarNode:
    words = {math.inf: ".inf", -math.inf: "-.inf"}
    text = words.get(value, ".nan" if math.isnan(value) else repr(value))
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


_Dumper.add_representer(float, _number)


def dumped(data: Any) -> str:
    """YAML."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False)
