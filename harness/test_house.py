"""Tests of the house: who imports whom, and what can be taken out of it."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from harness.testing import HERE

CORE = {"run", "vcp", "her", "ensemble", "envs_point"}
ROOMS = ("harness", "baselines", "experiments", "examples")
# What each may import: modules of the core by their names, rooms by theirs.
ARROWS = {
    "run": {"vcp", "her", "ensemble", "harness"},
    "vcp": {"her", "ensemble"},
    "her": set(),
    "ensemble": set(),
    "envs_point": set(),
    "harness": {"vcp", "her", "ensemble", "envs_point", "harness"},
    "baselines": {"her", "baselines"},
    "experiments": {"run", "vcp", "her", "ensemble", "harness", "experiments"},
    "examples": {"vcp", "her", "ensemble"},
}


def modules() -> dict[str, Path]:
    """Every module that is no test, by its dotted name."""
    files = [HERE / f"{name}.py" for name in sorted(CORE)]
    files += [file for room in ROOMS for file in sorted((HERE / room).glob("*.py"))]
    names = [".".join(file.relative_to(HERE).with_suffix("").parts) for file in files]
    tests = ("test_", "testing", "conftest")
    pairs = zip(names, files, strict=True)
    return {n: f for n, f in pairs if not n.split(".")[-1].startswith(tests) and "__" not in n}


def imported(file: Path) -> set[str]:
    """The project's modules that a file imports, also within functions, by their dotted names."""
    known, found = modules(), set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & known.keys()


@pytest.mark.parametrize("name", modules())
def test_arrows_lead_where_the_plan_has_them(name):
    room = name.split(".")[0]
    allowed = ARROWS[room] | ({"baselines"} if name == "harness.assemble" else set())
    assert {other.split(".")[0] for other in imported(modules()[name])} <= allowed


def test_no_module_imports_itself_by_way_of_others():
    graph = {name: imported(file) for name, file in modules().items()}
    assert "her" in graph["vcp"] and "harness.cli" in graph["run"]  # they are read at all
    while graph:
        free = [name for name, others in graph.items() if not others & graph.keys()]
        assert free, f"a circle among {sorted(graph)}"
        for name in free:
            del graph[name]


def python(program: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_method_can_be_taken_out(tmp_path):
    """The three modules and the example, in an empty folder, with NumPy and PyTorch alone."""
    for name in ("vcp", "her", "ensemble", "examples/own_task"):
        shutil.copy(HERE / f"{name}.py", tmp_path)
    program = """
import sys
for name in ("gymnasium", "gymnasium_robotics", "mujoco", "matplotlib", "tqdm", "harness"):
    sys.modules[name] = None
import own_task
own_task.CYCLES = 5
own_task.train(own_task.Room())
"""
    assert python(program, tmp_path).startswith("cycle 5: success")


def test_eq_4_and_the_buffers_need_numpy_alone(tmp_path):
    for name in ("vcp", "her"):
        shutil.copy(HERE / f"{name}.py", tmp_path)
    program = (
        "import sys\nsys.modules['torch'] = None\nimport vcp\nprint(vcp.HERBuffer(9, 1.0).size)"
    )
    assert python(program, tmp_path) == "0\n"


def test_a_runs_folder_is_read_without_mujoco_and_matplotlib():
    program = "import sys, harness.records\nprint({'mujoco', 'matplotlib'} & set(sys.modules))"
    assert python(program, HERE) == "set()\n"
