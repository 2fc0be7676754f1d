"""The paper's Table 1, and the ablation of C-HAC: every method, trained by RL-Zoo3 and driven on maps that it has not seen.

    python benchmarks/suite.py run --suite table1 --seeds 3 --jobs 2      # stop it at any time, run it again, it goes on
    python benchmarks/suite.py run --suite table1 --scale 0.1             # all budgets a tenth
    python benchmarks/suite.py run --suite table1-metadrive --rows dpvp chac
    python benchmarks/suite.py run --suite table1 --ray 127.0.0.1:6379    # on a Ray cluster (pip install "ray>=2.50")
    python benchmarks/suite.py report --suite table1 --scale 0.1          # RESULTS.md and pictures from the CSVs

Budgets and hyperparameters are those of hyperparams/<algo>.yml. Each job is `rl_zoo3 train` with checkpoints, then one
deterministic episode on each of the maps 1000-1049, without the human. Its results go to
benchmarks/results/<suite>-<scale>/<row>-<seed>/ when it is done; checkpoints and models to --work, which is not committed.
"""

import argparse
import signal
import sys
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from types import FrameType

import lab
import suite_job
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from suite_job import Job, Outcome, Row

HERE = Path(__file__).parent
SUITES = {"table1": "SafeDrive-v0", "table1-metadrive": "MetaDriveSafety-v0"}
ROWS = (
    Row("sac", "SAC", "sac"),
    Row("ppo", "PPO", "ppo"),
    Row("sac_lag", "SAC-Lag", "sac_lag"),
    Row("ppo_lag", "PPO-Lag", "ppo_lag"),
    Row("dsac", "DSAC", "dsac"),
    Row("human", "Human demonstration", ""),
    Row("cql", "CQL", "cql", from_demonstrations=True),
    Row("bc", "BC", "bc", from_demonstrations=True),
    Row("gail", "GAIL", "gail", from_demonstrations=True),
    Row("hg_dagger", "HG-DAgger", "hg_dagger"),
    Row("iwr", "IWR", "iwr"),
    Row("pvp", "PVP", "pvp"),
    Row("dpvp", "D-PVP", "dpvp"),
    Row("chac", "C-HAC", "chac"),
    Row("chac-no-confidence", "C-HAC, no confidence", "chac", {"delta": 0.5}),
    Row("chac-no-share", "C-HAC, no share", "chac", {"shared_control": False}),
)
# CPU milliseconds of one step of the training, roughly: only the time left depends on it
COST_OF_STEP = {"sac": 11, "sac_lag": 17, "dsac": 14, "cql": 35, "bc": 2, "pvp": 8, "dpvp": 10, "chac": 14}
COST_OF_OTHER_STEPS, COST_OF_TEST = 1.5, 60_000
POLL = 2.0  # [s]
RETRIES = 5  # of a job whose worker on the Ray cluster died
UNFINISHED = "unfinished"


class Results:
    """
    The CSVs of the jobs that are done.

    :param folder: of the suite
    :param take_outdated: whether those made with other hyperparameters than today's count as done
    """

    def __init__(self, folder: Path, take_outdated: bool = False) -> None:
        self.folder, self.take_outdated = folder, take_outdated

    def path(self, job: Job) -> Path:
        return self.folder / job.name

    def state(self, job: Job) -> str:
        """
        :return: "" if the job is done, ``UNFINISHED``, or what is the matter with its files and what to do
        """
        try:
            rows = self.read(job, "episodes")
        except FileNotFoundError:
            return UNFINISHED
        except ValueError as error:
            return f"{error} Remove {self.path(job)} and run the suite again: what was trained is not trained again."
        if not self.take_outdated and rows[0]["fingerprint"] != suite_job.fingerprint(job):
            return (
                f"{self.path(job)} was made with other hyperparameters than those that are there now. Restore those, or "
                "remove it and run the suite again."
            )
        return ""

    def read(self, job: Job, kind: str) -> list[dict[str, str]]:
        """
        :param kind: "episodes", "curves" or "drives"
        :raises FileNotFoundError: if there is none
        :raises ValueError: if a line of it is damaged
        """
        path = self.path(job) / f"{kind}.csv"
        if not path.is_file():
            raise FileNotFoundError(path)
        rows = lab.read(path)
        expected = {"method": job.row.name, "seed": str(job.seed)}
        for line, row in enumerate(rows, 2):
            if None in row or None in row.values() or any(row.get(key) != value for key, value in expected.items()):
                raise ValueError(f"{path}, line {line} is damaged.")
        if kind == "episodes" and len(rows) != len(suite_job.TEST_MAPS):
            raise ValueError(f"{path} has {len(rows)} episodes instead of {len(suite_job.TEST_MAPS)}.")
        return rows

    def write(self, job: Job, outcome: Outcome) -> None:
        """All files or none: the folder gets its name when they are on the disk."""
        temporary = self.folder / f".{job.name}"
        temporary.mkdir(parents=True, exist_ok=True)
        for kind, text in outcome.files.items():
            (temporary / f"{kind}.csv").write_text(text)
        temporary.rename(self.path(job))


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """
    :return: seed after seed
    """
    rows = [row for row in ROWS if row.name in args.rows]
    env = SUITES[args.suite]
    return [Job(row, env, seed, args.scale, seed == 0) for seed in range(args.seeds) for row in rows]


def cost(job: Job) -> float:
    """
    :return: expected CPU milliseconds
    """
    if not job.row.algo:
        return COST_OF_TEST
    steps = suite_job.hyperparameters(job)["n_timesteps"]
    return COST_OF_TEST + steps * COST_OF_STEP.get(job.row.algo, COST_OF_OTHER_STEPS)


class Here:
    """
    Runs jobs on this machine.

    :param jobs: how many at once
    """

    def __init__(self, jobs: int) -> None:
        self.pool = ThreadPoolExecutor(jobs)  # of threads that wait for processes

    def submit(self, job: Job, work: Path) -> Future[Outcome]:
        return self.pool.submit(suite_job.run, job, work)

    def share_done(self, job: Job, work: Path) -> float:
        return suite_job.share_done(job, work)

    def close(self) -> None:
        self.pool.shutdown(wait=False, cancel_futures=True)
        suite_job.stop_all()


class OnRay:
    """
    Runs jobs on a Ray cluster, as many at once as it has CPUs. A job whose worker dies is started again, where it can from its
    checkpoint.

    :param address: of the cluster
    """

    def __init__(self, address: str) -> None:
        try:
            import ray
        except ImportError:
            sys.exit('--ray: Ray is not installed. Run: pip install "ray>=2.50"')
        try:
            ray.init(address=address, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            sys.exit(f"--ray: no Ray cluster answers at {address}: {error}\nStart one with 'ray start --head'.")
        for module in (lab, suite_job):  # the workers need not have this folder
            ray.cloudpickle.register_pickle_by_value(module)
        self.ray = ray
        self.remote = ray.remote(num_cpus=1, max_retries=RETRIES)(suite_job.run)

    def submit(self, job: Job, work: Path) -> Future[Outcome]:
        return self.remote.remote(job, work).future()

    def share_done(self, job: Job, work: Path) -> float:
        return 0.0  # known when it is done

    def close(self) -> None:
        self.ray.shutdown()


class Stopped(BaseException):
    """
    Raised in the main thread.

    :param number: of the signal
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def stop(number: int, frame: FrameType | None) -> None:
    """The second signal does what it does elsewhere."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    raise Stopped(number)


def run(args: argparse.Namespace) -> None:
    """Does what is not done yet; a job that fails does not stop the others."""
    results = Results(args.results)
    states = [(job, results.state(job)) for job in jobs_of(args)]
    todo = [job for job, state in states if state == UNFINISHED]
    left_alone = [state for _, state in states if state not in ("", UNFINISHED)]
    for message in left_alone:
        print(f"Left alone: {message}")
    print(f"{len(states)} jobs: {len(states) - len(todo) - len(left_alone)} done, {len(todo)} to do", flush=True)
    if not todo:
        return
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    runner = OnRay(args.ray) if args.ray else Here(args.jobs)
    failures = []
    columns = [TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()]
    columns += [TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()]
    try:
        with Progress(*columns, speed_estimate_period=3600) as progress:
            bar = progress.add_task("", total=sum(map(cost, todo)))
            futures = {runner.submit(job, args.work): job for job in todo}
            done = 0.0
            while futures:
                for future in wait(futures, timeout=POLL, return_when=FIRST_COMPLETED).done:
                    job = futures.pop(future)
                    done += cost(job)
                    try:
                        keep(job, future.result(), results, args.work)
                        progress.print(f"{job.name}: done")
                    except Exception as error:  # of any kind: the others go on
                        failures.append(f"{job.name}: {str(error).splitlines()[0]}")
                        progress.print(f"{job.name} failed: {error}", markup=False)
                share = sum(cost(job) * runner.share_done(job, args.work) for job in futures.values())
                progress.update(bar, completed=done + share, description=f"{len(todo) - len(futures)} of {len(todo)} jobs")
    except Stopped as stopped:
        runner.close()
        print(f"Stopped by {stopped}; the same command goes on from the checkpoints.", file=sys.stderr)
        sys.exit(128 + stopped.number)
    finally:
        runner.close()
    if failures:
        print(f"\n{len(failures)} of {len(todo)} jobs failed. The same command tries them again, from their checkpoints:")
        print("\n".join(failures))
        sys.exit(1)


def keep(job: Job, outcome: Outcome, results: Results, work: Path) -> None:
    """
    :raises OSError: if it cannot be written
    """
    if outcome.model:
        models = work / "models"
        models.mkdir(exist_ok=True)
        (models / f"{job.name}.zip").write_bytes(outcome.model)
    results.write(job, outcome)


def report(args: argparse.Namespace) -> None:
    import suite_report

    suite_report.write(args.suite, args.scale, jobs_of(args), Results(args.results, args.outdated))


if __name__ == "__main__":
    parser = lab.make_parser(__doc__, ["run", "report"])
    parser.add_argument("--suite", choices=SUITES, default="table1")
    names = [row.name for row in ROWS]
    parser.add_argument("--rows", nargs="+", choices=names, default=names, metavar="ROW", help=f"of {', '.join(names)}")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="seeds 0 to N - 1 (default: %(default)s)")
    parser.add_argument("--scale", type=float, default=1.0, help="factor of all budgets (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=2, metavar="N", help="how many at once, one thread each (default: %(default)s)"
    )
    parser.add_argument("--ray", metavar="ADDRESS", help="run them on this Ray cluster, as many at once as it has CPUs")
    parser.add_argument(
        "--outdated", action="store_true", help="report also what was made with other hyperparameters than today's"
    )
    parser.add_argument("--results", type=Path, help="default: benchmarks/results/<suite>-<scale>")
    parser.add_argument("--work", type=Path, help="default: benchmarks/models/<suite>-<scale>")
    arguments = parser.parse_args()
    for option, is_good in (("seeds", arguments.seeds > 0), ("scale", 0 < arguments.scale <= 1), ("jobs", arguments.jobs > 0)):
        if not is_good:
            parser.error(f"--{option} {getattr(arguments, option)} is out of its range")
    folder = f"{arguments.suite}-{arguments.scale:g}"
    arguments.results = (arguments.results or HERE / "results" / folder).absolute()
    arguments.work = (arguments.work or HERE / "models" / folder).absolute()
    {"run": run, "report": report}[arguments.command](arguments)
