"""Chance of a program on virtual time: what draws without a seed of its own draws from that of the run."""

from __future__ import annotations

import random
from types import ModuleType
from typing import Any

from vnet.gateway.emulated.facade import Facade

_WORDS = 4
"""Numbers of 32 bits that seed a generator."""


def prepare_random(module: Any, chance: random.Random) -> None:
    """Have generators without a seed draw one of the vehicle's, where Python asks the system in C."""
    given = module.Random.seed

    def seed(generator: Any, a: Any = None, version: int = 2) -> None:
        given(generator, int.from_bytes(chance.randbytes(16)) if a is None else a, version)

    module.Random.seed = seed
    module.seed = module._inst.seed
    module.seed()


def prepare_uuid(module: Any, chance: random.Random) -> None:
    """Have ids drawn, where Python asks for the machine's address and the system."""
    module._node = chance.getrandbits(48) | 1 << 40
    module._generate_time_safe = module._UuidCreate = None


def numpy_random(chance: random.Random) -> ModuleType:
    """Return a `numpy.random` whose generators without a seed have one of the vehicle's."""
    import numpy.random as real

    def seed_of(given: Any) -> Any:
        return [chance.getrandbits(32) for _ in range(_WORDS)] if given is None else given

    def seeded(kind: Any) -> Any:
        class Seeded(kind):  # type: ignore[misc]
            def __init__(self, seed: Any = None) -> None:
                super().__init__(seed_of(seed))

        Seeded.__name__ = Seeded.__qualname__ = kind.__name__
        return Seeded

    names = ("MT19937", "PCG64", "PCG64DXSM", "Philox", "RandomState", "SFC64")
    own: dict[str, Any] = {name: seeded(getattr(real, name)) for name in names}

    class SeedSequence(real.SeedSequence):
        def __init__(self, entropy: Any = None, **options: Any) -> None:
            super().__init__(seed_of(entropy), **options)

    state = own["RandomState"]()
    shared = real.mtrand._rand
    methods = {name for name, value in vars(real).items() if getattr(value, "__self__", None) is shared}
    own |= {name: getattr(state, name) for name in methods}
    own |= {"seed": state.seed, "ranf": state.random_sample, "sample": state.random_sample}
    return Facade(
        real, SeedSequence=SeedSequence, default_rng=lambda seed=None: real.default_rng(seed_of(seed)), **own
    )
