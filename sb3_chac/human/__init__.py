"""Takeovers: experts, rules and the wrapper in which they drive."""

from sb3_chac.human.experts import Expert, FunctionExpert, ModelExpert, check_expert, make_expert
from sb3_chac.human.intervention import ControlState, InterventionWrapper
from sb3_chac.human.rules import DisagreementRule, RiskRule, TakeoverRule, always, check_rule, make_rule, never
from sb3_chac.human.supervisor import ExpertError, RuleError

__all__ = [
    "ControlState",
    "DisagreementRule",
    "Expert",
    "ExpertError",
    "FunctionExpert",
    "InterventionWrapper",
    "ModelExpert",
    "RiskRule",
    "RuleError",
    "TakeoverRule",
    "always",
    "check_expert",
    "check_rule",
    "make_expert",
    "make_rule",
    "never",
]
