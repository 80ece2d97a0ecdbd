"""The wheel holds what it should, tells all it needs, and works out of reach of this checkout.

That it also installs from a package registry is proved by ``prove_package.py``.
"""

import ast
import importlib.metadata
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", target, ROOT]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    [built] = target.iterdir()
    return built


def names(requirements: list[str]) -> set[str]:
    return {canonicalize_name(Requirement(text).name) for text in requirements}


def third_party_imports(source: str) -> Iterator[tuple[str, bool]]:
    """Top-level names of others' packages, and whether each is imported only when a function is called."""

    def visit(node: ast.AST, deferred: bool) -> Iterator[tuple[str, bool]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name.split(".")[0], deferred) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            yield node.module.split(".")[0], deferred
        deferred = deferred or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, deferred)

    ours = sys.stdlib_module_names | {"senior"}
    return ((name, deferred) for name, deferred in visit(ast.parse(source), False) if name not in ours)


ON_CALL = {"label/app.py", "label/guard.py", "label/server.py", "report/watch.py"}
"""Modules that are imported by functions only, so that they may need an extra."""


def test_imports_are_declared():
    """A module imports dependencies only; a function may also import from an extra that users can choose."""
    always = names(PROJECT["dependencies"])
    optional = PROJECT["optional-dependencies"]
    on_demand = always.union(*(names(optional[extra]) for extra in optional if extra != "dev"))
    providers = importlib.metadata.packages_distributions()
    seen, undeclared = set(), set()
    for path in (ROOT / "src").rglob("*.py"):
        on_call = str(path.relative_to(ROOT / "src" / "senior")) in ON_CALL
        for name, deferred in third_party_imports(path.read_text()):
            provided_by = {canonicalize_name(provider) for provider in providers.get(name, [name])}
            seen.add(name)
            if not provided_by & (on_demand if deferred or on_call else always):
                undeclared.add(f"{path.relative_to(ROOT)}: {name}")
    assert not undeclared
    assert {"jax", "numpy"} <= seen


def test_what_needs_an_extra_is_imported_by_functions_only(tmp_path: Path):
    """Without extras installed everything else works, and asking for what needs one says what to install."""
    script = """
import importlib.util, sys
missing = ("fastapi", "starlette", "uvicorn", "jinja2", "pydantic", "statsmodels", "rliable", "pandas", "ray")
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in missing:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import senior.program, senior.cli, senior.labels, senior.label.clips, senior.report.build, senior.sweep.cluster
find = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in missing else find(name)
code = senior.cli.main(["train", "--task", "point", "--method", "pebble", "--teacher", "human", "--out", sys.argv[1]])
assert code == 2, code
assert senior.cli.main(["report", sys.argv[2], "--out", sys.argv[1]]) == 2
assert senior.cli.main(["watch", sys.argv[2]]) == 2
assert senior.cli.main(["sweep", "--task", "point", "--out", sys.argv[3], "--ray", "127.0.0.1:9"]) == 2
"""
    out, runs = ROOT / "runs" / "never", ROOT / "results" / "methods" / "runs"
    done = subprocess.run(
        [sys.executable, "-c", script, out, runs, tmp_path], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    told = done.stderr.splitlines()
    assert [line[line.index("[") :] for line in told] == ["[label]'", "[report]'", "[report]'", "[ray]'"], done.stderr
    assert not out.exists()


def test_wheel_holds_the_package_and_nothing_else(wheel: Path):
    held = set(zipfile.ZipFile(wheel).namelist())
    info = f"senior_rl-{PROJECT['version']}.dist-info"
    assert {name.split("/")[0] for name in held} == {"senior", info}
    assert {"senior/py.typed", f"{info}/licenses/LICENSE"} <= held
    sources = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src").rglob("*.py")}
    assert sources <= held
    pages = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src" / "senior" / "label" / "page").iterdir()}
    assert "senior/label/page/label.html" in pages and pages <= held
    assert not [name for name in held if "__pycache__" in name or name.endswith(".pyc")]


def test_wheel_works_in_a_fresh_environment(wheel: Path, tmp_path: Path):
    venv.create(tmp_path / "env", with_pip=False, symlinks=True)
    python = tmp_path / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python]
    install = [*pip, "install", "--no-index", "--no-deps", wheel]
    subprocess.run(install, check=True, capture_output=True, timeout=60)
    # Others' packages come from this environment, whose .pth files are not read: the checkout stays hidden.
    others = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    [own] = (tmp_path / "env").glob("lib/python*/site-packages")
    (own / "others.pth").write_text("\n".join(others))

    imported = run(python, "-c", "import senior; print(senior.__file__)", cwd=tmp_path)
    assert Path(imported.strip()).is_relative_to(own)
    assert "train" in run(python.with_name("senior"), "--help", cwd=tmp_path)


def test_wheel_tells_what_it_needs(wheel: Path):
    [path] = [name for name in zipfile.ZipFile(wheel).namelist() if name.endswith(".dist-info/METADATA")]
    metadata = Parser().parsestr(zipfile.ZipFile(wheel).read(path).decode())
    told = [Requirement(text) for text in metadata.get_all("Requires-Dist", [])]
    needed = [need for need in told if not need.marker or need.marker.evaluate({"extra": ""})]
    assert {canonicalize_name(need.name) for need in needed} == names(PROJECT["dependencies"])
    for need in needed:
        assert need.specifier.contains(importlib.metadata.version(need.name), prereleases=True), need
    assert metadata["Version"] == PROJECT["version"]


def run(*command: str | Path, cwd: Path) -> str:
    """What the command prints, away from this checkout and the caller's environment."""
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(cwd), "JAX_PLATFORMS": "cpu"}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    return result.stdout
