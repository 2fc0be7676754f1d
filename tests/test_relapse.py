"""C-HAC notices that stage 2 forgets, and keeps the best policy."""

import warnings

import numpy as np
import pytest
import torch as th
from guided_toys import Limited
from test_chac import make_chac

from sb3_chac.chac.relapse import RelapseWatch
from sb3_chac.common.callbacks import GuidedProgressBar

GOOD, BAD = [10.0, 11.0, 9.0, 10.0], [1.0, 2.0, 0.0, 1.0]


@pytest.fixture
def policy():
    return th.nn.Linear(1, 1)


def judged(watch, policy, scores):
    begins = []
    for score in scores:
        watch.add(score)
        begins.append(watch.judge(policy))
    return any(begins)


def reach(policy, value):
    th.nn.init.constant_(policy.weight, value)


def test_the_best_is_kept_and_restored(policy):
    watch = RelapseWatch(4)
    for score in GOOD:
        watch.add(score)
    reach(policy, 1.0)
    watch.begin(policy)  # stage 1 is the first best
    reach(policy, 2.0)
    assert not judged(watch, policy, [score + 5 for score in GOOD])  # better: the new best
    reach(policy, 3.0)
    assert judged(watch, policy, BAD) and watch.relapsed
    assert not judged(watch, policy, BAD) and watch.relapsed  # it has begun before
    watch.restore(policy)
    assert policy.weight.item() == 2.0 and not watch.relapsed


def test_a_relapse_may_pass(policy):
    watch = RelapseWatch(4)
    judged(watch, policy, GOOD)
    assert judged(watch, policy, BAD)
    judged(watch, policy, GOOD)
    assert not watch.relapsed


def test_noise_is_no_relapse(policy):
    """Episodes that are all alike: in 300 trainings of 15 windows the alarm is raised in less than 5 %."""
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(300):
        watch = RelapseWatch(20)
        alarms += judged(watch, policy, rng.normal(size=15 * 20))
    assert alarms < 15


def test_few_episodes_are_not_judged(policy):
    watch = RelapseWatch(4)
    watch.add(1.0)
    watch.begin(policy)
    assert watch.best is None and not judged(watch, policy, BAD[:3])


@pytest.mark.parametrize("return_to_best", [False, True])
def test_learn_ends_with_the_best(return_to_best):
    model = make_chac(Limited(length=20), switch_after=40, relapse_window=2, return_to_best=return_to_best)
    model.learn(300)
    assert model.stage == 2 and model.watch.best is not None
    best = {name: tensor.clone() for name, tensor in model.watch.best_parameters.items()}

    model.watch.best = model.watch.best._replace(mean=1e6)  # nothing can be as good
    with pytest.warns(UserWarning, match="stage 2 has become worse"):
        model.learn(300, reset_num_timesteps=False)
    if return_to_best:  # at once, and it has learned since
        assert not all(th.equal(best[name], tensor) for name, tensor in model.policy.state_dict().items())
    else:
        assert all(th.equal(best[name], tensor) for name, tensor in model.policy.state_dict().items())


def test_a_relapse_is_shown():
    model = make_chac(switch_after=40, relapse_window=2)
    model.learn(100)
    model.watch.relapsed = True
    bar = GuidedProgressBar()
    bar.model = model
    assert "RELAPSE" in bar.text()
    recorded = {}
    model.logger.record = lambda name, value, *args, **kwargs: recorded.update({name: value})
    model.dump_logs()
    assert recorded["chac/relapse"] == 1


def test_nothing_is_judged_if_not_wanted():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = make_chac(switch_after=40, relapse_window=0).learn(150)
    assert model.stage == 2 and model.watch is None


@pytest.mark.parametrize("window", [1, -1, 2.5])
def test_bad_windows(window):
    with pytest.raises(ValueError, match="relapse_window"):
        make_chac(relapse_window=window)
