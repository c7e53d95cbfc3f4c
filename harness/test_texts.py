"""Tests of README.md, NOTES.md and the other texts: what they show runs and is there."""

import importlib
import re
import shlex
import shutil
import subprocess
import sys
import textwrap

import pytest

import run
from harness import cli, settings
from harness.play import play, read_policy
from harness.records import read_rows
from harness.testing import HERE

TEXTS = sorted(
    file
    for file in HERE.rglob("*.md")
    if not any(part.startswith((".", "runs")) for part in file.relative_to(HERE).parts)
)
SNIPPETS = [
    text for file in TEXTS for text in re.findall(r"```python\n(.*?)```", file.read_text(), re.S)
]
TINY = (
    "--epochs 1 --cycles 1 --updates 1 --batch-size 16 --eval-episodes 16 --num-workers 1".split()
)
COMMAND = r"(?:exec )?(?:python )?(run\.py|-m experiments\.\w+|figures|didactic|bench)((?: .*)?)$"


def commands() -> list[str]:
    """The programs that the texts show with their arguments, each once: `run.py --env ...`."""
    found = {}
    for file in TEXTS:
        text = re.sub(r"```python\n.*?```\n", "", file.read_text(), flags=re.S)
        blocks = re.findall(r"```\n(.*?)```", text, re.S)
        shown = [line for block in blocks for line in block.splitlines()]
        inline = re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.S))
        for line in [*shown, *(" ".join(code.split()) for code in inline)]:
            if match := re.match(COMMAND, line):
                program, arguments = match.groups()
                found[f"{program.removeprefix('-m experiments.')}{arguments}"] = None
    return [*found]


def test_the_snippet_to_copy_is_cut_from_the_example_that_learns():
    (snippet,) = [text for text in SNIPPETS if "update_her_buffer" in text]
    imports, algorithm = snippet.split("\n\n")
    example = (HERE / "examples" / "own_task.py").read_text()
    assert f"\n{imports}\n" in example
    assert textwrap.indent(algorithm, "    ") in example


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


def test_the_files_have_about_as_many_lines_as_readme_says():
    table = re.findall(r"\| \[(\w+\.py)\]\(\w+\.py\) \| (\d+) \|", (HERE / "README.md").read_text())
    assert len(table) == 5
    for name, lines in table:
        assert abs(len((HERE / name).read_text().splitlines()) - int(lines)) <= 5, name


@pytest.mark.parametrize("file", TEXTS, ids=lambda file: str(file.relative_to(HERE)))
def test_links_lead_somewhere_and_options_exist(file):
    text = file.read_text()
    for link in re.findall(r"\]\(([^)#]+)", text):
        assert link.startswith("http") or (file.parent / link).exists(), link
    known = {settings.flag(f.name) for f in settings.fields(settings.Config)}
    known |= {"--resume", "--play", "--gif", "--policy", "--help"}
    for command in re.findall(r"run\.py ([^`\n]*)", text):
        assert set(re.findall(r"--[a-z-]+", command)) <= known, command


@pytest.mark.slow
@pytest.mark.parametrize("command", commands())
def test_the_commands_that_are_shown_run(command, whole, tmp_path, monkeypatch, capsys):
    """With tiny settings in place of hours; the DIR is that of a small run."""
    monkeypatch.chdir(HERE)
    monkeypatch.delenv("DISPLAY", raising=False)
    folder = shutil.copytree(whole, tmp_path / "run")
    for name, value in (("DIR", folder), ("NAME", "fig2"), ("ID", "PointMassEmptyEnv-v1")):
        command = re.sub(rf"\b{name}\b", str(value), command)
    command = re.sub(r"\bRATE\b", "0.5", re.sub(r"\bS\b", "1", re.sub(r"\.\.\.|[][]", "", command)))
    program, *arguments = shlex.split(command)
    if program == "run.py":
        if not {"--resume", "--play", "--help"} & {*arguments}:
            if "panda_gym" in command:
                pytest.importorskip("panda_gym")
            arguments += [*TINY, "--out", str(tmp_path / "new")]
        try:
            cli.main(run.train, arguments)
        except SystemExit as stop:
            assert not stop.code and "--help" in arguments
        assert "--env" not in arguments or (tmp_path / "new" / "curve.png").exists()
        return
    if program == "sweep":
        if arguments == []:
            return  # its arguments are left out
        arguments += ["--list", "--out", str(tmp_path / "runs")]
    elif program == "figures":
        arguments += ["--runs", str(tmp_path)]  # those of other tests draw more
    elif program != "inspect_run":
        arguments += ["--help"]
    monkeypatch.setattr(sys, "argv", [program, *arguments])
    try:
        importlib.import_module(f"experiments.{program}").main()
    except SystemExit as stop:
        nothing_there = program == "figures" and "figures.py: " in str(stop.code)
        assert not stop.code or nothing_there, (stop.code, capsys.readouterr().err)


@pytest.mark.parametrize("policy", sorted(HERE.glob("results/**/policy.npz")), ids=str)
def test_the_policies_in_results_do_what_their_runs_did(policy, monkeypatch):
    """The best of the run's heads reaches about as many goals as the heads' mean did, or more."""
    monkeypatch.delenv("DISPLAY", raising=False)
    assert policy.stat().st_size < 1_000_000
    _, about = read_policy(policy)
    row = read_rows(policy.parent)[about["epoch"] - 1]
    assert play(policy) >= row["test_success_rate"] - 0.1
