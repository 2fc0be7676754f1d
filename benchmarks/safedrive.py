"""SafeDrive-v0: drivers, speed, traffic, and what SB3's SAC learns on it.

    python benchmarks/safedrive.py drivers    # scripted drivers, a blind lane follower and random actions on 200 maps
    python benchmarks/safedrive.py speed      # steps per CPU second, and memory over 1,000 episodes
    python benchmarks/safedrive.py traffic    # overlaps and standstills among the traffic
    python benchmarks/safedrive.py takeovers  # the human's stand-in beside novices of several kinds
    python benchmarks/safedrive.py learn --jobs 2   # SAC, 100K steps, 3 seeds; runs what is missing
    python benchmarks/safedrive.py report     # table and curves of what was learned

CSVs are written to benchmarks/results/safedrive/. Maps: 100-119 to learn on, 1000-1049 to test what was learned,
400000-400199 for the drivers. None of these was used while tuning; that was done on maps from 2000, 5000, 7000 and 300000.
"""

import argparse
import csv
import resource
import time
from pathlib import Path

import gymnasium as gym
import lab
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps

import sb3_chac.envs  # noqa: F401
from sb3_chac.envs.driving.geometry import boxes_overlap
from sb3_chac.envs.safedrive.driver import ScriptedDriver
from sb3_chac.envs.safedrive.navigation import N_STATE, route_ahead
from sb3_chac.envs.safedrive.traffic import CAR_LENGTH, CAR_WIDTH
from sb3_chac.evaluation.evaluation import evaluate
from sb3_chac.human import InterventionWrapper

RESULTS = Path(__file__).parent / "results" / "safedrive"
VERSIONS = lab.versions("torch", "stable-baselines3", "gymnasium", "highway-env", "numpy")
DRIVER_MAPS = range(400_000, 400_200)
TEST_MAPS = range(1000, 1050)
LEARN_STEPS, LEARN_EVERY = 100_000, 10_000


class BlindFollower:
    """Keeps to its lane and to the speed that the curves allow, and sees nobody."""

    def __init__(self, env):
        self.env = env
        self.driver = env.scripted_driver("scripted-ideal")

    def reset(self, seed=None):
        self.driver.reset(seed)
        self.lane = self.env.lateral

    def __call__(self, observation):
        self.driver._locate()
        error = self.driver._speed_cap() - self.env.ego.speed
        return np.clip([self.driver._steering(self.lane, 0.28), error], -1, 1)


class ConstantDriver:
    def __init__(self, action):
        self.action = action

    def reset(self, seed=None):
        pass

    def __call__(self, observation):
        return self.action


class RandomDriver:
    def __init__(self, env):
        self.env = env

    def reset(self, seed=None):
        self.rng = np.random.default_rng(seed)

    def __call__(self, observation):
        return self.rng.uniform(-1, 1, 2)


def drive(env, driver, scenario: int) -> dict:
    row = lab.drive(env, driver, scenario, "contact", "contact_steps")
    return row | {"route_length": round(env.map.length, 1)}


def drivers(args: argparse.Namespace) -> None:
    env = gym.make("SafeDrive-v0").unwrapped
    makers = {name: (lambda name=name: env.scripted_driver(name)) for name in ("scripted-ideal", "scripted")}
    makers |= {"blind": lambda: BlindFollower(env), "random": lambda: RandomDriver(env)}
    rows = []
    for name, make in makers.items():
        driver = make()
        results = [{"driver": name, **drive(env, driver, scenario), "versions": VERSIONS} for scenario in DRIVER_MAPS]
        rows += results
        keys = ("return", "cost", "success", "out_of_road", "route_completion", "steps")
        print(name, {key: round(float(np.mean([row[key] for row in results])), 3) for key in keys}, flush=True)
    lab.write(RESULTS / "drivers.csv", rows)


def reference_loop(n: int) -> float:
    """CPU seconds of a fixed mix of small numpy calls and Python, to compare machines by."""
    start, x = time.process_time(), np.linspace(0, 1, 240)
    for _ in range(n):
        y = np.sqrt(x * x + 1.0)
        y = np.where(y > 1.2, y, 0.0)
        float(y.min()) + sum(range(20))
    return time.process_time() - start


def time_corridors(env, observations: list[np.ndarray]) -> float:
    """CPU seconds that the corridors of one observation take, the route rebuilt from it included."""
    start = time.process_time()
    for observation in observations:
        env._corridors(observation[N_STATE : N_STATE + env.lidar.rays], *route_ahead(observation))
    return (time.process_time() - start) / len(observations)


def speed(args: argparse.Namespace) -> None:
    """Ten rounds that take turns with the reference loop; the driver's time and that of compilation are not counted."""
    env = gym.make("SafeDrive-v0").unwrapped
    driver = env.scripted_driver("scripted")
    for scenario in range(100, 120):
        env.reset(options={"scenario": scenario})
        env.step(driver())
    rows = []
    for part in range(10):
        steps = cpu = 0.0
        observations = []
        for scenario in range(100 + 2 * part, 102 + 2 * part):
            env.reset(options={"scenario": scenario})
            driver.reset(scenario)
            done = False
            while not done:
                action = driver()
                start = time.process_time()
                observation, _, terminated, truncated, _ = env.step(action)
                cpu += time.process_time() - start
                observations.append(observation)
                steps, done = steps + 1, terminated or truncated
        reference = reference_loop(20_000)
        row = {"part": part, "steps": int(steps), "cpu_seconds": round(cpu, 4), "steps_per_cpu_second": round(steps / cpu, 1)}
        row |= {"corridors_us": round(time_corridors(env, observations) * 1e6, 1)}
        rows.append({**row, "reference_us": round(reference / 20_000 * 1e6, 3), "versions": VERSIONS})
    rates = [row["steps_per_cpu_second"] for row in rows]
    per_reference = np.mean([1e6 / row["steps_per_cpu_second"] / row["reference_us"] for row in rows])
    print(
        f"{np.mean(rates):.0f} steps per CPU second (least {min(rates):.0f}); a step costs {per_reference:.1f} reference loops"
        f"; the corridors take {np.mean([row['corridors_us'] for row in rows]):.0f} us"
    )
    lab.write(RESULTS / "speed.csv", rows)

    rows = []
    for episode in range(1000):
        env.reset(seed=episode)
        for _ in range(20):
            env.step(env.action_space.sample())
        if episode % 50 == 49:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            current = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20
            rows.append({"episodes": episode + 1, "resident_mib": round(current, 1), "peak_mib": round(peak / 1024, 1)})
    print(f"memory after 50 episodes {rows[0]['resident_mib']} MiB, after 1000 {rows[-1]['resident_mib']} MiB")
    lab.write(RESULTS / "memory.csv", rows)


def traffic(args: argparse.Namespace) -> None:
    """Pairs of cars that overlap, and cars that stood for 15 s and were towed away, while the scripted driver drives."""
    rows = []
    for density in (0.6, 1.0, 2.0):
        env = gym.make("SafeDrive-v0", traffic_density=density).unwrapped
        driver = env.scripted_driver("scripted")
        for scenario in range(400_000, 400_100):
            env.reset(options={"scenario": scenario})
            driver.reset(scenario)
            pairs, done, most, longest = set(), False, 0, 0.0
            while not done:
                _, _, terminated, truncated, _ = env.step(driver())
                done = terminated or truncated
                cars, t = env.traffic.visible, env.traffic
                most = max(most, len(cars))
                longest = max(longest, float(t.standing[cars].max(initial=0.0)))
                for i in range(len(cars) - 1):
                    others = slice(i + 1, None)
                    size = CAR_LENGTH, CAR_WIDTH
                    hits = boxes_overlap(t.positions[i], t.headings[i], *size, t.positions[others], t.headings[others], *size)
                    pairs |= {(int(cars[i]), int(cars[i + 1 + j])) for j in np.flatnonzero(hits)}
            row = {"traffic_density": density, "scenario": scenario, "overlaps": len(pairs), "towed": env.traffic.towed}
            rows.append({**row, "most_cars": most, "longest_standing_s": round(longest, 1), "steps": env.steps})
        here = rows[-100:]
        print(density, {k: sum(row[k] for row in here) for k in ("overlaps", "towed")}, "in 100 episodes", flush=True)
    lab.write(RESULTS / "traffic.csv", rows)


def takeovers(args: argparse.Namespace) -> None:
    """The default human (scripted driver, risk rule) beside novices from good to bad."""
    env = InterventionWrapper(gym.make("SafeDrive-v0"))
    raw = env.unwrapped
    novices = {
        "scripted-ideal": raw.scripted_driver("scripted-ideal"),
        "scripted": raw.scripted_driver("scripted"),
        "noise 0.6": ScriptedDriver(raw, reaction_delay=0, action_noise=0.6),
        "straight on": ConstantDriver(np.array([0.0, 0.5])),
        "random": RandomDriver(raw),
    }
    rows = []
    for name, novice in novices.items():
        for armed in (False, True):
            (env.arm if armed else env.disarm)()
            for scenario in range(400_000, 400_050):
                observation, _ = env.reset(seed=scenario, options={"scenario": scenario})
                novice.reset(scenario)
                done, human, starts, human_cost = False, 0, 0, 0.0
                while not done:
                    action = np.asarray(novice(observation), np.float32)
                    observation, _, terminated, truncated, info = env.step(action)
                    done = terminated or truncated
                    human, starts = human + info["takeover"], starts + info["takeover_start"]
                    human_cost += info["cost"] * info["takeover"]
                row = {"novice": name, "armed": int(armed), "scenario": scenario, "steps": raw.steps, "human_steps": human}
                row |= {"takeovers": starts, "cost": int(info["episode_cost"]), "cost_while_human": int(human_cost)}
                rows.append({**row, "success": int(info["is_success"]), "out_of_road": int(info["out_of_road"])})
            here = rows[-50:]
            mean = {
                key: round(float(np.mean([row[key] for row in here])), 2) for key in ("success", "cost", "cost_while_human")
            }
            share = sum(row["human_steps"] for row in here) / sum(row["steps"] for row in here)
            print(f"{name:15s}{'armed' if armed else 'alone'}  takeover share {share:.3f}", mean, flush=True)
    lab.write(RESULTS / "takeovers.csv", rows)


class Evaluate(BaseCallback):
    """Append one row to the CSV each time it is called."""

    def __init__(self, file, labels: dict):
        super().__init__()
        self.file, self.labels = file, labels

    def _on_step(self) -> bool:
        summary = evaluate(self.model, "SafeDrive-v0", TEST_MAPS).summary()
        row = {**self.labels, "step": self.num_timesteps, **{key: round(value, 4) for key, value in summary.items()}}
        row |= {"cpu_seconds": round(time.process_time()), "versions": VERSIONS}
        writer = csv.DictWriter(self.file, list(row))
        if self.file.tell() == 0:
            writer.writeheader()
        writer.writerow(row)
        self.file.flush()
        return True


def learn_one(seed: int, steps: int, path: Path) -> str:
    th.set_num_threads(1)
    # The entry of hyperparams/sac.yml; fused Adam changes the speed, not the result
    kwargs = dict(net_arch=[256, 256], optimizer_kwargs={"fused": True})
    model = SAC("MlpPolicy", "SafeDrive-v0", learning_starts=1000, policy_kwargs=kwargs, seed=seed, device="cpu")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        model.learn(steps, callback=EveryNTimesteps(LEARN_EVERY, Evaluate(file, {"algo": "sac", "seed": seed})))
    return f"sac seed {seed}: {time.process_time():.0f} CPU seconds"


def learn(args: argparse.Namespace) -> None:
    paths = {seed: RESULTS / f"sac-{seed}.csv" for seed in args.seeds}
    missing = [s for s, path in paths.items() if not lab.read(path) or int(lab.read(path)[-1]["step"]) < args.steps]
    lab.run_all([(learn_one, seed, args.steps, paths[seed]) for seed in missing], args.jobs)


def report(args: argparse.Namespace) -> None:
    """Table and curves: mean over seeds, shaded from the least to the greatest."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    runs = [lab.read(path) for path in sorted(RESULTS.glob("sac-[012].csv"))]
    steps = [int(row["step"]) for row in runs[0]]
    names = {"success_rate": "success rate", "cost_mean": "safety cost", "return_mean": "return"}
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2))
    for axis, (key, title) in zip(axes, names.items(), strict=True):
        curves = np.array([[float(row[key]) for row in run] for run in runs])
        last = curves[:, -3:].mean(axis=1)
        print(
            f"{title}: last three evaluations {last.mean():.2f} ± {last.std(ddof=1):.2f}, at the end {curves[:, -1].round(2)}"
        )
        axis.plot(steps, curves.mean(axis=0))
        axis.fill_between(steps, curves.min(axis=0), curves.max(axis=0), alpha=0.15)
        axis.set(title=title, xlabel="environment steps")
    figure.tight_layout()
    figure.savefig(RESULTS / "sac.png", dpi=90)


if __name__ == "__main__":
    commands = {f.__name__: f for f in (drivers, speed, traffic, takeovers, learn, report)}
    parser = lab.make_parser(__doc__, commands)
    lab.add_seeds(parser)
    parser.add_argument("--steps", type=int, default=LEARN_STEPS)
    lab.add_jobs(parser)
    arguments = parser.parse_args()
    commands[arguments.command](arguments)
