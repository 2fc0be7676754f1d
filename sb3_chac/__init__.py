"""
Stable-Baselines3 algorithms for confidence-guided human-AI collaboration.

The names below are imported on first use, so that ``import sb3_chac`` itself costs next to nothing.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_chac.bc import BC
    from sb3_chac.chac import CHAC
    from sb3_chac.cql import CQL
    from sb3_chac.dpvp import DPVP
    from sb3_chac.dsac import DSAC
    from sb3_chac.gail import GAIL
    from sb3_chac.hg_dagger import HGDagger
    from sb3_chac.human import InterventionWrapper
    from sb3_chac.iwr import IWR
    from sb3_chac.ppo_lag import PPOLag
    from sb3_chac.pvp import PVP
    from sb3_chac.sac_lag import SACLag

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

# Public name -> module that defines it
_EXPORTS = {
    "BC": "sb3_chac.bc",
    "CHAC": "sb3_chac.chac",
    "CQL": "sb3_chac.cql",
    "DPVP": "sb3_chac.dpvp",
    "DSAC": "sb3_chac.dsac",
    "GAIL": "sb3_chac.gail",
    "HGDagger": "sb3_chac.hg_dagger",
    "IWR": "sb3_chac.iwr",
    "InterventionWrapper": "sb3_chac.human",
    "PPOLag": "sb3_chac.ppo_lag",
    "PVP": "sb3_chac.pvp",
    "SACLag": "sb3_chac.sac_lag",
}

__all__ = [
    "BC",
    "CHAC",
    "CQL",
    "DPVP",
    "DSAC",
    "GAIL",
    "IWR",
    "PVP",
    "HGDagger",
    "InterventionWrapper",
    "PPOLag",
    "SACLag",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'sb3_chac' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
