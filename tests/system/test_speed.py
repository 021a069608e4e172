"""CPU time of a simulated run, relative to an earlier commit."""

import subprocess
import sys
from pathlib import Path

import pytest

from speed_ratio import BASE

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.more
@pytest.mark.timeout(600)
def test_a_simulated_run_takes_no_more_cpu_time_than_before() -> None:
    known = ["git", "-C", str(ROOT), "cat-file", "-e", f"{BASE}^{{commit}}"]
    if subprocess.run(known, check=False, capture_output=True).returncode:
        pytest.skip(f"this folder is not a clone with the commit {BASE}, which it is compared with")
    command = [sys.executable, str(ROOT / "benchmarks" / "speed_ratio.py"), "--rounds", "3"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
