"""A model is loaded by the algorithm that saved it, and by no other."""

import io
import json
import zipfile

import pytest
import stable_baselines3
from eleven import ALL, GUIDED, Walk, make_any

import sb3_chac
from sb3_chac.cockpit.driven import driven
from sb3_chac.common.saved_by import algorithm_name, saved_by

each = pytest.mark.parametrize("name", ALL)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for name in ALL:
        make_any(name, Walk()).save(folder / name)
    for name in ("SAC", "TD3", "DDPG", "PPO"):
        getattr(stable_baselines3, name)("MlpPolicy", Walk(), policy_kwargs={"net_arch": [8]}).save(folder / name)
    return folder


@each
def test_what_another_algorithm_saved_is_refused(name, models):
    algorithm = getattr(sb3_chac, name)
    for other in set(ALL) - {name}:
        with pytest.raises(ValueError, match=rf"^path: {other} saved this model, load it with {other}.load\(...\), not with"):
            algorithm.load(models / other)
    for other in ("SAC", "TD3", "DDPG", "PPO"):
        same_policy = (name, other) in (("PVP", "TD3"), ("PVP", "DDPG"), ("GAIL", "PPO"))
        message = "replay_buffer_class|Names of parameters" if same_policy else rf"policy: {name} needs a \w+, got \w+Policy"
        with pytest.raises(ValueError, match=message):
            algorithm.load(models / other)


@each
def test_models_are_loaded_by_who_saved_them_however_they_are_given(name, models):
    algorithm = getattr(sb3_chac, name)
    own = type("Own", (algorithm,), {})
    path = models / f"{name}.zip"
    for given in (path, str(models / name), io.BytesIO(path.read_bytes())):
        assert saved_by(given) == name
        algorithm.load(given)
    with path.open("rb") as file:
        own.load(file, env=Walk()).save(models / "own")
    assert type(algorithm.load(models / "own")) is algorithm


@each
def test_models_that_do_not_tell_who_saved_them_are_loaded(name, models):
    old = io.BytesIO()
    with zipfile.ZipFile(models / f"{name}.zip") as archive, zipfile.ZipFile(old, "w") as changed:
        for entry in archive.namelist():
            data = archive.read(entry)
            if entry == "data":
                told = json.loads(data)
                del told["saved_by"]
                data = json.dumps(told)
            changed.writestr(entry, data)
    assert saved_by(old) is None
    getattr(sb3_chac, name).load(old)


@pytest.mark.parametrize("name", GUIDED)
def test_a_drive_saves_its_algorithms_model(name):
    assert algorithm_name(driven(getattr(sb3_chac, name))) == name
