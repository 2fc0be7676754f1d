from sb3_chac.zoo.registration import hyperparams_file, register

__all__ = ["hyperparams_file", "register"]
