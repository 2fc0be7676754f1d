"""Layers of the package, read from the source: what may import what, and that every import of ours exists."""

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import sb3_chac

ROOT = Path(__file__).parents[1]
PACKAGE = "sb3_chac"
# Lowest first. A part of the package imports from lower layers only, not even from others of its own layer, except:
LAYERS = (
    {"common"},
    {"human", "envs"},
    set(sb3_chac.ALGORITHMS),
    {"__init__"},  # the public names, imported on first use, and the version
    {"zoo"},
    {"evaluation"},
    {"datasets"},
    {"deploy"},
    {"cockpit"},
    {"cli"},
    {"__main__", "_startup"},
)
BESIDES = {"hg_dagger": {"bc"}, "iwr": {"bc"}}  # what an algorithm uses of one that it does not derive from


class Import(NamedTuple):
    """An import of one of our modules: ``file`` imports ``module``, both with their part of the package."""

    file: str
    part: str
    module: str
    imported: str


def part_of(module: str) -> str:
    """
    Return the part of the package that a module belongs to.

    :param module: dotted name, e.g. "sb3_chac.human.rules"
    :return: e.g. "human"; "__init__" for the package itself
    """
    return (*module.split("."), "__init__")[1]


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def imports(root: Path) -> Iterator[Import]:
    """
    Read the imports of our own modules from all sources in a folder, those inside functions and for type checkers included.

    :param root: of the package, or of other sources
    """
    for file in sorted(root.rglob("*.py")):
        part = part_of(".".join(file.relative_to(ROOT).with_suffix("").parts))
        for node in ast.walk(ast.parse(file.read_text())):
            modules: list[str] = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0 and node.module, f"{file}: a relative import"
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                modules = [name if is_module(name) else node.module for name in names]
            for module in {module for module in modules if module.split(".")[0] == PACKAGE}:
                yield Import(str(file.relative_to(ROOT)), part, module, part_of(module))


def parents(algorithm: str) -> set[str]:
    """
    :param algorithm: name of its package
    :return: packages of the algorithms that it may import from
    """
    bases = {part_of(base.__module__) for base in getattr(sb3_chac, sb3_chac.ALGORITHMS[algorithm]).__mro__}
    return bases & set(sb3_chac.ALGORITHMS) | BESIDES.get(algorithm, set())


def is_upward(found: Import) -> bool:
    """
    :return: whether an import breaks the order of the layers
    """
    level = {part: number for number, layer in enumerate(LAYERS) for part in layer}
    if found.part == found.imported or (found.part in sb3_chac.ALGORITHMS and found.imported in parents(found.part)):
        return False
    if found.part == "__init__":  # only names what it imports late
        return False
    return level[found.imported] >= level[found.part]


def test_every_part_of_the_package_has_a_layer():
    found = {part_of(f"{PACKAGE}.{path.stem}") for path in (ROOT / PACKAGE).iterdir() if path.suffix == ".py"}
    found |= {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert found <= set().union(*LAYERS)


def test_no_part_imports_from_its_own_layer_or_one_above():
    upward = [found for found in imports(ROOT / PACKAGE) if is_upward(found)]
    assert not upward, "\n".join(f"{found.file} imports {found.module}" for found in upward)


@pytest.mark.parametrize("folder", [PACKAGE, "tests", "benchmarks"])
def test_every_import_of_ours_exists(folder):
    missing = {(found.file, found.module) for found in imports(ROOT / folder) if not is_module(found.module)}
    assert not missing


@pytest.mark.parametrize(
    ("part", "imported", "upward"),
    [
        ("common", "human", True),
        ("human", "common", False),
        ("chac", "dpvp", False),
        ("dpvp", "chac", True),
        ("bc", "cql", True),
    ],
)
def test_an_import_from_above_is_noticed(part, imported, upward):
    assert is_upward(Import("x.py", part, f"{PACKAGE}.{imported}", imported)) is upward


def test_common_stands_alone():
    assert {found.imported for found in imports(ROOT / PACKAGE / "common")} == {"common"}


def test_the_package_is_found_where_these_sources_are():
    assert Path(importlib.util.find_spec(PACKAGE).origin).parents[1] == ROOT


def test_every_algorithm_has_hyperparameters():
    assert all((ROOT / "hyperparams" / f"{algorithm}.yml").is_file() for algorithm in sb3_chac.ALGORITHMS)
