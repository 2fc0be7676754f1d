"""Integration with RL-Zoo3 and gymnasium."""

from sb3_chac.zoo.algorithms import hyperparams_file
from sb3_chac.zoo.registration import register

__all__ = ["hyperparams_file", "register"]
