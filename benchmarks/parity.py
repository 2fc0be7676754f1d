"""BC and CQL against d3rlpy 2.8.1, on the same data with the same hyperparameters (Pendulum-v1).

    python benchmarks/parity.py data                  # SAC learns; what it saw, and what it does in the end, are the datasets
    python benchmarks/parity.py ours                  # BC on the last 4,000 steps, CQL on all 10,000, seeds 0-2
    python -m venv d3rlpy-venv; d3rlpy-venv/bin/pip install torch==2.13.0 d3rlpy==2.8.1
    d3rlpy-venv/bin/python benchmarks/parity.py d3rlpy    # the same with d3rlpy, which cannot be installed beside us
    python benchmarks/parity.py report

In d3rlpy the target of Q takes the actor's mean action, in the paper and here a sampled one. d3rlpy has no 1/2 before the
temporal difference, so that its conservative weight of 5 is 2.5 here. Rows are appended to
benchmarks/results/parity/parity.csv; the datasets are committed beside it.
"""

import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import lab
import numpy as np

RESULTS = Path(__file__).parent / "results" / "parity"
ENV = "Pendulum-v1"
HIDDEN, BATCH, GAMMA, TAU = [64, 64], 128, 0.98, 0.005
BC_RATE, CRITIC_RATE, ACTOR_RATE, WEIGHT, N_SAMPLES = 1e-3, 1e-3, 3e-4, 5.0, 10
DATASETS = {"bc": "expert", "cql": "replay"}
STEPS = {"bc": 5_000, "cql": 20_000}  # of the gradient; 10,000 are just enough for d3rlpy's CQL, not for each seed of ours


def mean_return(act: Any) -> float:
    """
    :param act: observation -> action
    :return: mean over 50 episodes
    """
    env = gym.make(ENV)
    total = 0.0
    for episode in range(50):
        observation, _ = env.reset(seed=50_000 + episode)
        done = False
        while not done:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, done = total + float(reward), terminated or truncated
    return total / 50


def data() -> None:
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", ENV, learning_rate=1e-3, learning_starts=500, seed=100, device="cpu").learn(10_000)
    buffer = model.replay_buffer
    assert buffer is not None
    columns = {
        "observations": buffer.observations[:10_000, 0],
        "actions": model.policy.unscale_action(buffer.actions[:10_000, 0]),
        "next_observations": buffer.next_observations[:10_000, 0],
        "rewards": buffer.rewards[:10_000, 0],
        "ends": buffer.dones[:10_000, 0].astype(bool),  # time limits, all of them
    }
    print(f"SAC: {mean_return(lambda o: model.predict(o, deterministic=True)[0]):.0f}")
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name, rows in {"replay": slice(None), "expert": slice(6_000, None)}.items():
        np.savez_compressed(RESULTS / f"{name}.npz", **{key: column[rows] for key, column in columns.items()})


def save(library: str, algo: str, seed: int, score: float, start: float) -> None:
    packages = ("torch", "numpy", "gymnasium", "d3rlpy" if library == "d3rlpy" else "stable-baselines3")
    row = {
        "library": library,
        "algo": algo,
        "steps": STEPS[algo],
        "seed": seed,
        "return": round(score, 1),
        "cpu_seconds": round(time.process_time() - start),
        "versions": lab.versions(*packages),
    }
    print(row, flush=True)
    lab.append(RESULTS / "parity.csv", row)


def ours(algo: str, seed: int, columns: dict[str, np.ndarray]) -> float:
    import torch as th

    from sb3_chac import BC, CQL
    from sb3_chac.common.demonstrations import Demonstrations

    th.set_num_threads(1)
    env = gym.make(ENV)
    ends = columns.pop("ends")
    episodes = np.cumsum(ends) - ends
    dataset = Demonstrations(
        env.observation_space,
        env.action_space,
        **columns,  # type: ignore[arg-type]
        terminations=np.zeros(len(ends), bool),
        truncations=ends,
        episodes=episodes,
    )
    common: dict[str, Any] = dict(batch_size=BATCH, seed=seed, device="cpu", policy_kwargs=dict(net_arch=HIDDEN))
    model: BC | CQL
    if algo == "bc":
        model = BC("MlpPolicy", env, dataset, learning_rate=BC_RATE, validation_share=0.0, **common)
    else:
        model = CQL(
            "MlpPolicy",
            env,
            dataset,
            learning_rate=CRITIC_RATE,
            actor_lr=ACTOR_RATE,
            gamma=GAMMA,
            tau=TAU,
            conservative_weight=WEIGHT / 2,
            n_action_samples=N_SAMPLES,
            **common,
        )
    model.learn(STEPS[algo])
    return mean_return(lambda observation: model.predict(observation, deterministic=True)[0])


def d3rlpy(algo: str, seed: int, columns: dict[str, np.ndarray]) -> float:
    import d3rlpy as library
    import torch as th

    th.set_num_threads(1)
    library.seed(seed)
    encoder = library.models.encoders.VectorEncoderFactory(HIDDEN)
    scaler = library.preprocessing.MinMaxActionScaler(minimum=np.array([-2.0]), maximum=np.array([2.0]))
    ends = columns["ends"].astype(np.float32)
    dataset = library.dataset.MDPDataset(
        columns["observations"], columns["actions"], columns["rewards"], np.zeros_like(ends), timeouts=ends
    )
    config: Any
    if algo == "bc":
        config = library.algos.BCConfig(BATCH, learning_rate=BC_RATE, encoder_factory=encoder, action_scaler=scaler)
    else:
        config = library.algos.CQLConfig(
            BATCH,
            GAMMA,
            actor_learning_rate=ACTOR_RATE,
            critic_learning_rate=CRITIC_RATE,
            temp_learning_rate=ACTOR_RATE,
            alpha_learning_rate=0.0,
            actor_encoder_factory=encoder,
            critic_encoder_factory=encoder,
            tau=TAU,
            conservative_weight=WEIGHT,
            n_action_samples=N_SAMPLES,
            action_scaler=scaler,
        )
    model = config.create(device="cpu:0")
    model.fit(dataset, STEPS[algo], STEPS[algo], show_progress=False, logger_adapter=library.logging.NoopAdapterFactory())
    return mean_return(lambda observation: model.predict(observation[None])[0])


def report() -> None:
    rows = lab.read(RESULTS / "parity.csv")
    print("| algorithm | dataset (mean return of an episode) | steps | ours | d3rlpy 2.8.1 |")
    print("|---" * 5 + "|")
    for algo, steps in sorted({(row["algo"], int(row["steps"])) for row in rows}):
        columns = np.load(RESULTS / f"{DATASETS[algo]}.npz")
        cells = []
        for library in LIBRARIES:
            run = {"library": library, "algo": algo, "steps": str(steps)}
            scores = [float(row["return"]) for row in rows if run.items() <= row.items()]
            cells.append(f"{np.mean(scores):.0f} ± {np.std(scores, ddof=1):.0f} ({len(scores)} seeds)" if scores else "")
        mean = columns["rewards"].sum() / columns["ends"].sum()
        print(f"| {algo.upper()} | {DATASETS[algo]} ({mean:.0f}) | {steps} | " + " | ".join(cells) + " |")


LIBRARIES = {"ours": ours, "d3rlpy": d3rlpy}

if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["data", *LIBRARIES, "report"])
    parser.add_argument("--algos", nargs="+", choices=DATASETS, default=list(DATASETS))
    lab.add_seeds(parser)
    args = parser.parse_args()
    if args.command in ("data", "report"):
        {"data": data, "report": report}[args.command]()
    else:
        for algo in args.algos:
            for seed in args.seeds:
                start = time.process_time()
                columns = dict(np.load(RESULTS / f"{DATASETS[algo]}.npz"))
                score = LIBRARIES[args.command](algo, seed, columns)
                save(args.command, algo, seed, score, start)
