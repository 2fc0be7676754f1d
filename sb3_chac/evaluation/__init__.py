"""Evaluation of policies on held-out scenarios."""

from sb3_chac.evaluation.episodes import NotEvaluable
from sb3_chac.evaluation.evaluation import Evaluation, compare, evaluate, scenario_list

__all__ = ["Evaluation", "NotEvaluable", "compare", "evaluate", "scenario_list"]
