"""What a user installs: wheel, sdist and editable installs, each proved in a virtual environment that has nothing else."""

import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest
from shell import run

ROOT = Path(__file__).parent.parent
TRAIN = ["train", "--env", "Pendulum-v1", "-n", "120", "--eval-freq", "-1", "-f", "logs"]
SMALL = ["-params", "learning_starts:100", "policy_kwargs:dict(net_arch=[8])"]


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of the tracked files, so that building leaves nothing in the checkout."""
    folder = tmp_path_factory.mktemp("source")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("needs a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def dist(source) -> Path:
    """The sdist, and the wheel that is built from it."""
    run(sys.executable, "-m", "build", "--outdir", "dist", ".", cwd=source)
    return source / "dist"


def test_wheel_and_sdist_carry_what_is_needed(dist):
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as wheel:
        names = set(wheel.namelist())
    expected = {"sb3_chac.pth", "sb3_chac.start", "sb3_chac/py.typed", "sb3_chac/version.txt", "sb3_chac/_startup.py"}
    expected |= {f"sb3_chac/{path.relative_to(ROOT)}" for path in (ROOT / "hyperparams").rglob("*.yml")}
    expected |= {str(path.relative_to(ROOT)) for path in (ROOT / "sb3_chac").rglob("*.py")}
    assert expected <= names
    assert not [name for name in names if name.startswith(("tests", "benchmarks", "build_hooks"))]
    with tarfile.open(next(dist.glob("*.tar.gz"))) as sdist:
        files = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"build_hooks.py", "sb3_chac.pth", "sb3_chac.start", "hyperparams/dsac.yml", "LICENSE", "CHANGELOG.md"} <= files


@pytest.mark.parametrize("dependencies", ["of this environment", pytest.param("new", marks=pytest.mark.slow)])
def test_stock_rl_zoo3_in_a_fresh_environment(dist, source, tmp_path, dependencies):
    """
    One environment after another costs minutes, so this one is used in turn for each way to install.

    :param dependencies: installed anew, as for a user, or found where the tests run
    """
    venv, work = tmp_path / "venv", tmp_path / "work"
    work.mkdir()
    run(sys.executable, "-m", "venv", venv, cwd=tmp_path)
    python, rl_zoo3 = venv / "bin" / "python", venv / "bin" / "rl_zoo3"
    install = [python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt"]
    site_packages = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=work).strip())

    if dependencies == "new":
        run(*install, "torch", cwd=work)
    else:
        # Packages in there are found, but no .pth file in there is read: an editable installation of ours is not seen
        (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
        install += ["--no-deps", "--ignore-installed"]
        rl_zoo3.write_text(f"#!{python}\nfrom rl_zoo3.cli import main\nmain()\n")
        rl_zoo3.chmod(0o755)

    # The wheel
    run(*install, next(dist.glob("*.whl")), cwd=work)
    output = run(rl_zoo3, *TRAIN, "--algo", "dsac", *SMALL, cwd=work)
    assert str(site_packages / "sb3_chac" / "hyperparams" / "dsac.yml") in output
    assert (work / "logs" / "dsac" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()
    run(python, "-c", "import sb3_chac; assert sb3_chac.DSAC.__name__ == 'DSAC' and sb3_chac.__version__", cwd=work)
    # In Python 3.15+ the .start file does what the .pth file does here: the same function
    assert (site_packages / "sb3_chac.start").read_text().strip() == "sb3_chac._startup:install"

    # Uninstalled: nothing of ours is left, the zoo works
    run(python, "-m", "pip", "uninstall", "--quiet", "--yes", "sb3_chac", cwd=work)
    assert not list(site_packages.glob("sb3_chac*"))
    assert "invalid choice: 'dsac'" in run(rl_zoo3, *TRAIN, "--algo", "dsac", cwd=work, fails=True)

    # Half removed: the .pth file is left over from a package that is gone
    shutil.copy(ROOT / "sb3_chac.pth", site_packages)
    output = run(rl_zoo3, *TRAIN, "--algo", "sac", *SMALL, cwd=work)
    assert "sb3_chac: not registered with rl_zoo3" in output and "Saving to" in output
    (site_packages / "sb3_chac.pth").unlink()

    # Editable
    run(*install, "--editable", source, cwd=work)
    output = run(rl_zoo3, *TRAIN, "--algo", "dsac", *SMALL, cwd=work)
    assert str(source / "hyperparams" / "dsac.yml") in output
