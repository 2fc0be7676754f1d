"""Conservative Q-learning (CQL)."""

from sb3_chac.cql.cql import CQL
from sb3_chac.cql.policies import CnnPolicy, MlpPolicy

__all__ = ["CQL", "CnnPolicy", "MlpPolicy"]
