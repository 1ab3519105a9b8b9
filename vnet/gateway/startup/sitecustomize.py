"""Start of Python in the commands of Zenoh vehicles: `zenoh.open` heeds `ZENOH_CONFIG_OVERRIDE`, as rmw_zenoh does.

Python finds it by `PYTHONPATH`, also where vnet is not installed. So programs with `zenoh.Config()`, or an endpoint
of their own, are clients of their vehicle's router, and no peers of other vehicles past the radio. `_vnet_failure`,
beside it, tells vnet of a main thread that has failed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class ZenohFinder:
    """Finds `zenoh` as Python does, and has its `open` changed once it is loaded."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load `zenoh`; None for any other module."""
        if name != "zenoh":
            return None
        found = (each.find_spec(name, path, target) for each in sys.meta_path if each is not self)
        spec = next(filter(None, found), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def load(module: ModuleType) -> None:
                execute(module)
                check_version(module)
                open_with_override(module)
                if reports:
                    failure.watch(reports.pop())

            spec.loader.exec_module = load  # type: ignore[method-assign]
        return spec


def check_version(zenoh: Any) -> None:
    """Raise ImportError for a Zenoh of another protocol, which would only find that nobody answers."""
    if not hasattr(zenoh, "ZBytes"):  # as importlib.metadata would say, with modules that programs may have, too
        raise ImportError(f"{zenoh.__file__} cannot connect to vnet's endpoints, which are of Zenoh 1")


def open_with_override(zenoh: Any) -> None:
    """Have `zenoh.open` change each configuration as the environment says: a copy would lose keys of TLS."""
    opened = zenoh.open

    def open(config: Any, **options: Any) -> Any:
        if "VNET_OUTSIDE" in os.environ:
            raise zenoh.ZError("a child process on virtual time is outside of the emulation, and opens no session")
        changes = os.environ.get("ZENOH_CONFIG_OVERRIDE", "") if isinstance(config, zenoh.Config) else ""
        for setting in filter(None, changes.split(";")):
            config.insert_json5(*setting.split("=", 1))
        return opened(config, **options)

    zenoh.open = open


sys.meta_path.insert(0, ZenohFinder())
failure = import_module("_vnet_failure")
reports = list(filter(None, [os.environ.pop("VNET_FAILURE", None)]))
"""The file for a failure of this process, and of none that it starts."""
if reports:
    failure.note_exits()
# The one that this one hides runs as well.
sys.path.remove(__file__.rpartition("/")[0])
own = sys.modules.pop("sitecustomize")
try:
    import_module("sitecustomize")
except ImportError as error:
    if error.name != "sitecustomize":
        raise
    sys.modules["sitecustomize"] = own
