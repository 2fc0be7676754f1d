"""Human-gated DAgger (HG-DAgger)."""

from sb3_chac.bc.policies import CnnPolicy, MlpPolicy
from sb3_chac.hg_dagger.hg_dagger import HGDagger

__all__ = ["CnnPolicy", "HGDagger", "MlpPolicy"]
