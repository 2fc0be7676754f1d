"""
Exported policies: equality with ``predict``, latency, and driving over a bad link. Each command appends rows to a CSV in
benchmarks/results/deploy and goes on where it was stopped.

  python benchmarks/deploy.py export     10,000 observations of test maps, each committed agent for SafeDrive-v0
  python benchmarks/deploy.py latency    decisions, start and memory of the runtime, beside predict
  python benchmarks/deploy.py link       200 maps directly, and over a link with 0 to 80 ms of jitter and 5 % loss each way
  python benchmarks/deploy.py cuts       200 cuts of that link: when the vehicle brakes, where it stands
  python benchmarks/deploy.py report     the table

A simulated clock ticks in ``link`` and ``cuts``, so that their rows do not depend on the machine.
"""

import gc
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import lab
import numpy as np

import sb3_chac.envs  # noqa: F401
from sb3_chac.deploy.gate import State
from sb3_chac.deploy.link import Channel, SimulatedSocket
from sb3_chac.deploy.policy import OnnxPolicy
from sb3_chac.deploy.runtime import Runtime
from sb3_chac.deploy.server import PolicyServer
from sb3_chac.deploy.udp import Flag, VehicleLink
from sb3_chac.envs.safedrive import SafeDriveEnv

HERE = Path(__file__).parent
AGENTS = {  # file -> keyword arguments of its environment
    "chac-SafeDrive-v0": {"corridors": False},
    "dpvp-SafeDrive-v0": {},
    "pvp-SafeDrive-v0": {"corridors": False},
    "dsac-SafeDrive-v0": {"corridors": False},
    "sac-SafeDrive-v0": {"corridors": False},
}
DRIVER = "dpvp-SafeDrive-v0"  # the best of them drives over the link
TICK = 0.01  # [s] of the vehicle's actuators
PERIOD = 0.1
JITTER, LOSS = 0.08, 0.05
MAX_BRAKING = 4.0  # [m/s2]
CUT_AFTER = (3.0, 12.0)  # [s] of an episode


def exported(agent: str, folder: Path) -> Path:
    """Export a committed agent."""
    file = folder / f"{agent}.onnx"
    if not file.is_file():
        kwargs = [f"{key}:{value}" for key, value in AGENTS[agent].items()]
        command = [sys.executable, "-m", "sb3_chac", "export", str(HERE / "agents" / f"{agent}.zip"), str(file)]
        subprocess.run([*command, *(["--env-kwargs", *kwargs] if kwargs else [])], check=True)
    return file


def compare_exports(out: Path, folder: Path, steps: int) -> None:
    """Compare each agent with ``predict``."""
    from sb3_chac.deploy.export import compare
    from sb3_chac.evaluation.models import find_algorithm, load_model

    done = {row["agent"] for row in lab.read(out / "export.csv")}
    for agent, kwargs in AGENTS.items():
        if agent in done:
            continue
        env = gym.make("SafeDrive-v0", **kwargs)
        path, algo, algorithm = find_algorithm(HERE / "agents" / f"{agent}.zip", None)
        model = load_model(path, algo, algorithm, env)
        result = compare(model, OnnxPolicy(exported(agent, folder)), env, steps, scenarios=list(range(1000, 1200)))
        row = {"agent": agent, "observations": result.steps, "difference": f"{result.difference:.3g}"}
        lab.append(out / "export.csv", row | {"other_source": result.other_source})


COLD = """
import sys, time
start = time.perf_counter()
from sb3_chac.deploy.runtime import Runtime
import numpy as np
runtime = Runtime(sys.argv[1], warm_up=0)
runtime.decide(np.zeros(runtime.policy.metadata.inputs[0].shape, np.float32))
ready = time.perf_counter() - start
# The peak of this program alone: ru_maxrss keeps that of the process that started it (Linux)
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(ready, int(status["VmHWM"].split()[0]) / 1024)
"""


def measure_latency(out: Path, folder: Path, decisions: int) -> None:
    """Time the runtime (policy and gate) in wall and CPU time, its start and its memory."""
    from sb3_chac.evaluation.models import find_algorithm, load_model

    for agent in ("chac-SafeDrive-v0", "sac-SafeDrive-v0"):
        file = exported(agent, folder)
        env = gym.make("SafeDrive-v0", **AGENTS[agent])
        path, algo, algorithm = find_algorithm(HERE / "agents" / f"{agent}.zip", None)
        model = load_model(path, algo, algorithm, env)
        seen = [env.reset(options={"scenario": 1000 + k})[0] for k in range(50)]
        runtime = Runtime(file)
        functions: dict[str, Callable[[Any], Any]] = {
            "runtime": runtime.decide,
            "predict": lambda observation, model=model: model.predict(observation, deterministic=True),
        }
        for name, function in functions.items():
            for observation in seen:
                function(observation)
            gc.collect()
            gc.freeze()
            gc.disable()
            wall, cpu = [], []
            for k in range(decisions):
                start = time.perf_counter(), time.thread_time()
                function(seen[k % len(seen)])
                wall.append(time.perf_counter() - start[0])
                cpu.append(time.thread_time() - start[1])
            gc.enable()
            gc.unfreeze()
            row: dict[str, Any] = {"agent": agent, "what": name, "decisions": decisions}
            for kind, values in (("wall", wall), ("cpu", cpu)):
                row |= {f"{kind}_{q}_ms": f"{1e3 * np.quantile(values, q / 100):.3f}" for q in (50, 99, 99.9)}
            starts = [cold_start(file) for _ in range(3)] if name == "runtime" else []
            row["cold_start_s"] = f"{min(start[0] for start in starts):.3f}" if starts else ""
            row["memory_mib"] = f"{max(start[1] for start in starts):.0f}" if starts else ""
            row |= {"processor": processor(), "load": f"{load():.1f}"}
            lab.append(out / "latency.csv", row)


def cold_start(file: Path) -> tuple[float, float]:
    """Return [s] until a fresh process has decided once, and its memory [MiB]."""
    output = subprocess.run([sys.executable, "-c", COLD, file], capture_output=True, text=True, check=True).stdout
    seconds, memory = map(float, output.split())
    return seconds, memory


def processor() -> str:
    """Return the name of the processor."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.is_file() else []
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())


def load() -> float:
    """Return how many processes want a core, over the last minute."""
    file = Path("/proc/loadavg")
    return float(file.read_text().split()[0]) if file.is_file() else float("nan")


class LinkedDrive(SafeDriveEnv):
    """
    SafeDrive whose actuators get an action every 10 ms from the vehicle's end of a simulated link, whatever ``step`` is given.
    """

    def connect(self, policy: OnnxPolicy, rng: np.random.Generator, copies: int) -> None:
        """Set up both ends and the link between them."""
        self.now = 100.0
        self.there, self.back = (Channel(rng, jitter=JITTER, loss=LOSS) for _ in range(2))
        sockets = SimulatedSocket(self.there, self.back, self.clock), SimulatedSocket(self.back, self.there, self.clock)
        self.link = VehicleLink(policy.metadata, SimulatedSocket.PEER, copies=copies, sock=sockets[0])
        self.server = PolicyServer(Runtime(policy, clock=self.clock, warm_up=0), sockets[1], PERIOD, copies)
        self.cut_at = np.inf
        self.since_cut: list[tuple[float, float, State]] = []  # time, speed and state
        self.ticks: list[State] = []

    def clock(self) -> float:
        """Return the simulated time [s]."""
        return self.now

    def _move(self, action: np.ndarray) -> np.ndarray:
        for _ in range(round(PERIOD / TICK)):
            if self.now >= self.cut_at:
                self.there.cut()
                self.back.cut()
            packet = self.server.receive()
            if packet is not None:
                self.server.answer(packet, self.now)
            decision = self.link.step(self.now)
            self.ticks.append(decision.state)
            if self.now >= self.cut_at:
                self.since_cut.append((self.now, self.ego.speed, decision.state))
            self.ego.control(*decision.action)
            self.ego.step(TICK)
            self.now += TICK
        return np.array(decision.action)


class DirectDrive(SafeDriveEnv):
    """SafeDrive with the same steps of integration, without a link."""

    def _move(self, action: np.ndarray) -> np.ndarray:
        for _ in range(round(PERIOD / TICK)):
            self.ego.control(*action)
            self.ego.step(TICK)
        return action


def drive(env: SafeDriveEnv, policy: OnnxPolicy, scenario: int, copies: int) -> Iterator[dict[str, Any]]:
    """Drive one map; copies 0 is without a link. Yields the info of each step."""
    observation, _ = env.reset(seed=0, options={"scenario": scenario})
    if isinstance(env, LinkedDrive):
        env.connect(policy, np.random.default_rng([scenario, copies]), copies)
    done, flags = False, Flag.START
    while not done:
        if isinstance(env, LinkedDrive):
            env.link.observe(observation, env.now, flags)
            action, flags = np.zeros(2), Flag.NONE
        else:
            action = policy(observation).action
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        yield info


def drive_maps(out: Path, folder: Path, maps: int) -> None:
    """Drive the maps directly, and over the link with each packet sent once and twice."""
    policy = OnnxPolicy(exported(DRIVER, folder))
    done = {(row["copies"], row["scenario"]) for row in lab.read(out / "link.csv")}
    for scenario in range(1000, 1000 + maps):
        for copies in (0, 2, 1):
            if (str(copies), str(scenario)) in done:
                continue
            env = (LinkedDrive if copies else DirectDrive)(**AGENTS[DRIVER])
            steps, cost = 0, 0.0
            for info in drive(env, policy, scenario, copies):
                steps, cost = steps + 1, cost + info["cost"]
            row = {"copies": copies, "scenario": scenario, "success": int(info["is_success"]), "cost": cost, "steps": steps}
            ticks = env.ticks if isinstance(env, LinkedDrive) else [State.NOMINAL]
            row |= {state.name.lower(): f"{ticks.count(state) / len(ticks):.4f}" for state in State}
            lab.append(out / "link.csv", row | {"out_of_road": int(info["out_of_road"])})


def cut_links(out: Path, folder: Path, cuts: int) -> None:
    """Cut the link at a random time of a drive and wait until the vehicle stands."""
    policy = OnnxPolicy(exported(DRIVER, folder))
    done = {row["cut"] for row in lab.read(out / "cuts.csv")}
    for number in range(cuts):
        if str(number) in done:
            continue
        rng = np.random.default_rng([number, 28])
        env = LinkedDrive(traffic_density=0.0, obstacle_density=0.0, **AGENTS[DRIVER])
        after = rng.uniform(*CUT_AFTER)
        drives = drive(env, policy, 1000 + number % 200, 2)
        info = next(drives)
        env.cut_at = 100.0 + after
        for step in drives:
            info = step
            if env.since_cut and env.ego.speed == 0:
                break
        moments = env.since_cut
        row: dict[str, Any] = {"cut": number, "scenario": env.scenario, "after_s": f"{after:.2f}"}
        if not moments:  # it had arrived
            lab.append(out / "cuts.csv", row | dict.fromkeys(CUT_COLUMNS, ""))
            continue
        speed = moments[0][1]
        braked = next((moment for moment in moments if moment[2] == State.BRAKE), moments[-1])
        distance = sum(moment[1] for moment in moments) * TICK
        stopping = [moment[0] for moment in moments if moment[1] > 0]
        row |= {
            "speed": f"{speed:.2f}",
            "brakes_after_s": f"{braked[0] - env.cut_at:.3f}",
            "speed_then": f"{braked[1]:.2f}",
            "stands_after_s": f"{(stopping or [env.cut_at])[-1] + TICK - env.cut_at:.3f}",
            "distance_m": f"{distance:.2f}",
            "allowed_m": f"{speed**2 / (2 * MAX_BRAKING) + 0.3 * speed:.2f}",
            "stands": int(env.ego.speed == 0),
            "out_of_road": int(info["out_of_road"]),
            "arrived": int(info["is_success"]),
        }
        lab.append(out / "cuts.csv", row)


CUT_COLUMNS = (
    "speed", "brakes_after_s", "speed_then", "stands_after_s", "distance_m", "allowed_m", "stands", "out_of_road", "arrived",
)  # fmt: skip


def report(out: Path) -> None:
    """Print what the CSVs hold."""
    for row in lab.read(out / "export.csv"):
        print(f"{row['agent']}: {row['observations']} observations, differences up to {row['difference']}, "
              f"another policy drives in {row['other_source']}")  # fmt: skip
    for row in lab.read(out / "latency.csv"):
        print(", ".join(f"{key} {value}" for key, value in row.items() if value))
    rows = lab.read(out / "link.csv")
    for copies in sorted({row["copies"] for row in rows}):
        chosen = [row for row in rows if row["copies"] == copies]
        figures = {key: np.mean([float(row[key]) for row in chosen]) for key in ("success", "cost", "steps", "hold", "brake")}
        print(f"copies {copies}: {len(chosen)} maps, " + ", ".join(f"{key} {value:.3f}" for key, value in figures.items()))
    rows = [row for row in lab.read(out / "cuts.csv") if row["speed"]]
    if rows:
        values = {key: np.array([float(row[key]) for row in rows]) for key in CUT_COLUMNS}
        within = values["distance_m"] <= values["allowed_m"] + 1e-9
        print(f"{len(rows)} cuts: brakes after {values['brakes_after_s'].max():.3f} s at most")
        print(f"  stands within its braking distance and .3 s {int(within.sum())} times")
        print(f"  left the road {int(values['out_of_road'].sum())} times")


def main() -> None:
    """Run one of the commands."""
    parser = lab.make_parser(__doc__, ("export", "latency", "link", "cuts", "report"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "deploy")
    parser.add_argument("--policies", type=Path, default=Path("logs/deploy"), help="folder of the exported agents")
    parser.add_argument("-n", type=int, help="observations, decisions, maps or cuts")
    args = parser.parse_args()
    if args.command == "report":
        report(args.out)
        return
    jobs = {
        "export": (compare_exports, 10_000),
        "latency": (measure_latency, 10_000),
        "link": (drive_maps, 200),
        "cuts": (cut_links, 200),
    }
    function, n = jobs[args.command]
    args.policies.mkdir(parents=True, exist_ok=True)
    function(args.out, args.policies, args.n or n)
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_utime:.0f} s of CPU time")


if __name__ == "__main__":
    main()
