"""Models on their way to a hub and back, which here is a folder."""

import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import yaml
from huggingface_sb3 import EnvironmentName, ModelName, ModelRepoId
from rl_zoo3 import load_from_hub, push_to_hub
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chac import DSAC


class Folder:
    """What of the hub's interface is used; a repository is a folder in ``place``."""

    place: Path

    def create_repo(self, repo_id, **kwargs):
        (self.place / repo_id).mkdir(parents=True, exist_ok=True)
        return f"folder://{repo_id}"

    def snapshot_download(self, repo_id, local_dir):
        shutil.copytree(self.place / repo_id, local_dir, dirs_exist_ok=True)

    def upload_folder(self, repo_id, folder_path, commit_message):
        shutil.copytree(folder_path, self.place / repo_id, dirs_exist_ok=True)


def test_a_model_goes_to_the_hub_and_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(Folder, "place", tmp_path / "hub", raising=False)
    monkeypatch.setattr(push_to_hub, "HfApi", Folder)

    def from_folder(repo_id, filename):
        path = tmp_path / "hub" / repo_id / filename
        if not path.exists():
            raise load_from_hub.HTTPError("404")
        return str(path)

    monkeypatch.setattr(load_from_hub, "load_from_hub", from_folder)
    monkeypatch.chdir(tmp_path)

    env = DummyVecEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=5)])
    model = DSAC("MlpPolicy", env, policy_kwargs=dict(net_arch=[8]), seed=0)
    name = EnvironmentName("Pendulum-v1")
    logs = tmp_path / "logs" / "dsac" / "Pendulum-v1_1"
    (logs / name).mkdir(parents=True)
    for file in ("args.yml", "config.yml"):
        (logs / name / file).write_text(yaml.dump({"algo": "dsac"}))
    push_to_hub.package_to_hub(
        model, ModelName("dsac", name), "dsac", "DSAC", logs, {"gamma": 0.99}, {}, name, env,
        ModelRepoId("someone", "dsac-Pendulum-v1"), "Initial commit", n_eval_episodes=1,
    )  # fmt: skip
    card = (tmp_path / "hub" / "someone" / "dsac-Pendulum-v1" / "README.md").read_text(encoding="utf-8")
    assert "library_name: stable-baselines3" in card and "A trained" not in card and "**DSAC** Agent" in card

    load_from_hub.download_from_hub("dsac", name, 0, "downloaded", "someone")
    loaded = DSAC.load(tmp_path / "downloaded" / "dsac" / "Pendulum-v1_1" / "Pendulum-v1.zip")
    observation = np.zeros(3, np.float32)
    assert np.array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
