"""What an installation holds: declared packages, and the commands of the Dockerfile."""

import ast
import configparser
import importlib.metadata
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
# Module -> what installs it, where that is called otherwise or several do
DISTRIBUTIONS = {
    "PIL": "pillow",
    "huggingface_sb3": "sb3-team-hf-integration",
    "yaml": "pyyaml",
    "pygame": "pygame-ce",  # MetaDrive's pygame goes to the same folder
    "metadrive": "metadrive-simulator",
    "direct": "metadrive-simulator",  # Panda3D's, which MetaDrive stands on
}
PLAIN = r"pip install \"?sb3[-_]chac"


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def declared() -> set[str]:
    """
    :return: distributions of install_requires and of the extras that users install
    """
    config = configparser.ConfigParser(interpolation=None)
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    extras = {name: value for name, value in config["options.extras_require"].items() if name not in ("dev", "docs")}
    lines = "\n".join([config["options"]["install_requires"], *extras.values()]).split("\n")
    return {normal(re.split(r"[\[<>=;!~ ]", line.strip())[0]) for line in lines if line.strip()}


def imported() -> dict[str, str]:
    """
    :return: top-level modules that are not Python's own or ours, each with a file that imports it
    """
    found = {}
    for path in (ROOT / "sb3_chac").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names = [node.module]
            for name in names:
                found[name.partition(".")[0]] = path.relative_to(ROOT).as_posix()
    return {name: path for name, path in found.items() if name not in {*sys.stdlib_module_names, "sb3_chac"}}


def test_all_imported_packages_are_declared():
    missing = {name: path for name, path in imported().items() if normal(DISTRIBUTIONS.get(name, name)) not in declared()}
    assert not missing


def test_what_is_declared_for_an_import_brings_it():
    installed = importlib.metadata.packages_distributions()
    for name in ("numpy", "torch", "rliable", "matplotlib", "imageio", "rl_zoo3", "highway_env", "huggingface_sb3", "PIL"):
        assert normal(DISTRIBUTIONS.get(name, name)) in map(normal, installed[name])


def test_no_message_names_an_installation_that_does_not_exist():
    files = [path for folder in ("sb3_chac", "hyperparams", "benchmarks") for path in (ROOT / folder).rglob("*.*")]
    texts = {path: path.read_text(encoding="utf-8") for path in files if path.suffix in (".py", ".yml", ".md", ".js", ".html")}
    assert not [path.as_posix() for path, text in texts.items() if re.search(PLAIN, text)]


def test_the_dockerfile_runs_the_commands_of_make_demo():
    def commands(text: str) -> list[str]:
        for name, value in re.findall(r"^(\w+) := (.*)$", makefile, re.MULTILINE):
            text = text.replace(f"$({name})", value)
        text = text.replace("$(DEMO)", "logs/demo").replace(".venv/bin/", "").replace("$(VENV)/bin/", "").replace("\\\n", " ")
        return re.findall(r"(?:rl_zoo3|sb3-chac) [^;\n\"]*", " ".join(text.split(" ")))

    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    target = makefile.split("\ndemo:")[1].split("\t@echo")[0]
    docker = (ROOT / "Dockerfile").read_text(encoding="utf-8").split("\nCMD ")[1]
    words = [[command.split() for command in commands(text)] for text in (target, docker)]
    assert words[0] == words[1] and [command[0] for command in words[0]] == ["rl_zoo3", "sb3-chac", "sb3-chac"]
