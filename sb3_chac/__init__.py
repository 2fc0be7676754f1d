"""
Stable-Baselines3 algorithms for confidence-guided human-AI collaboration.

The names below are imported on first use, so that ``import sb3_chac`` itself costs next to nothing.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_chac.bc import BC as BC
    from sb3_chac.chac import CHAC as CHAC
    from sb3_chac.cql import CQL as CQL
    from sb3_chac.dpvp import DPVP as DPVP
    from sb3_chac.dsac import DSAC as DSAC
    from sb3_chac.gail import GAIL as GAIL
    from sb3_chac.hg_dagger import HGDagger as HGDagger
    from sb3_chac.human import InterventionWrapper as InterventionWrapper
    from sb3_chac.iwr import IWR as IWR
    from sb3_chac.ppo_lag import PPOLag as PPOLag
    from sb3_chac.pvp import PVP as PVP
    from sb3_chac.sac_lag import SACLag as SACLag

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

# Package of an algorithm, which is also its name on the command line -> its class
ALGORITHMS = {
    "dsac": "DSAC",
    "pvp": "PVP",
    "dpvp": "DPVP",
    "chac": "CHAC",
    "sac_lag": "SACLag",
    "ppo_lag": "PPOLag",
    "bc": "BC",
    "cql": "CQL",
    "gail": "GAIL",
    "hg_dagger": "HGDagger",
    "iwr": "IWR",
}
# Public name -> module that defines it
_EXPORTS = {
    "InterventionWrapper": "sb3_chac.human",
    **{algorithm: f"{__name__}.{package}" for package, algorithm in ALGORITHMS.items()},
}

__all__ = [*_EXPORTS, "ALGORITHMS", "__version__"]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'sb3_chac' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
