"""What ``make demo`` shows: the progress bar, progress.csv, the curves (``sb3-chac plot``), policies beside each other."""

import csv
import json
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from shell import run
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from test_zoo import ZOO

from sb3_chac import CHAC, DPVP
from sb3_chac.cli.compare import main as compare
from sb3_chac.cli.evaluate import main as evaluate_command
from sb3_chac.cli.plot import draw, join
from sb3_chac.cli.plot import main as plot
from sb3_chac.common.callbacks import CSVProgress, GuidedProgressBar
from sb3_chac.envs.safedrive import SafeDriveEnv
from sb3_chac.evaluation.episodes import Runner, Task
from sb3_chac.evaluation.evaluation import evaluate
from sb3_chac.evaluation.pictures import save_video

SWITCH_AFTER, TOTAL = 150, 300
RUN = Path("logs") / "chac" / "SafeDrive-v0_1"
SMALL_ENV = ["--env-kwargs", "horizon:60", "blocks:2"]
TRAIN = [
    *("--algo", "chac", "--env", "SafeDrive-v0", "-n", str(TOTAL), "--eval-freq", "100", "--eval-episodes", "2"),
    *("-f", "logs", "--seed", "0", "--progress", "--verbose", "0", "--log-interval", "1", *SMALL_ENV),
    *("-params", "learning_starts:50", "buffer_size:1000", "batch_size:32", "policy_kwargs:dict(net_arch=[8])"),
    *(f"switch_after:{SWITCH_AFTER}", "prefit_steps:5", "delta:0.9"),
]


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[Path, str]:
    """A folder with a small run of the demo's command, and what it printed, not to a terminal."""
    folder = tmp_path_factory.mktemp("demo")
    return folder, run(ZOO, "train", *TRAIN, cwd=folder)


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    """A C-HAC model in stage 2 whose two policies differ, for toy_env."""
    model = CHAC("MlpPolicy", "toy_env:ToyDrive-v0", policy_kwargs={"net_arch": [8]}, buffer_size=10, seed=0)
    model.policy.start_stage_2()
    model.policy.averaged_self_actor.mu.bias.data.fill_(9.0)  # full throttle, where it is not sampled
    model.actor.mu.bias.data.fill_(-9.0)  # backwards
    path = tmp_path_factory.mktemp("toy") / "toy.zip"
    model.save(path)
    return path


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_progress_bar_tells_stage_and_takeovers(demo):
    folder, output = demo
    last = [row for row in rows_of(folder / RUN / "progress.csv") if row["takeover/human_steps"]][-1]
    text = " ".join(output.split())
    assert "stage 2, self " in text
    assert f"({float(last['takeover/human_steps']):.0f} steps), cost {float(last['safety/safety_cost']):g}" in text
    assert "Traceback" not in output and "rollout/" not in output


def test_progress_csv(demo):
    folder, _ = demo
    rows = rows_of(folder / RUN / "progress.csv")
    steps = [int(row["time/total_timesteps"]) for row in rows]
    assert steps == sorted(steps) and steps[0] == 0 and steps[-1] == TOTAL
    stages = {int(row["time/total_timesteps"]): row["chac/stage"] for row in rows if row["chac/stage"]}
    assert stages[0] == "1" and stages[TOTAL] == "2"
    assert SWITCH_AFTER < min(step for step, stage in stages.items() if stage == "2") <= SWITCH_AFTER + 2
    logged = [row for row in rows if row["takeover/rate"]]
    assert len(logged) >= 4 and any(row["chac/self_share"] for row in logged)
    for row in logged:
        share = float(row["takeover/human_steps"]) / float(row["time/total_timesteps"])
        assert float(row["takeover/rate"]) == pytest.approx(share)


def test_callbacks_of_algorithms_without_stages(tmp_path):
    """``learn`` called twice, D-PVP; the other outputs of the logger stay."""
    model = DPVP("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, buffer_size=500, learning_starts=500)
    model.set_logger(configure(str(tmp_path / "own"), ["json"]))
    bar, file = GuidedProgressBar(refresh_every=50), CSVProgress(tmp_path / "progress.csv")
    with pytest.warns(UserWarning, match="no human is in the loop"):
        model.learn(210, callback=[bar, file], log_interval=1)
    assert bar.text() == "human 0 % (0 steps)"  # Pendulum measures no cost
    file.on_training_end()  # as RL-Zoo3 may do
    assert len(model.logger.output_formats) == 1 and "takeover/rate" in (tmp_path / "own" / "progress.json").read_text()
    assert [row["time/total_timesteps"] for row in rows_of(file.file)] == ["0", "200", "210"]
    with pytest.warns(UserWarning, match="no human is in the loop"):
        model.learn(10, callback=file, reset_num_timesteps=False)
    assert rows_of(file.file)[0]["time/total_timesteps"] == "210"


def test_plot_from_the_command_line(demo):
    folder, _ = demo
    output = run(sys.executable, "-m", "sb3_chac", "plot", RUN, cwd=folder)
    assert f"Saved {RUN / 'curves.png'}" in output
    picture = imageio.imread(folder / RUN / "curves.png")
    assert picture.shape[0] > 600 and picture.shape[1] > 1200 and picture.std() > 5


def test_what_is_drawn(demo):
    folder, _ = demo
    figure = draw(join([folder / RUN]))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:2] == ["Return", "Success rate"] and len(titles) == 6 and titles[-1] == "Self-learning policy"
    assert all("stage 2" in [text.get_text() for text in axes.texts] for axes in figure.axes)
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_xdata(), [100, 200, 300])
    assert figure.axes[3].lines[0].get_xdata()[-1] == TOTAL


def write_run(folder: Path, steps: list[int], rows: list[str] | None = None, successes: bool = True) -> Path:
    """A run folder with evaluations whose return is their step, and progress.csv with these lines if any."""
    folder.mkdir(parents=True)
    results = np.repeat(np.array(steps, float)[:, None], 2, axis=1)
    more = {"successes": results > 150} if successes else {}
    if steps:
        np.savez(folder / "evaluations.npz", timesteps=steps, results=results, ep_lengths=results, **more)
    if rows is not None:
        header = "chac/stage,time/total_timesteps,takeover/rate,safety/safety_cost"
        (folder / "progress.csv").write_text("\n".join([header, *rows]))
    return folder


def test_resumed_runs_are_joined(tmp_path):
    """The second one began at step 150: what the first one did later is left out."""
    first = write_run(tmp_path / "_1", [100, 200], ["1,0,,", "1,100,0.5,1", ",120,", "2,180,0.4,2", "2,200,0.3"])
    second = write_run(tmp_path / "_2", [200, 300], ["1,150,,1", "1,190,0.45,1", "2,191,,1", "2,300,0.3,5"])
    curves = join([first, second])
    assert curves["return"][:, 0].tolist() == curves["return"][:, 1].tolist() == [100, 200, 300]
    assert curves["takeover/rate"][:, :2].tolist() == [[100, 0.5], [190, 0.45], [300, 0.3]]
    assert curves["safety/safety_cost"][:, 0].tolist() == [100, 150, 190, 191, 300]
    assert {line.get_xdata()[0] for axes in draw(curves).axes for line in axes.lines[1:]} == {191}


def test_panels_without_data_are_left_out(tmp_path):
    only_evaluations = join([write_run(tmp_path / "a", [100], successes=False)])
    assert [axes.get_title(loc="left") for axes in draw(only_evaluations).axes] == ["Return"]
    only_progress = join([write_run(tmp_path / "b", [], ["2,0,,", "2,90,0.5,"])])
    (axes,) = draw(only_progress).axes
    assert axes.get_title(loc="left") == "Takeover rate" and not axes.texts[1:]  # stage 1 is not there


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere"], "There is no folder nowhere"),
        (["empty"], "holds neither evaluations.npz nor progress.csv"),
        (["header"], "header: nothing has been evaluated or logged yet"),
        (["started"], "started: nothing has been evaluated or logged yet"),
        (["broken"], "evaluations.npz cannot be read"),
        (["run", "run"], "begins at step 0: it does not go on"),
        (["run", "--out", "x.txt"], "must end with .png"),
        (["run", "--out", "nowhere/x.png"], "the folder nowhere does not exist"),
    ],
)
def test_errors_of_plot(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    write_run(Path("empty"), [])
    write_run(Path("header"), [], [])
    write_run(Path("started"), [], ["1,0,,"])
    write_run(Path("run"), [100], ["1,0,,"])
    (write_run(Path("broken"), [], []) / "evaluations.npz").write_text("no numpy")
    with pytest.raises(SystemExit) as error:
        plot(arguments)
    printed = capsys.readouterr().err
    assert error.value.code == 2 and message in printed and printed.count("\n") == 1


EVALUATIONS = {"timesteps": [100, 200], "results": np.ones((2, 3)), "successes": np.ones((2, 3), bool)}


@pytest.mark.parametrize(
    "changed",
    [
        {"timesteps": ["100", "200"]},
        {"timesteps": [100, None]},
        {"timesteps": [[100], [200]]},
        {"timesteps": [100, np.nan]},
        {"timesteps": [100, 200j]},
        {"timesteps": 100},
        {"timesteps": [], "results": np.ones((0, 3))},
        {"results": np.full((2, 3), "1.0")},
        {"results": [["good", None], [1, 2]]},
        {"results": np.ones(2)},
        {"results": np.ones((2, 0))},
        {"results": np.ones((3, 3))},
        {"results": np.ones((2, 3, 1))},
        {"results": np.array([[1, 1], [1, np.inf]])},
        {"successes": np.ones(2)},
        {"successes": np.full((2, 3), "yes")},
    ],
    ids=str,
)
def test_evaluations_that_are_something_else_give_one_line(tmp_path, monkeypatch, capsys, changed):
    monkeypatch.chdir(tmp_path)
    folder = write_run(tmp_path / "run", [])
    arrays = {name: np.array(value) for name, value in {**EVALUATIONS, **changed}.items()}
    np.savez(folder / "evaluations.npz", **arrays)
    holds_objects = any(value.dtype == object for value in arrays.values())
    (name, *_) = changed
    for command in (plot, compare):
        with pytest.raises(SystemExit, match="2"):
            command([str(folder)])
        printed = capsys.readouterr().err
        assert f"{folder / 'evaluations.npz'} cannot be read: " in printed and printed.count("\n") == 1
        assert ("Object arrays" if holds_objects else f"{name} must be finite numbers of shape (") in printed
    assert not (folder / "curves.png").exists()


def test_damaged_evaluations_and_progress_give_one_line(tmp_path, capsys):
    folder = write_run(tmp_path / "run", [])
    file = folder / "evaluations.npz"
    np.savez_compressed(file, **EVALUATIONS)
    whole = file.read_bytes()
    start = len(b"PK") + whole.index(b"timesteps.npy") + 30  # among the compressed bytes of the first array
    damaged = [whole[:start] + bytes(8) + whole[start + 8 :], whole[: len(whole) // 2], b"", b"PK\x03\x04"]
    np.save(tmp_path / "array.npy", [100, 200])
    for content in (*damaged, (tmp_path / "array.npy").read_bytes()):
        file.write_bytes(content)
        with pytest.raises(SystemExit, match="2"):
            plot([str(folder)])
        printed = capsys.readouterr().err
        assert "evaluations.npz cannot be read: " in printed and printed.count("\n") == 1
    file.unlink()
    (folder / "progress.csv").write_text("time/total_timesteps,safety/safety_cost\n100,nan\n")
    with pytest.raises(SystemExit, match="2"):
        plot([str(folder)])
    assert "safety/safety_cost, or the number of steps beside it, is NaN or infinite" in capsys.readouterr().err


def test_policies_beside_each_other(toy, tmp_path, capsys):
    options = ["--env", "toy_env:ToyDrive-v0", "--scenarios", "0:3", "--json", str(tmp_path / "result.json")]
    evaluate_command([str(toy), *options, "--control", "self", "--beside", "guided", "lazy", "--jobs", "1"])
    lines = capsys.readouterr().out.splitlines()
    start = lines.index("toy_env:ToyDrive-v0, 3 episodes each, mean ± std")
    assert lines[start + 1].split("  ")[0] == "policy" and lines[start + 1].endswith("steps")
    assert [line.split("  ")[0] for line in lines[start + 2 : start + 5]] == ["CHAC (self)", "CHAC (guided)", "lazy"]
    assert lines[start + 2].split()[2:7] == ["5.0", "±", "0.8", "1.00", "±"]
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["policy"] == "CHAC (self)" and result["success_rate"] == 1.0
    assert set(result["beside"]) == {"guided", "lazy"}
    assert result["beside"]["guided"]["policy"] == "CHAC (guided)" and result["beside"]["guided"]["success_rate"] == 0.0
    assert result["beside"]["lazy"]["records"] == evaluate("lazy", "toy_env:ToyDrive-v0", "0:3").records


@pytest.mark.parametrize("control", ["guided", "self", "shared"])
def test_a_film_tells_stage_driver_and_confidence(toy, control):
    model = CHAC.load(toy)
    model.policy.control = control
    with Runner(Task(model, "toy_env:ToyDrive-v0", {})) as runner:
        shown = []
        runner.episode(0, on_step=lambda: shown.append(dict(runner.driver.hud)))
    assert {step["stage"] for step in shown} == {2}
    if control == "shared":
        assert shown[0] == {"stage": 2}
        assert all(0 <= float(step["confidence"]) <= 1 for step in shown[1:])
        assert {step["drives"] for step in shown[1:]} <= {"guided policy", "self-learning policy"}
    else:
        driver = {"guided": "guided policy", "self": "self-learning policy"}[control]
        assert {tuple(step.items()) for step in shown} == {(("stage", 2), ("drives", driver))}


def test_a_film_shows_what_the_driver_tells(tmp_path, monkeypatch):
    """On SafeDrive, whose pictures have a place for it; a driver that tells nothing leaves it empty."""
    shown = []
    monkeypatch.setattr(SafeDriveEnv, "render", lambda env: shown.append(env.hud) or np.zeros((4, 4, 3), np.uint8))
    model = CHAC("MlpPolicy", "SafeDrive-v0", policy_kwargs={"net_arch": [8]}, buffer_size=10)
    for policy, told in ((model, {"stage": 1, "drives": "guided policy"}), ("scripted", {})):
        with Runner(Task(policy, "SafeDrive-v0", {"horizon": 3}), render_mode="rgb_array") as runner:
            save_video(tmp_path / "film.gif", runner, 1000)
        assert shown == 4 * [told]
        shown.clear()


def test_the_chosen_policy_acts_in_every_process(toy):
    model = CHAC.load(toy)
    model.policy.control = "self"
    evaluation = evaluate(model, "toy_env:ToyDrive-v0", "0:2", jobs=2)
    assert evaluation.settings["policy"] == "CHAC (self)" and evaluation.summary()["success_rate"] == 1.0
    assert evaluate(CHAC.load(toy), "toy_env:ToyDrive-v0", "0").settings["policy"] == "CHAC (shared)"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["sac.zip", "--control", "self"], "'self' is a policy of C-HAC models, sac.zip is a model of sac"),
        (["sac.zip", "--beside", "guided"], "'guided' is a policy of C-HAC models"),
        (["stage_1.zip", "--control", "shared"], "is in stage 1, where the guided policy acts alone"),
        (["stage_1.zip", "--beside", "guided", "self"], "there is no 'self' yet"),
        (["stage_1.zip", "--beside", "mad"], "expert 'mad' is not available"),
        (["stage_1.zip", "--control", "mine"], "invalid choice: 'mine'"),
        (["--expert", "lazy", "--control", "self"], "--control self needs a C-HAC model"),
        (["--expert", "lazy", "--beside", "guided"], "expert 'guided' is not available"),
    ],
)
def test_errors_of_policies(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    for name, algorithm in (("sac", SAC), ("stage_1", CHAC)):
        algorithm("MlpPolicy", "toy_env:ToyDrive-v0", policy_kwargs={"net_arch": [8]}, buffer_size=10).save(f"{name}.zip")
    with pytest.raises(SystemExit) as error:
        evaluate_command([*arguments, "--env", "toy_env:ToyDrive-v0", "--scenarios", "0:2"])
    assert error.value.code == 2 and message in capsys.readouterr().err
