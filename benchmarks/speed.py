"""Speed of ``train()``: gradient steps per CPU second of DSAC, D-PVP and C-HAC against those of SB3's SAC.

    python benchmarks/speed.py            # writes benchmarks/results/speed.csv and prints the ratios

One torch thread, the same prefilled replay buffer, batch size 256, net [256, 256]. The algorithms take turns in short
blocks within one process, so that what else the machine does falls on both; the ratio of each pair of blocks counts.
``_bf16``: float32 products made of bfloat16 ones (``torch.set_float32_matmul_precision("medium")``), which pays on
processors with AMX or AVX512-BF16.
"""

import argparse
import csv
import platform
import time
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure

from sb3_chac import CHAC, DPVP, DSAC
from sb3_chac.common.buffers import DualReplayBuffer

RESULTS = Path(__file__).parent / "results" / "speed.csv"
SIZES = {259: 2, 17: 6}  # observation and action dimensions: SafeDrive without corridors, HalfCheetah
BATCH_SIZE = 256
ACTIVATIONS = {"relu": th.nn.ReLU, "gelu": th.nn.GELU}
VARIANTS = {
    "sac_relu": (SAC, "relu", {}),
    "dsac_relu_delay1": (DSAC, "relu", {"policy_delay": 1}),
    "dsac_gelu_delay1": (DSAC, "gelu", {"policy_delay": 1}),
    "dsac_gelu_delay2": (DSAC, "gelu", {"policy_delay": 2}),
    "dpvp_gelu_delay1": (DPVP, "gelu", {"policy_delay": 1}),
    "chac_gelu_delay1": (CHAC, "gelu", {"policy_delay": 1}),
    "chac_gelu_delay1_stage2": (CHAC, "gelu", {"policy_delay": 1}),
    "sac_relu_bf16": (SAC, "relu", {}),
    "dsac_gelu_delay1_bf16": (DSAC, "gelu", {"policy_delay": 1}),
    "dsac_gelu_delay2_bf16": (DSAC, "gelu", {"policy_delay": 2}),
    "dpvp_gelu_delay1_bf16": (DPVP, "gelu", {"policy_delay": 1}),
    "chac_gelu_delay1_bf16": (CHAC, "gelu", {"policy_delay": 1}),
    "chac_gelu_delay1_stage2_bf16": (CHAC, "gelu", {"policy_delay": 1}),
}


class Spaces(gym.Env):
    """Only there for its spaces."""

    def __init__(self, obs_dim: int, action_dim: int):
        self.observation_space = spaces.Box(-1, 1, (obs_dim,), np.float32)
        self.action_space = spaces.Box(-1, 1, (action_dim,), np.float32)


def prefilled(name: str, obs_dim: int, action_dim: int):
    algorithm, activation, kwargs = VARIANTS[name]
    env = Spaces(obs_dim, action_dim)
    policy_kwargs = {"net_arch": [256, 256], "activation_fn": ACTIVATIONS[activation]}
    model = algorithm("MlpPolicy", env, buffer_size=50_000, policy_kwargs=policy_kwargs, seed=0, device="cpu", **kwargs)
    model.set_logger(configure(None, []))
    rng, buffer = np.random.default_rng(0), model.replay_buffer
    if isinstance(buffer, DualReplayBuffer):
        for store, takeover in ((buffer.novice, 0.0), (buffer.human, 1.0)):
            for column, array in store.arrays.items():
                filled = "observation" in column or column in ("action", "novice_action", "reward")
                array[:] = rng.uniform(-1, 1, array.shape) if filled else 0.0
            store.arrays["takeover"][:], store.added = takeover, store.capacity
    else:
        for values in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
            values[:] = rng.uniform(-1, 1, values.shape)
        buffer.full = True
    if "stage2" in name:
        model.policy.start_stage_2()
    return model


def processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=15, help="pairs of blocks per size")
    parser.add_argument("--steps", type=int, default=60, help="gradient steps in a block")
    parser.add_argument("--sizes", nargs="+", type=int, choices=SIZES, default=list(SIZES), help="of the observation")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    th.set_num_threads(1)
    versions = lab.versions("torch", "stable-baselines3", "sb3_chac")

    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["obs_dim", "block", *(f"{name}_steps_per_cpu_second" for name in VARIANTS), "processor", "versions"])
        for obs_dim in args.sizes:
            models = {name: prefilled(name, obs_dim, SIZES[obs_dim]) for name in VARIANTS}
            speeds: dict[str, list[float]] = {name: [] for name in VARIANTS}
            for block in range(-2, args.blocks):  # two blocks to warm up
                for name, model in models.items():
                    th.set_float32_matmul_precision("medium" if name.endswith("bf16") else "highest")
                    start = time.process_time()
                    model.train(gradient_steps=args.steps, batch_size=BATCH_SIZE)
                    if block >= 0:
                        speeds[name].append(args.steps / (time.process_time() - start))
                if block >= 0:
                    writer.writerow([obs_dim, block, *(f"{speeds[name][-1]:.1f}" for name in VARIANTS), processor(), versions])
                    file.flush()
            for name in VARIANTS:
                ratios = np.array(speeds[name]) / np.array(speeds["sac_relu"])
                low, median, high = np.quantile(ratios, [0.25, 0.5, 0.75])
                speed = np.median(speeds[name])
                print(f"obs {obs_dim:3d}  {name:24s} {speed:6.1f} steps/s  {median:.2f}x SAC (quartiles {low:.2f}-{high:.2f})")


if __name__ == "__main__":
    main()
