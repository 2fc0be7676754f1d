"""The runtime without torch, packets, lossy links, both ends of the link. Clocks are simulated but where it says so."""

import itertools
import json
import math
import re
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shell import wait_until
from stable_baselines3 import SAC

import sb3_chac.envs
from sb3_chac.__main__ import main as sb3_chac
from sb3_chac.common.demonstrations import load_demonstrations
from sb3_chac.deploy.address import bound_socket
from sb3_chac.deploy.export import export
from sb3_chac.deploy.fallback import RouteFallback
from sb3_chac.deploy.gate import Fault, Limits, State
from sb3_chac.deploy.link import Channel, SimulatedSocket
from sb3_chac.deploy.log import DecisionLog, read_log
from sb3_chac.deploy.metadata import Input, Metadata, NotDeployable
from sb3_chac.deploy.policy import OnnxPolicy
from sb3_chac.deploy.runtime import Runtime
from sb3_chac.deploy.server import PolicyServer
from sb3_chac.deploy.udp import (
    MAX_PACKET,
    Commanded,
    Flag,
    Newest,
    Observed,
    RemoteClock,
    VehicleLink,
    pack_action,
    pack_observation,
    unpack_action,
    unpack_observation,
)

# What a computer in a vehicle may not have
BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "stable_baselines3", "sb3_contrib", "rl_zoo3", "gymnasium", "numba", "onnx"):
            raise ImportError(name + " is blocked")
sys.meta_path.insert(0, Blocked())
from sb3_chac.__main__ import main
sys.argv = ["sb3-chac", *sys.argv[1:]]
main()
"""


class Clock:
    """A clock that stands still until it is told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """An untrained SAC for SafeDrive-v0 without corridors."""
    env = gym.make("SafeDrive-v0", corridors=False)
    file = tmp_path_factory.mktemp("policy") / "policy.onnx"
    export(SAC("MlpPolicy", env, buffer_size=10, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu"), file, env=env)
    return file


@pytest.fixture(scope="module")
def policy(file):
    return OnnxPolicy(file)


@pytest.fixture(scope="module")
def observation():
    return gym.make("SafeDrive-v0", corridors=False).reset(options={"scenario": 1000})[0]


# The runtime


def test_runtime_holds_then_brakes_then_goes_on(policy, observation):
    clock = Clock()
    runtime = Runtime(policy, clock=clock)
    assert runtime.decide().decision.state == State.BRAKE

    def steps(n, given):
        states = []
        for _ in range(n):
            clock.now += 0.1
            states.append(runtime.decide(given).decision.state)
        return states

    assert steps(13, observation) == [State.GUIDED] * 10 + [State.NOMINAL] * 3 or runtime.gate.state == State.NOMINAL
    assert steps(5, np.full_like(observation, np.nan))[::4] == [State.HOLD, State.BRAKE]
    assert steps(1, observation) == [State.GUIDED]
    steps(12, observation)
    assert steps(7, None)[::6] == [State.NOMINAL, State.BRAKE]  # a lost packet is none yet
    clock.now += 0.1
    step = runtime.decide(observation[:-1])
    assert "shape" in step.problem and step.decision.faults & Fault.OBSERVATION


def test_runtime_counts_the_age_and_the_time_of_a_decision(policy, observation):
    clock = Clock()
    runtime = Runtime(policy, clock=clock)
    assert runtime.decide(observation, age=0.1).decision.faults == Fault.NONE
    clock.now += 0.1
    assert runtime.decide(observation, age=1.0).decision.faults == Fault.AGE
    assert runtime.decide(observation, age=math.nan).decision.faults & Fault.AGE

    def slow(observed):
        clock.now += 0.2
        return OnnxPolicy.__call__(policy, observed)

    slow.metadata = policy.metadata
    runtime.policy = slow
    clock.now += 0.1
    assert runtime.decide(observation).decision.faults == Fault.DEADLINE
    assert runtime.decide(observation, override=True).decision.state == State.HUMAN


# Packets

INPUTS = (Input("camera", (2, 3), "uint8"), Input("speed", (2,), "float32"))
SEEN = {"camera": np.arange(6, dtype=np.uint8).reshape(2, 3), "speed": np.array([1.5, -2.0], np.float32)}
PACKET = Observed(7, 8, Flag.START | Flag.REWARD, 9.5, SEEN, (0.25, -1.0), 1.5)


def test_packets_arrive_as_they_were_sent():
    told = unpack_observation(pack_observation(PACKET, INPUTS), INPUTS)
    assert told.flags == PACKET.flags | Flag.EXECUTED and told.executed == PACKET.executed and math.isnan(told.cost)
    assert all((told.observation[key] == SEEN[key]).all() for key in SEEN) and told[:2] == (7, 8) and told.reward == 1.5
    command = Commanded(1, 2, 3, 4.5, State.HOLD, Fault.AGE | Fault.ACTION, (0.5, -0.5), False, True, 0.75, 0.25)
    assert unpack_action(pack_action(command)) == command
    nobody = unpack_action(pack_action(command._replace(self_drives=None, engaged=True)))
    assert nobody.self_drives is None and nobody.engaged


@given(st.binary(max_size=200), st.integers(0, 60), st.integers(1, 255))
@settings(max_examples=200, derandomize=True, suppress_health_check=list(HealthCheck))
def test_what_is_not_intact_is_dropped(noise, place, change):
    assert unpack_observation(noise, INPUTS) is None and unpack_action(noise) is None
    command = pack_action(Commanded(1, 2, 3, 4.5, State.HOLD, Fault.AGE, (0.5, -0.5)))
    for data in (pack_observation(PACKET, INPUTS), command):
        broken = bytearray(data)
        broken[place % len(data)] ^= change
        assert unpack_observation(bytes(broken), INPUTS) is None and unpack_action(bytes(broken)) is None
        assert (
            unpack_observation(data[: place % len(data)], INPUTS) is None and unpack_action(data[: place % len(data)]) is None
        )


def test_another_policy_s_observations_are_dropped():
    assert unpack_observation(pack_observation(PACKET, INPUTS), INPUTS[:1]) is None


def test_an_observation_that_fits_no_packet_is_named():
    big = (Input("", (MAX_PACKET,), "uint8"),)
    with pytest.raises(NotDeployable, match="does not fit"):
        pack_observation(Observed(0, 0, Flag.NONE, 0.0, np.zeros(MAX_PACKET, np.uint8)), big)
    with pytest.raises(NotDeployable, match="shape"):
        pack_observation(PACKET, (Input("speed", (3,), "float32"),))


def test_copies_and_old_packets_are_dropped():
    newest = Newest()
    told = [newest.is_new(1, k) for k in (0, 0, 2, 1, 2, 3)]
    assert told == [True, False, True, False, False, True]
    assert newest.is_new(2, 0) and not newest.is_new(1, 9) and newest.is_new(2, 1)  # 1 was started again as 2


def test_age_without_a_common_clock():
    clock = RemoteClock()
    assert clock.age(1000.0, 5.0) == 0.0
    assert clock.age(1000.1, 5.15) == pytest.approx(0.05, abs=1e-4)
    assert clock.age(1000.2, 5.15) == 0.0  # faster than all before
    assert math.isnan(clock.age(math.nan, 5.2))


# Both ends


class Rehearsal:
    """Vehicle and policy at both ends of a simulated link, in steps of 10 ms; an observation every 100 ms."""

    def __init__(self, policy, observation, copies=2, log=None, **channel):
        self.clock, rng = Clock(), np.random.default_rng(0)
        self.there, self.back = Channel(rng, **channel), Channel(rng, **channel)
        self.vehicle = VehicleLink(
            policy.metadata, SimulatedSocket.PEER, copies=copies, sock=SimulatedSocket(self.there, self.back, self.clock)
        )
        sock = SimulatedSocket(self.back, self.there, self.clock)
        self.server = PolicyServer(Runtime(policy, clock=self.clock, warm_up=0), sock, 0.1, copies, log=log)
        self.observation, self.ticks = observation, 0

    def run(self, seconds, **told):
        decisions = []
        for _ in range(round(seconds * 100)):
            if self.ticks % 10 == 0:
                flags = Flag.START if self.ticks == 0 else Flag.NONE
                self.vehicle.observe(self.observation, self.clock.now, flags, self.vehicle.gate.action, reward=1.0, cost=0.0)
            packet = self.server.receive()
            if packet is not None:
                self.server.answer(packet, self.clock.now)
            decisions.append(self.vehicle.step(self.clock.now, **told))
            self.ticks += 1
            self.clock.now += 0.01
        return decisions


def test_a_link_without_faults(policy, observation):
    rehearsal = Rehearsal(policy, observation)
    rehearsal.run(3)
    decisions = rehearsal.run(1)
    wanted = np.tile(policy(observation).action, (100, 1))
    assert {decision.state for decision in decisions} <= {State.NOMINAL, State.HOLD}
    steering = np.array([decision.action[0] for decision in decisions])
    assert np.allclose(steering, wanted[:, 0], atol=1e-6)
    assert rehearsal.server.states["NOMINAL"] > 10


@pytest.mark.parametrize("seed", range(5))
def test_a_cut_brakes_within_three_tenths_of_a_second(policy, observation, seed):
    rehearsal = Rehearsal(policy, observation, jitter=0.08, loss=0.05)
    rehearsal.there.rng = rehearsal.back.rng = np.random.default_rng(seed)
    before = rehearsal.run(3 + seed / 50)
    assert sum(decision.state == State.BRAKE for decision in before[100:]) < 60
    rehearsal.there.cut()
    rehearsal.back.cut()
    after = rehearsal.run(2.5)
    assert all(decision.state == State.BRAKE and decision.action[1] == -1 for decision in after[20:])
    assert after[-1].faults & Fault.LATCHED


def test_a_person_in_the_vehicle_wins_at_once_and_the_policy_hears_of_it(policy, observation):
    rehearsal = Rehearsal(policy, observation)
    rehearsal.run(3)
    decisions = rehearsal.run(0.5, override=True, human_action=(0.3, 0.1))
    assert {(decision.state, decision.action) for decision in decisions} == {(State.HUMAN, (0.3, 0.1))}
    assert rehearsal.server.runtime.gate.state == State.HUMAN
    assert {decision.state for decision in rehearsal.run(0.5)} <= {State.GUIDED, State.NOMINAL, State.HOLD}


def test_the_server_listens_to_one_vehicle_only(policy, observation):
    rehearsal = Rehearsal(policy, observation)
    rehearsal.server.allowed = "192.0.2.1"
    rehearsal.run(0.5)
    assert rehearsal.server.sequence == 0


def test_channels_lose_delay_and_end():
    channel = Channel(np.random.default_rng(0), latency=0.1, jitter=0.2, loss=0.25)
    for number in range(1000):
        channel.put(number, 0.0)
    assert channel.ready(0.0999) == []
    half = channel.ready(0.2)
    rest = channel.ready(0.3)
    assert 650 < len(half) + len(rest) < 850 and 300 < len(half) < 450 and half != sorted(half)
    channel.put(0, 1.0)
    channel.cut()
    channel.put(1, 1.0)
    assert channel.ready(9.0) == []
    with pytest.raises(NotDeployable, match="loss"):
        Channel(np.random.default_rng(0), loss=1.1)


# The fallback


@pytest.mark.parametrize("scenario", [1000, 1003, 1006, 1010])
@pytest.mark.parametrize("sees", [True, False])
def test_the_fallback_stops_on_the_road(scenario, sees):
    """With the observations of the vehicle, and by dead reckoning alone."""
    env = gym.make("SafeDrive-v0", corridors=False, traffic_density=0.0, obstacle_density=0.0).unwrapped
    driver, fallback, stops = env.scripted_driver("scripted-ideal"), RouteFallback(), 0
    for cut in (60, 90, 130):
        observation, _ = env.reset(seed=0, options={"scenario": scenario})
        driver.reset(0)
        done, steps = False, 0
        while not done and (steps < cut or env.ego.speed > 0):
            if steps <= cut or sees:
                fallback.observe(observation)
            action = driver(observation) if steps < cut else np.array(fallback())
            observation, _, terminated, truncated, info = env.step(action)
            fallback.advance(action, 0.1)
            done, steps = terminated or truncated, steps + 1
        assert not info["out_of_road"]
        stops += env.ego.speed == 0
    assert stops >= 2  # it may have arrived


def test_only_known_observations_have_a_fallback(policy):
    assert RouteFallback.of(policy.metadata) is not None and RouteFallback()() is None
    assert RouteFallback.of(Metadata((), [-1.0], [1.0])) is None


# Log, dataset, command


def test_a_log_becomes_a_dataset(policy, observation, tmp_path, monkeypatch, capsys):
    log = tmp_path / "drive.jsonl"
    with DecisionLog(log, policy.metadata) as writer:
        rehearsal = Rehearsal(policy, observation, log=writer)
        rehearsal.run(1)
        rehearsal.run(0.5, override=True, human_action=(0.3, 0.1))
        rehearsal.run(0.5)
        rehearsal.there.cut()
        rehearsal.run(0.5)
        rehearsal.there.is_cut = False
        rehearsal.run(0.5)
    with log.open("a") as stream:
        stream.write('{"half a li')
    assert read_log(log)[0] == policy.metadata
    command = [
        "sb3-chac",
        "demos",
        "from-log",
        str(log),
        "--dataset",
        f"{tmp_path}/drive-v0",
        "--env-kwargs",
        "corridors:False",
    ]
    monkeypatch.setattr("sys.argv", command)
    sb3_chac()
    assert "2 episodes, 23 steps" in capsys.readouterr().out
    dataset = load_demonstrations(tmp_path / "drive-v0")
    assert np.allclose(dataset.observations, observation) and dataset.takeovers.sum() == 5
    assert np.allclose(dataset.actions[dataset.takeovers], [0.3, 0.1])
    assert np.allclose(dataset.novice_actions, policy(observation).action) and (dataset.rewards == 1).all()
    monkeypatch.setattr("sys.argv", command[:-2])
    with pytest.raises(SystemExit, match="2"):
        sb3_chac()
    assert "355" in capsys.readouterr().err


def test_the_command_runs_without_torch(file, policy, observation, tmp_path):
    """Real sockets and a real clock, which nothing asserted depends on."""
    command = ["run", str(file), "--listen", "127.0.0.1:0", "--steps", "20", "--log", str(tmp_path / "log.jsonl")]
    process = subprocess.Popen([sys.executable, "-c", BLOCKED, *command], stdout=subprocess.PIPE, text=True)
    try:
        lines = [process.stdout.readline() for _ in range(2)]
        ready = re.match(r"Ready on 127\.0\.0\.1:(\d+) ", lines[1])
        assert ready, lines
        link = VehicleLink(policy.metadata, ("127.0.0.1", int(ready[1])))
        ticks = itertools.count()

        def has_ended():
            now = 0.1 * next(ticks)
            link.observe(observation, now)
            link.step(now)
            return process.poll() is not None

        wait_until(has_ended, pause=0.02)
        assert process.returncode == 0 and "20 decisions" in process.stdout.read()
        assert link.command is not None
        link.close()
    finally:
        process.kill()
        process.stdout.close()
    lines = list(read_log(tmp_path / "log.jsonl")[1])
    assert len(lines) == 20
    assert all(np.allclose(line["proposed"], policy(observation).action, atol=1e-6) for line in lines)


@pytest.mark.parametrize(
    "wrong, named",
    [
        (["--listen", "nonsense"], "--listen"),
        (["--listen", "127.0.0.1:-1"], "--listen must be HOST:PORT"),
        (["--listen", "nohost.invalid:1"], "--listen: no host 'nohost.invalid'"),
        (["--listen", "203.0.113.1:5600"], "--listen: cannot listen at 203.0.113.1:5600"),
        (["--vehicle", "nohost.invalid"], "--vehicle: no host 'nohost.invalid'"),
        (["--copies", "0"], "--copies"),
        (["--rate", "0"], "--rate"),
        (["--brake", "hold,fast"], "--brake"),
        (["--brake", "hold"], "brake"),
        (["--deadline", "nan"], "deadline"),
        (["--log", "nowhere/log.jsonl"], "--log nowhere"),
        (["--log", "there.jsonl"], "there already"),
    ],
)
def test_mistakes_on_the_command_line(file, wrong, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.jsonl").touch()
    monkeypatch.setattr("sys.argv", ["sb3-chac", "run", str(file), "--listen", "127.0.0.1:0", *wrong])
    with pytest.raises(SystemExit, match="2"):
        sb3_chac()
    assert named in (error := capsys.readouterr().err) and error.count("\n") == 1


def test_a_port_in_use_is_named_with_the_remedy():
    with bound_socket("--listen", ("127.0.0.1", 0)) as first:
        address = first.getsockname()
        with pytest.raises(NotDeployable, match=rf"^--listen: cannot listen at 127.0.0.1:{address[1]} .*choose another port"):
            bound_socket("--listen", address)


@pytest.mark.parametrize(
    "address, named", [(("nohost.invalid", 5600), "no host"), (("127.0.0.1", 99999), "must be"), (("a", "b"), "must be")]
)
def test_the_address_of_a_policy_is_checked_before_the_drive(policy, address, named):
    with pytest.raises(NotDeployable, match=f"^policy_address:? {named}"):
        VehicleLink(policy.metadata, address)


def test_a_log_of_something_else_is_refused(tmp_path):
    (tmp_path / "other.jsonl").write_text(json.dumps({"a": 1}) + "\n")
    with pytest.raises(NotDeployable, match="not a log"):
        read_log(tmp_path / "other.jsonl")
    assert Limits.of(Metadata((), [0.0], [1.0]), brake=[0.0]).max_rate == (10.0,)
