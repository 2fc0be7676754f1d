"""
``python -m sb3_chac train ...`` (or ``sb3-chac train ...``): RL-Zoo3's commands with our algorithms registered, and ours.

RL-Zoo3's are for places where the stock ``rl_zoo3`` command does not find them (no .pth files, ``SB3_CHAC_NO_AUTOLOAD`` set).
"""

import sys
from importlib import import_module

# Name -> module
OWN_COMMANDS = {
    name: f"sb3_chac.cli.{name}"
    for name in ("drive", "evaluate", "resume", "plot", "compare", "demos", "export", "run", "vehicle", "study")
}
COMMANDS = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots", *OWN_COMMANDS)

USAGE = f"""usage: sb3-chac {{{",".join(COMMANDS)}}} ...

RL-Zoo3's commands with the algorithms of sb3_chac, and
  drive                 train with yourself as the human, in a window: keyboard, gamepad or steering wheel
  study PROTOCOL.yaml   a study with people at the wheel: consent, practice, conditions in turn, NASA-TLX
  evaluate MODEL.zip    a model or an expert on held-out scenarios
  resume RUN_FOLDER     go on with a training that was interrupted or killed, from its newest checkpoint
  plot RUN_FOLDER       its curves: return, success rate, safety cost, what the human drove
  compare RUN RUN ...   several runs in one figure and table, with intervals over seeds
  demos COMMAND         demonstrations: record them, look at them, drive them again
  export MODEL.zip POLICY.onnx  a model as one ONNX file, for a vehicle
  run POLICY.onnx       that file at the end of a network link: observations in, checked actions out; without torch
  vehicle               an environment as a vehicle at the end of a link, for a learner elsewhere (RemoteVehicle-v0)
With --gym-packages MODULE [MODULE ...], each imports these first: they register environments of yours.
'sb3-chac train --help' lists the arguments, so does --help of the others.
Models, replay buffers, run folders and hyperparameters files are code (docs/loading.md): open those that you trust only."""


def import_packages(command: str, arguments: list[str]) -> list[str]:
    """
    Import what ``--gym-packages`` names, as RL-Zoo3's commands do.

    :param command: one of ours
    :param arguments: of it
    :return: without the option; an environment that is known only now is called module:ID, so that other processes find it
    """
    import argparse

    parser = argparse.ArgumentParser("sb3-chac", add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    named, others = parser.parse_known_args(arguments)
    if not named.gym_packages:
        return arguments
    parser.add_argument("--env")
    env = parser.parse_known_args(others)[0].env
    from gymnasium import registry

    from sb3_chac.common.naming import import_named

    before = set(registry)
    for module in named.gym_packages:
        try:
            import_named(module)
        except ImportError as error:
            parser.exit(2, f"sb3-chac: error: --gym-packages {module}: {error}. Install it, or run this in its folder.\n")
        new = set(registry) - before
        if env in new and command != "drive":  # which makes it in this process, by its plain name
            forms = {env: f"{module}:{env}", f"--env={env}": f"--env={module}:{env}"}
            others = [forms.get(text, text) for text in others]
        before |= new
    return others


def main() -> None:
    """Run the command that the command line names."""
    if len(sys.argv) == 1:
        sys.exit(USAGE)
    command = sys.argv[1]
    if command in ("-h", "--help"):
        print(USAGE)
        return
    if command not in COMMANDS:
        known = ", ".join(COMMANDS)
        sys.stderr.write(f"sb3-chac: error: {command!r} is not a command, choose from {known} (sb3-chac --help).\n")
        sys.exit(2)
    if command in OWN_COMMANDS:
        import_module(OWN_COMMANDS[command]).main(import_packages(command, sys.argv[2:]))
        return

    from sb3_chac.zoo import register
    from sb3_chac.zoo.stopping import one_sentence

    with one_sentence(f"sb3-chac {command}"):
        register()
        from rl_zoo3.cli import main as zoo_main  # takes the commands as they are now

        zoo_main()


if __name__ == "__main__":
    main()
