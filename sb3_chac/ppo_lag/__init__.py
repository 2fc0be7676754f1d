"""PPO with a Lagrange multiplier on the safety cost (PPO-Lag)."""

from sb3_chac.ppo_lag.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_chac.ppo_lag.ppo_lag import PPOLag

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy", "PPOLag"]
