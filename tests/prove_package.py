"""The built wheel works in an empty environment, with everything it asks for resolved anew.

This is what ``pip install senior-rl`` does for a user: no lock, no development tools, no checkout.
It installs about a gigabyte, so it runs with ``make prove`` only.
"""

import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]

IMPORT_EVERYTHING = """
import importlib, pkgutil, senior
names = [module.name for module in pkgutil.walk_packages(senior.__path__, "senior.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(senior.__file__, *names)
"""


def run(*command: str | Path, cwd: Path) -> str:
    """What the command prints, with the caller's settings but those that add to Python's path."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result.stdout


def test_clean_install(tmp_path: Path):
    # Without --wheel, the wheel is built from the source distribution, which so is proved too.
    run(sys.executable, "-m", "build", "--outdir", tmp_path / "dist", ROOT, cwd=tmp_path)
    [wheel] = (tmp_path / "dist").glob("*.whl")
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", wheel, cwd=tmp_path)
    run(python, "-m", "pip", "check", cwd=tmp_path)

    file, *modules = run(python, "-c", IMPORT_EVERYTHING, cwd=tmp_path).split()
    assert Path(file).is_relative_to(tmp_path / "env")
    assert {"senior.cli", "senior.types"} <= set(modules)
    assert "train" in run(python.with_name("senior"), "--help", cwd=tmp_path)
