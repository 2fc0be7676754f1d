"""Every docstring of the package begins with a summary, read from the source (ruff checks the rest of their form)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sb3_chac"


SMALL_WORDS = {"a", "an", "the", "of", "it", "is", "return"}


def has_summary(docstring: str) -> bool:
    """Whether it begins with something else than a field such as :param."""
    return bool(docstring.strip()) and not docstring.lstrip().startswith(":")


def begins_with_a_clause(docstring: str) -> bool:
    """Whether "what", "who", "where" and the like are its subject."""
    return re.match(r"\s*(what|who|where|which|when|how|why)(ever)?\b", docstring, re.IGNORECASE) is not None


def says_it_twice(docstring: str) -> bool:
    """Whether :return: has no word that the summary has not."""
    told = re.search(r":return:(.*?)(?=\n\s*:|\Z)", docstring, re.DOTALL)
    if told is None:
        return False
    texts = docstring.partition("\n\n")[0], told[1]
    summary, returned = (set(re.findall(r"\w+", text.lower())) - SMALL_WORDS for text in texts)
    return returned <= summary


PROBLEMS = {
    "no summary": lambda docstring: not has_summary(docstring),
    "a clause as its subject": begins_with_a_clause,
    "said twice": says_it_twice,
}


def docstrings(source: str) -> Iterator[tuple[str, str]]:
    """
    :return: names and docstrings of modules, classes and functions that have one
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None:
                yield getattr(node, "name", "the module"), text


@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_docstring_has_one_summary(problem):
    found = {
        f"{file.relative_to(PACKAGE)}: {name}"
        for file in PACKAGE.rglob("*.py")
        for name, text in docstrings(file.read_text())
        if PROBLEMS[problem](text)
    }
    assert not found


@pytest.mark.parametrize(
    ("docstring", "problems"),
    [
        ("Return it.", []),
        (":return: it", ["no summary", "said twice"]),
        ("", ["no summary"]),
        ("\n    :param x: it\n", ["no summary"]),
        ("What is drawn.", ["a clause as its subject"]),
        ("Whoever drives.", ["a clause as its subject"]),
        ("Whole episodes.", []),
        ("Return the space.\n\n    :return: the space\n    :raises ValueError: never", ["said twice"]),
        ("Return the space.\n\n    :return: the space, shape (2,)", []),
    ],
)
def test_problems_are_noticed(docstring, problems):
    ((_, text),) = docstrings(f'def f(x):\n    """{docstring}"""\n')
    assert [name for name, is_found in PROBLEMS.items() if is_found(text)] == problems
