"""How many mistakes end in one clear error, and what is left after kills, a full disk and files that try to run code.

    python benchmarks/refusals.py                          # everything
    python benchmarks/refusals.py --only commands zoo      # some of: commands, zoo, arguments, kills, data

Counts go to benchmarks/results/refusals: a CSV for each part, with a row for each attempt, and table.md.

- commands: command lines of our own commands. Clear is: exit code 2, one line, which names the option or the value.
- zoo: command lines and yaml files of `rl_zoo3 train` with our algorithms, by the same measure.
- arguments: NaN, inf, text, a list, -1, 0, True, an integer of 400 digits and others, for each argument of each constructor
  that cannot be that. Clear is: a ValueError that names the argument, before anything is built.
- kills: see benchmarks/chaos.py; one row a kill, and the full disk.
- data: files that name code (tests/test_untrusted_data.py), one row a file. Clear is: nothing of it ran.
"""

import argparse
import contextlib
import csv
import importlib
import io
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results" / "refusals"
CPU_LIMIT = 120  # [s] of processor time, only against hanging for ever
ALGORITHMS = ("dsac", "pvp", "dpvp", "chac", "sac_lag", "ppo_lag", "bc", "cql", "gail", "hg_dagger", "iwr")
ENV = "Pendulum-v1"
ASKED = {"commands": 0.97, "zoo": 0.90, "arguments": 0.97, "kills": 1.0, "data": 1.0}
WORDS = {
    "commands": "our command lines with one clear error",
    "zoo": "`rl_zoo3 train` lines with one clear error",
    "arguments": "values of constructors' arguments named",
    "kills": "kills, and a full disk, survived",
    "data": "files that name code of which none ran",
}


class Attempt(NamedTuple):
    """What was tried, whether it ended as it should, and what was said."""

    tried: str
    clear: bool
    said: str


# Own commands: a line that is right but for the options, then options with values that cannot be and what must be named
NOT_COUNTS = ("0", "-1", "1.5", "many", "nan", "", "9" * 400)
NOT_FILES = ("nowhere/file", "file/in/it", "nowhere/" + "x" * 300)
NOT_PAIRS = ("horizon", ":", "horizon:", "horizon:(", "nonsense:1", "horizon:text", "horizon:0")
NOT_ENVS = ("Nowhere-v0", "nowhere:Env-v0", "", ":", "CartPole-v1:", "a" * 300, "os:system")
NOT_NUMBERS = ("0", "-1", "nan", "inf", "many", "")
OWN: dict[str, dict[str, tuple[str, ...]]] = {
    "evaluate --expert scripted --scenarios 1000": {
        "--scenarios": ("10:5", "5,5", "-1", "a:b", "1:2:3", "", "0:1000000000", "1.5", "9" * 5000),
        "--seed": ("-1", "1.5", "many", "nan"),
        "--jobs": NOT_COUNTS[:6],
        "--env": NOT_ENVS,
        "--env-kwargs": NOT_PAIRS,
        "--json": NOT_FILES,
        "--steps": (*NOT_FILES, "steps.txt"),
        "--plot": (*NOT_FILES, "paths.txt"),
        "--video": (*NOT_FILES, "drive.txt"),
        "--video-scenario": ("7", "-1", "many"),
        "--control": ("self", "nonsense"),
        "--expert": ("nobody", "", "os:system"),
        "--nonsense": ("1",),
    },
    "evaluate": {"nowhere.zip": ("",), "file": ("",), ".": ("",), "--algo": ("dsac",)},
    "resume": {"nowhere": ("",), "file": ("",), ".": ("",), "/": ("",), "--nonsense": ("1",)},
    "plot": {"nowhere": ("",), "file": ("",), ".": ("",), "--out": ("a.png",)},
    "export": {"nowhere.zip a.onnx": ("",), "file a.onnx": ("",), "file": ("",)},
    "demos info": {"--dataset": ("nowhere-v0", "", ".", "file", "a/b/c", "no version", "x" * 300)},
    "demos replay": {"--dataset": ("nowhere-v0", "", ".", "file")},
    "demos record --expert scripted --dataset new-v0 --steps 5": {
        "--steps": NOT_COUNTS[:6],
        "--dataset": ("no version", "", "-v0"),
        "--env": NOT_ENVS,
        "--env-kwargs": NOT_PAIRS,
        "--seed": ("-1", "many"),
        "--jobs": NOT_COUNTS[:6],
        "--expert": ("nobody", ""),
        "--novice": ("nowhere.zip", "file"),
        "--rule": ("nonsense", ""),
    },
    "demos": {"nonsense": ("",)},
    "drive --serve 0": {
        "--algo": ("dsac", "nonsense", ""),
        "--env": (*NOT_ENVS, "CartPole-v1", "Pendulum-v1"),
        "--env-kwargs": NOT_PAIRS,
        "-params": ("foo:1", "foo", "gamma:2", "gamma:(", "learning_rate:-1"),
        "--conf-file": ("nowhere.yml", "file"),
        "-n": ("0", "many", "1.5"),
        "--seed": ("many", "99999999999999"),
        "-i": ("nowhere.zip",),
        "--demos": ("nowhere-v0",),
        "--pretrain": ("-1", "many"),
        "--rate": NOT_NUMBERS,
        "--config": ("nowhere.yml", "file"),
        "--tls-key": ("key.pem",),
        "--tls-cert": ("nowhere.pem", "file"),
        "--dataset": ("no version",),
        "--resume": ("nowhere", "file", "."),
        "--recover": ("nowhere", "file", "."),
        "--serve": ("9" * 5000, "many", "-1", "70000", "nowhere.invalid:80", ":"),
    },
    "nonsense": {"": ("",)},
}

# RL-Zoo3: hyperparameters of all algorithms, then of some
BAD: dict[str, tuple[str, ...]] = {
    "gamma": ("2", "'0.9'", "float('nan')"),
    "learning_rate": ("'1e-3'", "-1", "'quick'", "[1]"),
    "batch_size": ("0", "1.5", "True", "'many'"),
    "policy": ("'Nonsense'", "3", "None"),
    "policy_kwargs": ("1", "dict(nonsense=1)", "'dict('", "dict(net_arch=[0])", "dict(net_arch={'foo':[8]})"),
    "n_envs": ("0", "1.5", "'two'"),
    "nonsense": ("1",),
}
BAD_OF: dict[str, dict[str, tuple[str, ...]]] = {
    "dsac": {"train_freq": ("0", "[1,'year']"), "buffer_size": ("-1",), "ent_coef": ("'often'", "-1"), "eta": ("0",)},
    "pvp": {"policy_delay": ("0",), "proxy_value": ("0", "'high'"), "pv_coef": ("-1",), "tau": ("2",)},
    "dpvp": {"average_tau": ("2",), "weight_decay": ("-1",), "bounded_targets": ("3",), "n_steps": ("0",)},
    "chac": {"delta": ("3", "'low'"), "bootstrap": ("'nonsense'",), "switch_after": ("-1",), "prefit_steps": ("1.5",)},
    "sac_lag": {"cost_limit": ("-1",), "pid_kp": ("-1",), "lagrange_max": ("-1",), "target_entropy": ("'low'",)},
    "ppo_lag": {"clip_range": ("'nonsense'", "float('nan')"), "gae_lambda": ("-1",), "n_epochs": ("0",), "pid_tau": ("0",)},
    "bc": {"dataset": ("'nowhere-v0'", "3"), "loss": ("'nonsense'",), "validation_share": ("2",)},
    "cql": {"dataset": ("'nowhere-v0'",), "temperature": ("0",), "n_action_samples": ("0",), "actor_lr": ("-1",)},
    "gail": {"dataset": ("'nowhere-v0'",), "disc_batch_size": ("0",), "gradient_penalty": ("-1",), "clip_range": ("-1",)},
    "hg_dagger": {"loss": ("'nonsense'",), "round_human_steps": ("0",), "n_rounds": ("-1",), "n_epochs": ("0",)},
    "iwr": {"loss": ("'nonsense'",), "warm_up_steps": ("-1",), "weight_decay": ("-1",), "buffer_size": ("0",)},
}
NEED_A_DATASET = ("bc", "cql", "gail")
OPTIONS = (
    *("-n 0", "-n many", "--env Nowhere-v0", "--env-kwargs nonsense:1", "--eval-episodes 0", "--n-eval-envs 0"),
    *("--save-freq -7", "--device nonsense", "--seed text", "--vec-env nonsense", "-i nowhere.zip", "--conf-file nowhere.yml"),
    *("--gym-packages nowhere", "-f file", "-params gamma", "-params gamma:(", "--num-threads 0", "--num-threads 99999999"),
    *("--num-threads many", "--log-interval x", "--verbose x", "--eval-freq x"),
)
FILES = {
    "": "bad.yml",
    "text": "bad.yml",
    "a: [": "bad.yml",
    "Pendulum-v1:": "bad.yml",
    "Pendulum-v1: 3": "bad.yml",
    "Other-v0: {n_timesteps: 10}": ENV,
    "Pendulum-v1: {policy: MlpPolicy}": "n_timesteps",
    "Pendulum-v1: {n_timesteps: 10}": "policy",
    "Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, learning_rate: 1e-3}": "learning_rate",
    "Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, nonsense: 1}": "nonsense",
    "Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, gamma: .nan}": "gamma",
    "Pendulum-v1: {policy: MlpPolicy, n_timesteps: 10, n_envs: 0}": "n_envs",
}


def own_lines() -> Iterator[tuple[list[str], tuple[str, ...]]]:
    """
    :return: arguments, and what may be named: the option or its value
    """
    for base, options in OWN.items():
        for option, values in options.items():
            for value in values:
                given = base.split()
                if option in given and option.startswith("-"):  # in place of the right one
                    position = given.index(option)
                    del given[position : position + 2]
                added = [*option.split(), value] if option.startswith("-") else option.split()
                start = value.partition(":")[0][:40]
                named = (option.lstrip("-"), value[:40], start, *option.split(), base.split()[-1])
                yield [*given, *added], tuple(filter(None, named))


def zoo_lines() -> Iterator[tuple[list[str], tuple[str, ...], str]]:
    """
    :return: arguments, what may be named, and the content of bad.yml
    """
    quick = ["--eval-freq", "-1", "-f", "logs"]
    for algo in ALGORITHMS:
        start = ["train", "--algo", algo, "--env", ENV, *quick]
        for name, values in (BAD | BAD_OF[algo]).items():
            for value in values:
                yield [*start, "-n", "10", "-params", f"{name}:{value}"], (name, "nonsense"), ""
    for algo in ("dsac", "ppo_lag"):
        for option in OPTIONS:
            given = ["train", "--algo", algo, *quick] + ([] if "--env " in option else ["--env", ENV])
            given += [] if option.startswith("-n ") else ["-n", "10"]
            yield (
                [*given, *option.split()],
                (*option.split()[:2], option.split()[0].lstrip("-"), "trained", "gamma", "nonsense"),
                "",
            )
        for content, named in FILES.items():
            yield ["train", "--algo", algo, "--env", ENV, *quick, "--conf-file", "bad.yml"], (named,), content


NOISE = "^usage:|^ |[Ww]arning|episode/s|s/episode"  # what else a command may say


def attempt(arguments: list[str], named: tuple[str, ...], main: Callable[[], None], content: str = "") -> Attempt:
    """
    Runs a command in a copy of this process, in an empty folder but for ``file`` and bad.yml.

    :param named: one of these must be in the line
    """
    tried = " ".join(argument if len(argument) < 80 else f"{argument[:20]}...({len(argument)})" for argument in arguments)
    tried += f"  # {content!r}" if content else ""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as errors:
        Path(folder, "file").write_text("in the way")
        Path(folder, "bad.yml").write_text(content)
        sys.stdout.flush(), sys.stderr.flush()
        child = os.fork()
        if child == 0:
            os.chdir(folder)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(errors.fileno(), 2)
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT, CPU_LIMIT))
            sys.argv = ["sb3-chac", *arguments]
            code = run_to_the_end(main)
            sys.stdout.flush(), sys.stderr.flush()
            os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        errors.seek(0)
        printed = errors.read().replace(folder, ".").replace(str(Path.home()), "~")  # no paths of this machine in the CSV
    # argparse tells how it is used first, and there may be a progress bar
    lines = [line for line in printed.splitlines() if line.strip() and not re.search(NOISE, line)]
    clear = code == 2 and len(lines) == 1 and "Traceback" not in printed and any(word in lines[0] for word in named)
    return Attempt(tried, clear, f"[{code}] " + " / ".join(lines)[-200:])


def run_to_the_end(main: Callable[[], None]) -> int:
    """
    :return: the exit code that the process would have
    """
    try:
        main()
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
            return 1
        return int(ended.code or 0)
    except BaseException:
        import traceback

        traceback.print_exc()
        return 1
    return 0


def warm_up() -> Callable[[], None]:
    """
    :return: our command, with all that it imports at hand for copies of this process
    """
    import gymnasium as gym

    from sb3_chac.__main__ import OWN_COMMANDS, main
    from sb3_chac.zoo import register

    register()
    for module in OWN_COMMANDS.values():
        importlib.import_module(module)
    gym.make("SafeDrive-v0").reset(seed=0)
    gym.make(ENV)
    return main


def commands() -> Iterator[Attempt]:
    main = warm_up()
    for arguments, named in own_lines():
        yield attempt(arguments, named, main)


def zoo() -> Iterator[Attempt]:
    main = warm_up()
    for arguments, named, content in zoo_lines():
        yield attempt(arguments, named, main, content)


def arguments() -> Iterator[Attempt]:
    sys.path.insert(0, str(ROOT / "tests"))
    from test_arguments import OTHERS, OWNERS, VALUES, bad_values, required

    values = VALUES | OTHERS
    for label, owner in OWNERS.items():
        others = required(owner)
        for name, kind, value in bad_values(owner, values):
            with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    owner(**{**others, name: value})
                    said, clear = "taken", False
                except Exception as error:
                    said, clear = f"{type(error).__name__}: {error}", isinstance(error, ValueError) and name in str(error)
            yield Attempt(f"{label}({name}={kind})", clear, said[:200])


def kills() -> Iterator[Attempt]:
    command = [sys.executable, str(Path(__file__).with_name("chaos.py")), "--kills", "5", "--steps", "400"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    stops = [line for line in ran.stdout.splitlines() if re.match("SIG", line)]
    problems = "" if ran.returncode == 0 else ran.stdout[-500:] + ran.stderr[-500:]
    for number, line in enumerate(stops):
        yield Attempt(" ".join(line.split()), f"stop {number}:" not in problems, "")
    yield Attempt("full disk, and all together", not problems, problems.replace("\n", " / "))


def data() -> Iterator[Attempt]:
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "tests/test_untrusted_data.py"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    for name, outcome in re.findall(r"::(\S.*?) (PASSED|FAILED|ERROR)", ran.stdout):
        yield Attempt(name, outcome == "PASSED", "")


PARTS: dict[str, Callable[[], Iterator[Attempt]]] = {
    "commands": commands,
    "zoo": zoo,
    "arguments": arguments,
    "kills": kills,
    "data": data,
}


def table() -> str:
    """
    :return: in Markdown, of all parts that were ever run
    """
    lines = ["| | clear | tried | share | asked |", "|---|---|---|---|---|"]
    for part in PARTS:
        path = RESULTS / f"{part}.csv"
        if path.is_file():
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            clear = sum(row["clear"] == "True" for row in rows)
            share = f"{100 * clear / max(len(rows), 1):.1f} %"
            lines.append(f"| {WORDS[part]} | {clear} | {len(rows)} | {share} | {100 * ASKED[part]:.0f} % |")
    versions = ", ".join(f"{name} {version(name)}" for name in ("stable-baselines3", "rl_zoo3", "gymnasium", "torch"))
    return "\n".join([*lines, "", f"Python {sys.version.split()[0]}, {versions}.", ""])


def main(given: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to try (default: all)")
    args = parser.parse_args(given)
    RESULTS.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.environ["MINARI_DATASETS_PATH"] = datasets = tempfile.mkdtemp()
    warnings.simplefilter("ignore")
    for part in args.only:
        with (RESULTS / f"{part}.csv").open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(Attempt._fields)
            for one in PARTS[part]():
                writer.writerow(one._replace(said=one.said.replace(datasets, "datasets")))
                file.flush()
                if not one.clear:
                    print(f"{part}: {one.tried}\n    {one.said}", flush=True)
    (RESULTS / "table.md").write_text(table())
    print(table())


if __name__ == "__main__":
    main(sys.argv[1:])
