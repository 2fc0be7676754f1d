"""What SB3's own test suite asks of its algorithms holds for ours, each in the role of its nearest relative."""

import sys
from pathlib import Path

import pytest
from sb3_suite_roles import GUIDED, NOT_APPLICABLE, ROLES

from sb3_chac.zoo.algorithms import ALGORITHMS

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import sb3_suite

FEW = [
    *("tests/test_save_load.py::test_save_load_pytorch_var", "tests/test_save_load.py::test_save_load"),
    *("tests/test_custom_policy.py::test_custom_offpolicy", "tests/test_custom_policy.py::test_flexible_mlp"),
    *("tests/test_run.py::test_n_critics", "tests/test_spaces.py::test_action_spaces"),
]
IN_FEW = {"SAC": 9, "TD3": 7, "PPO": 11}  # at least


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    return sb3_suite.fetch(tmp_path_factory.mktemp("sb3"))


def test_a_few_of_sb3s_own_tests(suite):
    names = ["DPVP", "BC", "GAIL"]
    rows, printed = sb3_suite.run(suite, names, FEW)
    assert not [row for row in rows if row[2] == "failed"], printed[-5000:]
    for name in names:
        passed = sum(row[0] == name and row[2] == "passed" for row in rows)
        assert passed >= IN_FEW[ROLES[name]], (name, passed, printed[-3000:])


@pytest.mark.slow
@pytest.mark.parametrize("names", sb3_suite.groups(list(ROLES)), ids=",".join)
def test_all_of_sb3s_own_tests(suite, names):
    rows, printed = sb3_suite.run(suite, names)
    assert {row[0] for row in rows} == set(names), printed[-3000:]
    assert not [row for row in rows if row[2] == "failed"], printed[-5000:]
    for name in names:
        outcomes = [row[2] for row in rows if row[0] == name]
        assert outcomes.count("passed") >= 30, (name, outcomes)


def test_every_algorithm_has_a_role_and_reasons_name_algorithms():
    assert set(ROLES) == set(ALGORITHMS.values()) and set(GUIDED) <= set(ROLES)
    assert all(set(names) <= set(ROLES) and part and why for names, part, why in NOT_APPLICABLE)
