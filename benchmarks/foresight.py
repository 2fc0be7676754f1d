"""How well Z_g and Z_c foresee takeovers: a trained C-HAC drives on maps that it has not seen, with the human at hand.

    python benchmarks/foresight.py benchmarks/models/SafeDrive-v0/chac-stage-1-*.zip

The models are those that ``guidance.py run`` leaves. A row for each goes to benchmarks/results/guidance/foresight.csv: the
area under the ROC curve of "Q is low" as a sign that the human takes over within 1, 3, 10 and 20 steps (.5 is chance).
"""

import argparse
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th

from sb3_chac import CHAC, InterventionWrapper

RESULTS = Path(__file__).parent / "results" / "guidance" / "foresight.csv"
MAPS = range(2000, 2060)
HORIZONS = (1, 3, 10, 20)  # steps


def drive(model: CHAC) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """
    :return: of the steps of the novice: Q of Z_g, Q of Z_c, and steps until the next takeover; the takeovers of each episode
    """
    env = InterventionWrapper(gym.make("SafeDrive-v0"), armed=True)
    rows, starts = [], []
    for scenario in MAPS:
        observation, _ = env.reset(seed=scenario, options={"scenario": scenario})
        episode, done = [], False
        while not done:
            action, _ = model.predict(observation, deterministic=True, control="guided")
            with th.no_grad():
                state = th.as_tensor(observation)[None]
                scaled = th.as_tensor(model.policy.scale_action(action), dtype=th.float32)[None]
                critics = (model.critic, model.confidence_critic)
                values = [float(critic.pessimistic(state, scaled)[0]) for critic in critics]
            observation, _, terminated, truncated, info = env.step(action)
            episode.append((*values, info["takeover"], info["takeover_start"]))
            done = terminated or truncated
        q_guided, q_confidence, takeover, start = np.array(episode, float).T
        starts.append(np.flatnonzero(start))
        steps = np.arange(len(episode))
        following = np.searchsorted(starts[-1], steps)
        until = np.append(starts[-1], np.inf)[following] - steps
        rows.append(np.stack([q_guided, q_confidence, until])[:, takeover == 0])
    return *np.concatenate(rows, axis=1), starts  # type: ignore[return-value]


def area(values: np.ndarray, positive: np.ndarray) -> float:
    """
    :return: probability that a positive step has a lower value than another one
    """
    ranks = np.argsort(np.argsort(-values))
    n = positive.sum()
    return float((ranks[positive].sum() - n * (n - 1) / 2) / (n * (~positive).sum()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path, metavar="MODEL.zip")
    th.set_num_threads(1)
    rows = []
    for path in parser.parse_args().models:
        q_guided, q_confidence, until, starts = drive(CHAC.load(path, device="cpu"))
        row = {"model": path.stem, "steps": len(until), "takeovers": sum(map(len, starts))}
        for name, values in (("z_g", q_guided), ("z_c", q_confidence)):
            row |= {f"{name}_{h}": round(area(values, until <= h), 3) for h in HORIZONS}
        rows.append(row | {"versions": lab.versions("torch", "stable-baselines3", "highway-env", "numpy")})
        print(rows[-1], flush=True)
    lab.write(RESULTS, rows)
