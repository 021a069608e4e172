"""Install the packages that laneweave and some of its extras need, without the packages' tests.

Usage in Containerfile: `install_extras.py FOLDER [EXTRA ...]`, where FOLDER contains pyproject.toml
and constraints.txt. The packages go into the virtual environment /opt/laneweave.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ENVIRONMENT = Path("/opt/laneweave")


def main(folder: Path, extras: list[str]) -> None:
    """Install the packages, remove their tests, and compile their modules."""
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = [project["dependencies"], *(project["optional-dependencies"][name] for name in extras)]
    needed = sorted({name for group in groups for name in group})
    python = str(ENVIRONMENT / "bin" / "python")
    options = ["--no-cache-dir", "--no-compile", "--disable-pip-version-check"]
    # The base image's pip: the environment has none.
    pip = ["pip", "--python", python, "install", *options]
    subprocess.run([*pip, "-c", str(folder / "constraints.txt"), *needed], check=True)
    for tests in sorted(ENVIRONMENT.glob("lib/python3.*/site-packages/**/tests"), reverse=True):
        shutil.rmtree(tests)
    # A few packages contain templates that are not valid Python: ignore the status.
    compiled = [python, "-m", "compileall", "-q", "-j", "0", str(ENVIRONMENT / "lib")]
    subprocess.run(compiled, check=False, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
