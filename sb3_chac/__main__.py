"""``python -m sb3_chac train ...`` (or ``sb3-chac train ...``): RL-Zoo3's commands with our algorithms registered.

For places where the stock ``rl_zoo3`` command does not find them (no .pth files, ``SB3_CHAC_NO_AUTOLOAD`` set).
"""

import sys

COMMANDS = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots")


def main() -> None:
    command = sys.argv[1] if len(sys.argv) > 1 else None
    if command in ("-h", "--help"):
        print(f"usage: sb3-chac {{{','.join(COMMANDS)}}} ...\n\nRL-Zoo3's commands, see 'sb3-chac train --help'.")
        return
    if command not in COMMANDS:
        sys.exit(f"sb3-chac: unknown command {command!r}, choose from {', '.join(COMMANDS)}")

    from rl_zoo3.cli import main as zoo_main

    from sb3_chac.zoo import register

    register()
    zoo_main()


if __name__ == "__main__":
    main()
