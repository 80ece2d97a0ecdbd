"""Imports point one way, parts of one kind stay apart, and what has to start fast never imports JAX.

The code is read, not run, but for one process in which importing JAX fails.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import senior

ROOT = Path(__file__).parents[1] / "src" / "senior"

# A module may import from its own layer and those before it; what is not named here comes last.
LAYERS = (
    {"types"},
    {"agent", "reward", "replay", "preference_file", "preferences", "density", "files", "processes"},
    {"select", "explore", "teachers", "envs"},
    {"methods", "config", "checks", "presets"},
)
APART = {"select", "explore", "teachers", "envs"}
# And all below.
WITHOUT_JAX = {"types", "files", "processes", "preference_file", "preferences", "envs", "teachers", "rundir", "report"}
WITHOUT_JAX |= {"label", "label_file", "labels", "protocol", "tensorboard", "policy"}


def module_name(path: Path) -> str:
    return ".".join(["senior", *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(".__init__")


MODULES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}


def imported(name: str, source: str, is_package: bool, known: set[str]) -> Iterator[str]:
    """The modules of this package that ``name`` imports, functions' and type checkers' imports included."""
    package = name if is_package else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            above = parents[: len(parents) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            members = [f"{base}.{alias.name}" for alias in node.names]
            targets = [member if member in known else base for member in members]
        else:
            continue
        yield from (target for target in targets if target.split(".")[0] == "senior")


def part(name: str) -> str:
    """The part a module belongs to: ``envs`` for ``senior.envs.episodes``, nothing for the package itself."""
    return name.split(".")[1] if "." in name else ""


def layer(name: str) -> int:
    return next((depth for depth, parts in enumerate(LAYERS) if part(name) in parts), len(LAYERS))


def trespasses(importer: str, target: str) -> bool:
    upward = layer(target) > layer(importer)
    sideways = {part(importer), part(target)} <= APART and part(importer) != part(target)
    return upward or sideways


def test_imports_point_one_way():
    found = {
        f"{name} imports {target}"
        for name, path in MODULES.items()
        for target in imported(name, path.read_text(), path.name == "__init__.py", set(MODULES))
        if trespasses(name, target)
    }
    assert not found
    assert set().union(*LAYERS[:2]) <= {part(name) for name in MODULES}, "LAYERS names a part that is gone"


@pytest.mark.parametrize(
    ("importer", "source", "found"),
    [
        ("senior.replay", "from senior.types import Batch", False),
        ("senior.types", "import senior.replay", True),
        ("senior.replay", "def f():\n    from senior import config", True),
        ("senior.select.uniform", "from ..teachers.scripted import Scripted", True),
        ("senior.select.uniform", "from .entropy import entropy", False),
        ("senior.select.uniform", "from ..density import Density", False),
        ("senior.density", "from senior import __version__", True),
        ("senior.cli", "from . import envs", False),
    ],
)
def test_a_planted_import_is_judged(importer: str, source: str, found: bool):
    known = {"senior", "senior.config", "senior.envs", "senior.select.entropy", "senior.teachers.scripted"}
    assert any(trespasses(importer, target) for target in imported(importer, source, False, known)) == found


def test_the_package_offers_what_it_lists():
    for name in senior.__all__:
        found = getattr(senior, name)
        assert getattr(found, "__name__", name) == name


def test_what_starts_fast_never_imports_jax():
    names = ["senior", *(name for name in MODULES if part(name) in WITHOUT_JAX)]
    assert {"senior.report.curves", "senior.envs.render"} <= set(names)
    program = f"""
import importlib, sys, traceback

class NoJax:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jax", "jaxlib"):
            raise ImportError(f"{{name}} must not be imported here")

sys.meta_path.insert(0, NoJax())
failed = []
for name in {names!r}:
    try:
        importlib.import_module(name)
    except ImportError:
        failed.append(name)
        traceback.print_exc()
sys.exit(f"failed: {{failed}}" if failed else 0)
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
