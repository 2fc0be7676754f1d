"""
Make RL-Zoo3 know our algorithms and gymnasium our environments, without being asked.

Python runs ``install`` at every start (through ``sb3_chac.pth``, or ``sb3_chac.start`` from Python 3.15 on, PEP 829):
RL-Zoo3 has no plug-in point, and its ``--algo`` accepts only what is registered before its arguments are read.
Only the standard library is imported here, and nothing else happens until one of the two is imported.
Set ``SB3_CHAC_NO_AUTOLOAD=1`` to switch it off; ``python -m sb3_chac train ...`` and ``import sb3_chac.envs`` work all
the same.

The .pth file loads this module by its path, and this module the package beside it: ``sys.path`` may begin with the working
directory, and whatever is called sb3_chac there is not run because somebody imports gymnasium.
"""

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location
from typing import Any

# Modules -> function of sb3_chac.zoo.registration that extends them once they are imported
_EXTENSIONS = {
    "gymnasium.envs": "add_environments",
    "rl_zoo3.utils": "add_algorithms",
    "rl_zoo3.exp_manager": "add_experiments",
    "rl_zoo3.train": "add_training",
    "huggingface_sb3.push_to_hub": "add_metadata",
}


class _ZooFinder:
    """Import hook that lets the other finders do the work, and adds a step after the import."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        if fullname not in _EXTENSIONS:
            return None
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(fullname, path, target)
            if spec is not None and spec.loader is not None:
                self._extend_after(spec.loader, _EXTENSIONS[fullname])
                return spec
        return None

    @staticmethod
    def _extend_after(loader: Any, extension: str) -> None:
        exec_module = loader.exec_module

        def exec_and_extend(module: Any) -> None:
            exec_module(module)
            try:
                import_own_package()
                from sb3_chac.zoo import registration

                getattr(registration, extension)(module)
            except Exception as error:  # a broken installation of ours must not break theirs
                import warnings

                package = module.__name__.partition(".")[0]
                warnings.warn(f"sb3_chac is not registered with {package}, reinstall or uninstall it: {error!r}")

        loader.exec_module = exec_and_extend


def import_own_package() -> None:
    """Import sb3_chac from beside this file, unless it is imported, or PYTHONPATH leads to another one by an absolute path."""
    if "sb3_chac" in sys.modules:
        return
    named = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(path)]
    folders = [os.path.join(path, "sb3_chac") for path in named] if not sys.flags.ignore_environment else []
    files = [os.path.join(folder, "__init__.py") for folder in [*folders, os.path.dirname(os.path.abspath(__file__))]]
    file = next(filter(os.path.isfile, files))
    spec = spec_from_file_location("sb3_chac", file, submodule_search_locations=[os.path.dirname(file)])
    assert spec is not None and spec.loader is not None
    sys.modules["sb3_chac"] = package = module_from_spec(spec)
    try:
        spec.loader.exec_module(package)
    except BaseException:
        del sys.modules["sb3_chac"]
        raise


def install() -> None:
    """Put the import hook in place, once."""
    if os.environ.get("SB3_CHAC_NO_AUTOLOAD"):
        return
    # By its name: this module may be loaded by its path and imported as well
    if not any(type(finder).__name__ == _ZooFinder.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, _ZooFinder())
