"""Tests of README.md and NOTES.md: what they show runs, what they name is there."""

import re
import subprocess
import sys

import numpy as np
import pytest

from harness import settings
from harness.testing import HERE, exact_reward, numbered_episodes

TEXTS = sorted(
    file
    for file in HERE.rglob("*.md")
    if not any(part.startswith((".", "runs")) for part in file.relative_to(HERE).parts)
)
SNIPPETS = re.findall(r"```python\n(.*?)```", (HERE / "README.md").read_text(), re.S)


def test_the_snippet_to_copy_runs():
    (snippet,) = [text for text in SNIPPETS if "update_her_buffer" in text]
    names = {"rng": np.random.default_rng(0), "your_reward_fn": exact_reward}
    names["your_episodes"] = numbered_episodes(16)
    exec(snippet, names)
    assert names["her_buffer"].size == 5 * 1024 == names["her_buffer"].capacity
    assert names["agent"].optimizer.state


def test_the_environment_to_copy_is_learned(tmp_path):
    (snippet,) = [text for text in SNIPPETS if "gym.register" in text]
    (tmp_path / "line.py").write_text(snippet)
    command = re.match(r"# line.py; python (.*)\n", snippet)[1].split()
    command[0] = str(HERE / command[0])  # another folder is the current one
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    last = [line for line in done.stdout.splitlines() if line.startswith("epoch")][-1]
    assert float(re.search(r"success ([\d.]+)", last)[1]) >= 0.9, done.stdout


def test_the_maps_code_and_tests_exist():
    text = (HERE / "NOTES.md").read_text()
    rows = text[text.index("## The map") : text.index("## Hyper-parameters")]
    sources = {file: file.read_text() for file in HERE.rglob("*.py")}
    tests = set(re.findall(r"`(test_\w+)`", rows))
    defined = set(re.findall(r"^def (test_\w+)", "\n".join(sources.values()), re.M))
    assert len(tests) >= 20 and tests <= defined, tests - defined
    for module, name in re.findall(r"`(vcp|her|ensemble|run|envs_point)\.([\w.]+)`", rows):
        source = sources[HERE / f"{module}.py"]
        for part in name.removesuffix(".py").split("."):
            assert re.search(rf"(def|class) {part}\b|^{part} =", source, re.M) or part == "py", name


@pytest.mark.parametrize("file", TEXTS, ids=lambda file: str(file.relative_to(HERE)))
def test_links_lead_somewhere_and_options_exist(file):
    text = file.read_text()
    for link in re.findall(r"\]\(([^)#]+)", text):
        assert link.startswith("http") or (file.parent / link).exists(), link
    known = {settings.flag(f.name) for f in settings.fields(settings.Config)}
    known |= {"--resume", "--play", "--gif", "--policy", "--help"}
    for command in re.findall(r"run\.py ([^`\n]*)", text):
        assert set(re.findall(r"--[a-z-]+", command)) <= known, command
