"""Cooperative map matching (CMM): the estimation mathematics, without input or output.

Symbols follow the paper, M. Shen, J. Sun, D. Zhao, "Semi-Interpenetrating Cooperative Localization in Connected
Vehicle Networks": c is the GNSS error that all vehicles share, x_i vehicle i's estimate of it, x̄ their mean.

The names of `__all__` are public, and need no emulator: the filter of one vehicle, consensus, and fusion weights.
They are imported when they are first used, because an agent should start with what it needs, and no more.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.cooperative.cmm.consensus import AveragingConsensus as AveragingConsensus
    from agents.cooperative.cmm.consensus import Consensus as Consensus
    from agents.cooperative.cmm.consensus import ConsensusConfig as ConsensusConfig
    from agents.cooperative.cmm.consensus import DirectMean as DirectMean
    from agents.cooperative.cmm.consensus import RatioConsensus as RatioConsensus
    from agents.cooperative.cmm.consensus import Share as Share
    from agents.cooperative.cmm.fusion import OptimizedWeights as OptimizedWeights
    from agents.cooperative.cmm.fusion import constant_weights as constant_weights
    from agents.cooperative.cmm.fusion import max_degree_weights as max_degree_weights
    from agents.cooperative.cmm.fusion import metropolis_weights as metropolis_weights
    from agents.cooperative.cmm.fusion import no_fusion_weights as no_fusion_weights
    from agents.cooperative.cmm.fusion import random_weights as random_weights
    from agents.cooperative.cmm.rbpf import Observation as Observation
    from agents.cooperative.cmm.rbpf import Rbpf as Rbpf
    from agents.cooperative.cmm.rbpf import RbpfConfig as RbpfConfig

_MODULES = {
    "agents.cooperative.cmm.consensus": (
        "AveragingConsensus",
        "Consensus",
        "ConsensusConfig",
        "DirectMean",
        "RatioConsensus",
        "Share",
    ),
    "agents.cooperative.cmm.rbpf": ("Observation", "Rbpf", "RbpfConfig"),
    "agents.cooperative.cmm.fusion": (
        "OptimizedWeights",
        "constant_weights",
        "max_degree_weights",
        "metropolis_weights",
        "no_fusion_weights",
        "random_weights",
    ),
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Return a public name."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'agents.cooperative.cmm' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
