"""Networks and entropy coefficients as SB3's algorithms have them: what can be is learned with, what cannot is named."""

import inspect
import io

import numpy as np
import pytest
import torch as th
from eleven import ALL, GUIDED, OFFLINE, ON_POLICY, Walk, demonstrations, make_any
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN

import sb3_chac

IMITATING = ("BC", "HGDagger", "IWR")  # they have an actor alone
WITH_ENTROPY = tuple(name for name in ALL if "target_entropy" in inspect.signature(getattr(sb3_chac, name)).parameters)


class Pictures(Walk):
    observation_space = spaces.Box(0, 255, (1, 36, 36), np.uint8)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), *super().step(action)[1:]


def layers_of(name):
    if name in IMITATING:
        return {"pi": [7]}
    return {"pi": [7], "vf": [9]} if name in ON_POLICY else {"pi": [7], "qf": [9]}


@pytest.mark.parametrize("name", ALL)
def test_actor_and_critic_may_have_layers_of_their_own(name):
    policy = make_any(name, Walk(), policy_kwargs={"net_arch": layers_of(name)}).learn(24).policy
    sizes = {tuple(parameter.shape)[-2] for parameter in policy.parameters() if parameter.dim() > 1}
    assert 7 in sizes and (9 in sizes) == (name not in IMITATING) and 8 not in sizes


BAD_KWARGS = {
    "net_arch": [[8.0], ["a"], [0], [-3], [True], "x", 8, {"foo": [8]}, {"pi": 8}, {"pi": [8], "foo": [8]}, [np.nan], [[8]]],
    "activation_fn": ["relu", th.relu, None],
    "features_extractor_kwargs": [{"foo": 1}, [1]],
    "optimizer_kwargs": [{"foo": 1}, {"lr": 0.1}, "x"],
    "optimizer_class": ["Adam"],
    "normalize_images": [3],
    "foo": [1],
}


@pytest.mark.parametrize("name", ALL)
def test_what_policies_do_not_take_is_named(name):
    for key, values in BAD_KWARGS.items():
        for value in values:
            with pytest.raises(ValueError, match=rf"^policy_kwargs: .*{key}"):
                make_any(name, Walk(), policy_kwargs={key: value})
    if name not in (*ON_POLICY, *IMITATING):
        for value in (0, -1, 1.5, True, "2"):
            with pytest.raises(ValueError, match=r"^policy_kwargs: n_critics"):
                make_any(name, Walk(), policy_kwargs={"n_critics": value})


def test_what_the_discriminator_does_not_take_is_named():
    for kwargs in ({"foo": 1}, {"net_arch": [0]}, {"optimizer_kwargs": {"foo": 1}}):
        with pytest.raises(ValueError, match=r"^disc_kwargs: "):
            make_any("GAIL", Walk(), disc_kwargs=kwargs)


@pytest.mark.parametrize("name", WITH_ENTROPY)
@pytest.mark.parametrize("ent_coef", [0, 0.0, 0.05])
def test_a_fixed_coefficient_is_what_it_was_said_to_be(name, ent_coef):
    model = make_any(name, Walk(), ent_coef=ent_coef).learn(24)
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    loaded = type(model).load(file)
    for one in (model, loaded):
        assert one.log_ent_coef is None and one.ent_coef_tensor.item() == pytest.approx(ent_coef)
        assert all(value.isfinite().all() for value in one.policy.state_dict().values())


@pytest.mark.parametrize("name", WITH_ENTROPY)
def test_a_target_entropy_may_count_actions(name):
    model = make_any(name, Walk(), ent_coef="auto", target_entropy="auto_8").learn(24)
    assert model.target_entropy == -16 and model.log_ent_coef.exp().item() != 1
    with pytest.raises(ValueError, match=r"^target_entropy must be"):
        make_any(name, Walk(), target_entropy="auto-8")


@pytest.mark.parametrize("name", [name for name in ALL if name not in (*IMITATING, *ON_POLICY, "CQL")])
def test_an_agent_that_was_published_without_its_critics_does_not_learn(name):
    model = make_any(name, Walk())
    with th.no_grad():
        for parameter in model.policy.critic.parameters():
            parameter.zero_()
    model.predict(np.zeros(2))
    with pytest.raises(ValueError, match=r"^policy: the critics of this"):
        model.learn(10)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("name", ALL)
def test_a_model_is_loaded_with_the_arguments_that_it_was_made_with(name, tmp_path):
    kwargs = {"features_extractor_kwargs": {}}
    make_any(name, Walk(), policy_kwargs=dict(kwargs)).save(tmp_path / "model")
    given = kwargs | ({"use_sde": False} if name in ("DSAC", "DPVP", "CHAC", "SACLag") else {})  # SB3 adds this one
    model = getattr(sb3_chac, name).load(tmp_path / "model", policy_kwargs=given)
    assert all(key in given for key in model.policy_kwargs)


def test_cql_without_the_conservative_term():
    model = make_any("CQL", Walk(), conservative_weight=0.0).learn(5)
    assert all(value.isfinite().all() for value in model.policy.state_dict().values())


@pytest.mark.parametrize("name", ALL)
def test_pictures_go_through_a_cnn(name):
    rows = np.random.default_rng(0).integers(0, 256, (36, 1, 36, 36), np.uint8)
    columns = {"observation_space": Pictures.observation_space, "observations": rows, "next_observations": rows}
    dataset = {"dataset": demonstrations(**columns)} if name in (*OFFLINE, "GAIL") else {}
    policy = make_any(name, Pictures(), "CnnPolicy", **dataset).policy
    assert any(isinstance(module, NatureCNN) for module in policy.modules())


class Extractor(sb3_chac.dsac.MlpPolicy.default_features_extractor):
    """With a parameter."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.scale = th.nn.Parameter(th.ones(1))

    def forward(self, observations):
        return self.scale * super().forward(observations)


@pytest.mark.parametrize("name", [name for name in ALL if name not in IMITATING])
def test_a_shared_features_extractor_learns(name):
    kwargs = {"features_extractor_class": Extractor, "share_features_extractor": True, "net_arch": [8]}
    env = Walk()
    if name in GUIDED:
        env = sb3_chac.InterventionWrapper(env, lambda observation: np.zeros(2), "always", budget=15)
    model = make_any(name, env, policy_kwargs=kwargs).learn(40)
    actor = getattr(model.policy, "actor", model.policy)
    assert actor.features_extractor.scale.item() != 1
    if name not in ON_POLICY:
        assert model.policy.critic.features_extractor is actor.features_extractor


@pytest.mark.filterwarnings("ignore:.*no human is in the loop")
@pytest.mark.parametrize("name", ALL)
def test_spaces_of_double_precision(name):
    class Double(Walk):
        observation_space = spaces.Box(-100, 100, (2,), np.float64)
        action_space = spaces.Box(-1, 1, (2,), np.float64)

        def reset(self, seed=None, options=None):
            return super().reset(seed=seed)[0].astype(np.float64), {}

        def step(self, action):
            assert action.dtype == np.float64
            observation, *rest = super().step(action)
            return observation.astype(np.float64), *rest

    kwargs = {}
    if name in (*OFFLINE, "GAIL"):
        kwargs["dataset"] = demonstrations(observation_space=Double.observation_space, action_space=Double.action_space)
    model = make_any(name, Double(), **kwargs).learn(30)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
