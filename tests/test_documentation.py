"""The site builds without a warning, and the Python blocks of README and site run as they stand there."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"# (\w+)\.py\n")  # a block that begins with its file name is a module that the next ones import


def blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def page_id(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_the_site_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "-b", "html"]
    done = subprocess.run([*command, str(ROOT / "docs"), str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in ("index.html", "search.html", "modules/chac.html", "guide/custom_env.html"):
        assert (tmp_path / name).is_file()
    assert "switch_after" in (tmp_path / "modules" / "chac.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=page_id)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    modules = []
    for block in blocks(page):
        file = FILE.match(block)
        if file:
            modules.append(file[1])
            (tmp_path / f"{file[1]}.py").write_text(block, encoding="utf-8")
            importlib.invalidate_caches()
            importlib.import_module(file[1])
        else:
            exec(compile(block, page_id(page), "exec"), {"__name__": "__main__"})
    for module in modules:
        del sys.modules[module]


def test_links_to_files_lead_somewhere():
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page_id(page)}: {target}")
    assert not broken


@pytest.mark.slow
def test_the_notebook_runs_top_to_bottom(monkeypatch):
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "backend", "Agg")
    notebook = json.loads((ROOT / "examples" / "takeovers.ipynb").read_text(encoding="utf-8"))
    namespace = {"__name__": "__main__"}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "takeovers.ipynb", "exec"), namespace)
    assert len(namespace["evaluation"].records) == 3


def test_results_name_no_path_of_a_machine():
    texts = [path for path in (ROOT / "benchmarks").rglob("*") if path.suffix in (".csv", ".md", ".json", ".yml")]
    texts = [path for path in texts if "models" not in path.parts]  # not committed
    found = re.compile(r"(?<![\w.])/(root|home|Users|tmp|work)/")
    assert texts and not [page_id(path) for path in texts if found.search(path.read_text(encoding="utf-8"))]


def test_every_benchmark_is_in_the_readme_and_in_make_bench():
    scripts = {path.name for path in (ROOT / "benchmarks").glob("*.py") if '__name__ == "__main__"' in path.read_text()}
    bench = (ROOT / "Makefile").read_text().partition("\nbench:")[2].partition("\n\n")[0]
    for text in (bench, (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")):
        assert scripts <= set(re.findall(r"benchmarks/(\w+\.py)", text))
