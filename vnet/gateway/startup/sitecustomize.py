"""Start of Python in the commands of Zenoh vehicles: `zenoh.open` heeds `ZENOH_CONFIG_OVERRIDE`, as rmw_zenoh does.

Python finds it by `PYTHONPATH`, also where vnet is not installed. So programs with `zenoh.Config()`, or an endpoint
of their own, are clients of their vehicle's router, and no peers of other vehicles past the radio.
"""

import os
import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class ZenohFinder:
    """Finds `zenoh` as Python does, and has its `open` changed once it is loaded."""

    def find_spec(self, name: str, _path: object = None, _target: object = None) -> ModuleSpec | None:
        """Return how to load `zenoh`; None for any other module."""
        if name != "zenoh":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def load(module: ModuleType) -> None:
                execute(module)
                open_with_override(module)

            spec.loader.exec_module = load  # type: ignore[method-assign]
        return spec


def open_with_override(zenoh: Any) -> None:
    """Have `zenoh.open` change a copy of each configuration as the environment says."""
    opened = zenoh.open

    def open(config: Any) -> Any:
        config = zenoh.Config.from_json5(str(config))
        for setting in filter(None, os.environ.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
            config.insert_json5(*setting.split("=", 1))
        return opened(config)

    zenoh.open = open


sys.meta_path.insert(0, ZenohFinder())
# The one that this one hides runs as well.
sys.path.remove(__file__.rpartition("/")[0])
own = sys.modules.pop("sitecustomize")
try:
    import_module("sitecustomize")
except ImportError:
    sys.modules["sitecustomize"] = own
