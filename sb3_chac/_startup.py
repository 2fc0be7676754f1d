"""Make RL-Zoo3 know our algorithms and gymnasium our environments, without being asked.

Python runs ``install`` at every start (through ``sb3_chac.pth``, or ``sb3_chac.start`` from Python 3.15 on, PEP 829):
RL-Zoo3 has no plug-in point, and its ``--algo`` accepts only what is registered before its arguments are read.
Only the standard library is imported here, and nothing else happens until one of the two is imported.
Set ``SB3_CHAC_NO_AUTOLOAD=1`` to switch it off; ``python -m sb3_chac train ...`` and ``import sb3_chac.envs`` work all
the same.
"""

import os
import sys
from typing import Any

# Modules -> function of sb3_chac.zoo.registration that extends them once they are imported
_EXTENSIONS = {
    "gymnasium.envs": "add_environments",
    "rl_zoo3.utils": "add_algorithms",
    "rl_zoo3.exp_manager": "add_experiments",
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
                from sb3_chac.zoo import registration

                getattr(registration, extension)(module)
            except Exception as error:  # a broken installation of ours must not break theirs
                import warnings

                package = module.__name__.partition(".")[0]
                warnings.warn(f"sb3_chac is not registered with {package}, reinstall or uninstall it: {error!r}")

        loader.exec_module = exec_and_extend


def install() -> None:
    """Put the import hook in place, once."""
    if not os.environ.get("SB3_CHAC_NO_AUTOLOAD") and not any(type(finder) is _ZooFinder for finder in sys.meta_path):
        sys.meta_path.insert(0, _ZooFinder())
