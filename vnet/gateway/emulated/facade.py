"""Modules that a program sees in the place of those of the process."""

from __future__ import annotations

from types import ModuleType
from typing import Any


class Facade(ModuleType):
    """Stands for a module of which some names are others."""

    def __init__(self, real: ModuleType, **own: Any) -> None:
        super().__init__(real.__name__, real.__doc__)
        names = {
            name: value for name, value in vars(real).items() if not name.startswith("__") or name == "__all__"
        }
        vars(self).update(names, **own)
        self.__real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__real, name)
