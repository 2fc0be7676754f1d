"""SAC with a Lagrange multiplier on the safety cost (SAC-Lag)."""

from sb3_chac.sac_lag.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_chac.sac_lag.sac_lag import SACLag

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy", "SACLag"]
