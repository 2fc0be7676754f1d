"""Every docstring of the package begins with a summary, read from the source (ruff checks the rest of their form)."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sb3_chac"


def without_summary(source: str) -> Iterator[str]:
    """
    :return: names of modules, classes and functions whose docstring begins with a field such as :param
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None and (not text.strip() or text.lstrip().startswith(":")):
                yield getattr(node, "name", "the module")


def test_every_docstring_begins_with_a_summary():
    found = {
        f"{file.relative_to(PACKAGE)}: {name}" for file in PACKAGE.rglob("*.py") for name in without_summary(file.read_text())
    }
    assert not found


@pytest.mark.parametrize(
    ("docstring", "found"), [("Return it.", []), (":return: it", ["f"]), ("", ["f"]), ("\n    :param x: it\n", ["f"])]
)
def test_a_docstring_without_summary_is_noticed(docstring, found):
    assert list(without_summary(f'def f(x):\n    """{docstring}"""\n')) == found
