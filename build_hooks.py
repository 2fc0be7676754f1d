"""Put files into every wheel that stand outside of the package.

``sb3_chac.pth`` and ``sb3_chac.start`` go into its root, so that they land in site-packages: they make the stock ``rl_zoo3``
command know our algorithms, see ``sb3_chac/_startup.py``. ``hyperparams/`` goes into the package.
"""

import json
import os
from pathlib import Path

from setuptools.command.build_py import build_py
from setuptools.command.editable_wheel import editable_wheel

STARTUP_FILES = ("sb3_chac.pth", "sb3_chac.start")


def outside() -> dict[str, str]:
    """:return: files outside of the package -> where they are in the wheel"""
    hyperparams = {str(path): str("sb3_chac" / path) for path in sorted(Path("hyperparams").rglob("*.yml"))}
    return {name: name for name in STARTUP_FILES} | hyperparams


class BuildPy(build_py):
    """Wheels and ``pip install .``: copy the files beside the package."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for name, place in outside().items():
                target = Path(self.build_lib, place)
                self.mkpath(str(target.parent))
                self.copy_file(name, str(target))

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return super().get_outputs(include_bytecode) + [str(Path(self.build_lib, place)) for place in outside().values()]


class EditableWheel(editable_wheel):
    """``pip install -e .``: write the files into the editable wheel too."""

    def _select_strategy(self, *args, **kwargs):
        strategy = super()._select_strategy(*args, **kwargs)

        class WithStartupFiles:
            def __enter__(self):
                strategy.__enter__()
                return self

            def __exit__(self, *exc_info):
                return strategy.__exit__(*exc_info)

            def __call__(self, wheel, files, mapping):
                strategy(wheel, files, mapping)
                here = json.dumps(repr(os.getcwd()))[1:-1]  # a literal inside a literal
                for name in STARTUP_FILES:
                    wheel.writestr(name, Path(name).read_text().replace("sitedir", here))  # where the package is

        return WithStartupFiles()
