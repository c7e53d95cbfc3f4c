"""Tests of the examples: they run where nothing else of this project is, and they learn."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
MODULES = ("vcp", "her", "ensemble")


def run_alone(folder: Path, example: str, *arguments: str) -> list[float]:
    """The success rates that an example prints in a folder with the three modules."""
    for file in [HERE / example, *(HERE.parent / f"{name}.py" for name in MODULES)]:
        shutil.copy(file, folder)
    command = [sys.executable, example, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return [float(rate) for rate in re.findall(r"success ([\d.]+)", done.stdout)]


@pytest.mark.slow
def test_own_task_is_learned_in_an_empty_folder(tmp_path):
    rates = run_alone(tmp_path, "own_task.py")
    assert len(rates) == 4 and rates[-1] >= 0.95, rates
