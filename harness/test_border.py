"""Tests of the border to environments that are somebody else's: `Line` with one thing changed each.

Either it learns what `Line` learns, or one line says what is wrong: before anything is written,
with exit code 2, or with 1 once training has begun.
"""

import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from ensemble import EnsembleDDPG
from harness import assemble, records
from harness.border import remark
from harness.errors import EnvironmentFailed, UsageError
from harness.settings import Config, complete
from harness.tasks import examine, make_env
from harness.testing import HERE, SMALL, Line, finish, main, start, without_timing
from harness.workers import ParallelEnvs
from run import train

FLOAT32 = np.finfo(np.float32)


def odd(name, length=10, **changes):
    gym.register(f"{name}-v0", type(name, (Line,), changes), max_episode_steps=length)
    return f"{name}-v0"


def stepped(change):
    """A `step` whose five results `change` makes others of."""
    return lambda self, action: change(self, *Line.step(self, action))


def observing(**others):
    """An `observe` in which these are functions of what it would be."""

    def observe(self):
        obs = Line.observe(self)
        return {**obs, **{key: change(obs[key]) for key, change in others.items()}}

    return observe


def later(change):
    """`change`, but not while the episodes are looked at: from a process's step 150 on."""
    count = [0]

    def step(self, action):
        count[0] += 1
        result = Line.step(self, action)
        return change(self, *result) if count[0] > 150 else result

    return step


def in_place(self, achieved_goal, desired_goal, info):
    """Takes for its own what float32 goals are not copied into."""
    apart = np.asarray(desired_goal, np.float32)
    apart -= np.asarray(achieved_goal, np.float32)
    return -1.0 * (np.abs(apart)[..., 0] > self.tolerance)


def drawn_globally(self, *, seed=None, options=None):
    Line.reset(self, seed=seed)
    self.x, self.g = np.random.uniform(-1, 1, 1), np.array([random.uniform(-1, 1)])  # noqa: NPY002
    return self.observe(), {}


def shrinks_without_seed(self, *, seed=None, options=None):
    self.tolerance *= 1 if seed is not None else 0.3
    return Line.reset(self, seed=seed)


def changes_folder(self, render_mode=None):
    Line.__init__(self)
    os.chdir(tempfile.gettempdir())


def raising(error):
    def method(self, *args, **kwargs):
        raise error

    return method


def reset_as(change):
    def reset(self, *, seed=None, options=None):
        return change(self, *Line.reset(self, seed=seed))

    return reset


def shared(self):
    """Observations in the same arrays each time, which later steps overwrite."""
    if not hasattr(self, "arrays"):
        self.arrays = {name: x.copy() for name, x in Line.observe(self).items()}
    for name, x in Line.observe(self).items():
        self.arrays[name][:] = x
    return self.arrays


def without_a_goal(self, render_mode=None):
    Line.__init__(self)
    none = gym.spaces.Box(-1, 1, (0,), np.float64)
    spaces = {**self.observation_space, "achieved_goal": none, "desired_goal": none}
    self.observation_space = gym.spaces.Dict(spaces)


def almost_there(self):
    """Nearer to the goal than float32 can tell."""
    return {**Line.observe(self), "achieved_goal": self.g + 1e-8}


def to_a_billionth(self, achieved_goal, desired_goal, info):
    return -1.0 * (np.abs(achieved_goal - desired_goal)[..., 0] > 1e-9)


ends = (False, False)  # neither terminated nor truncated


def saying(success):
    """A `step` whose is_success is a function of the reward."""
    return stepped(lambda s, o, r, *_: (o, r, *ends, {"is_success": success(r)}))


def seeing(change):
    """A `step` whose observations have other entries."""
    return stepped(lambda s, o, *more: ({**o, **change(s)}, *more))


def rewarding(change):
    """A `step` with another reward."""
    return stepped(lambda s, o, r, *more: (o, change(r), *more))


def computing(change):
    """A `compute_reward` that makes something else of its rewards."""
    return lambda self, a, d, i: change(self, Line.compute_reward(self, a, d, i))


LEARNED = {
    odd("Plain"): "",
    odd("InPlace", compute_reward=in_place): "",
    odd("DrawnGlobally", reset=drawn_globally): "",
    odd("ChangesFolder", __init__=changes_folder): "",
    odd("CloseRaises", close=raising(RuntimeError("no server"))): "its close raised RuntimeError",
    odd("CloseExits", close=raising(SystemExit(3))): "its close raised SystemExit: 3",
    odd("MovesTheAction", step=lambda self, a: (Line.step(self, a), a.fill(9))[0]): "",
    odd("SuccessIsAnArray", step=saying(lambda r: np.array([r == 0]))): "",
    odd("SuccessIsANumber", step=saying(lambda r: 1.0 + r)): "",
    odd("RewardIsAnArray", step=rewarding(lambda r: np.array(r))): "",
    odd("RewardsAreWhole", compute_reward=computing(lambda s, r: np.int8(r))): "",
    odd("RewardsAreBools", best=1.0, compute_reward=computing(lambda s, r: r == 1)): "",
    odd("ListsForArrays", observe=observing(observation=list)): "",
    odd(
        "FarObservations", observe=observing(observation=lambda x: 1000 + 500 * x)
    ): "number 0 of its observation moves only beyond ±200",
    odd(
        "CloseObservations", observe=observing(observation=lambda x: x / 1000)
    ): "number 0 of its observation moves by less than 0.01",
    odd("SharesItsArrays", observe=shared, reset=reset_as(lambda s, o, i: (shared(s), i))): "",
}

REFUSED = {  # before anything is written
    odd(
        "Shrinks",
        tolerance=0.5,
        reset=reset_as(
            lambda s, *both: (setattr(s, "tolerance", max(0.05, s.tolerance * 0.9)), both)[1]
        ),
    ): "gives -1",
    odd(
        "ReadsTheStep", compute_reward=computing(lambda s, r: 0 * r if s.t == 5 else r)
    ): "compute_reward of what it observed",
    odd(
        "WholeActions", action_space=gym.spaces.Box(0, 10, (1,), np.int64)
    ): "its actions are whole numbers",
    odd(
        "WideActions", action_space=gym.spaces.Box(FLOAT32.min, FLOAT32.max, (1,))
    ): "too far apart",
    odd("NoActions", action_space=gym.spaces.Box(-1, 1, (0,))): "not a flat Box",
    odd("NoSpaces", __init__=lambda s, render_mode=None: None): "its spaces raised AttributeError",
    odd("SuccessIsNone", step=saying(lambda r: None)): "is_success of step 1 is None",
    odd("SuccessIsText", step=saying(lambda r: "no")): "is_success of step 1 is 'no'",
    odd("SuccessIsNaN", step=saying(lambda r: np.nan)): "is_success of step 1 is nan",
    odd(
        "InfoIsNone", step=stepped(lambda s, o, r, a, b, i: (o, r, a, b, None))
    ): "its step raised AttributeError",
    odd(
        "FourResults", step=stepped(lambda s, o, r, a, b, i: (o, r, a, i))
    ): "its step raised ValueError: not enough values",
    odd(
        "ResetIsOld", reset=reset_as(lambda s, o, i: o)
    ): "its reset raised ValueError: too many values",
    odd("ResetTakesNoSeed", reset=lambda s: Line.reset(s)): "its reset raised TypeError",
    odd(
        "Grows", step=seeing(lambda s: {"observation": np.zeros(2)})
    ): r"its observation is \(2,\) after step 1",
    odd(
        "GoalGrows", step=seeing(lambda s: {"desired_goal": np.zeros((1, 1))})
    ): r"its desired_goal is \(1, 1\) after step 1",
    odd(
        "LosesAKey", step=stepped(lambda s, o, *more: ({"observation": s.x}, *more))
    ): "its step raised KeyError: 'achieved_goal'",
    odd(
        "ObservesNone", observe=observing(observation=lambda x: None)
    ): r"its observation is \(\) after step 0",
    odd(
        "ObservesText", observe=observing(observation=lambda x: ["far"])
    ): "its reset raised ValueError: could not convert",
    odd(
        "ObservesNaN", observe=observing(observation=lambda x: x * np.nan)
    ): "NaN or Inf in its observation after step 0",
    odd(
        "ObservesTooMuch", observe=observing(observation=lambda x: x * 1e300)
    ): "NaN or Inf in its observation after step 0",
    odd("RewardIsNone", step=rewarding(lambda r: None)): "its step raised TypeError",
    odd("RewardIsHalf", step=rewarding(lambda r: r / 2)): "step . gave the reward -0.5",
    odd("RewardIsNaN", step=rewarding(lambda r: np.nan)): "step 1 gave the reward nan",
    odd(
        "RewardsTwice", compute_reward=computing(lambda s, r: np.stack([r, r], -1).squeeze())
    ): "is not vectorised",
    odd("RewardsNone", compute_reward=lambda s, a, d, i: [None] * len(a)): "but nan for a goal",
    odd(
        "RewardsText", compute_reward=lambda s, a, d, i: ["near"] * len(a)
    ): r"no info \(ValueError",
    odd("RewardsRagged", compute_reward=lambda s, a, d, i: [[0], [], 0]): r"no info \(ValueError",
    odd("NoGoal", __init__=without_a_goal): "are not all flat Boxes",
    odd("TimeRaises", dt=property(raising(RuntimeError("no clock")))): "its dt raised RuntimeError",
    odd("GivesThree", compute_reward=computing(lambda s, r: r[:3] if np.ndim(r) else r)): (
        r"its compute_reward of \(10, 1\) goals gave \(3,\) rewards"
    ),
    odd("TooFine", observe=almost_there, compute_reward=to_a_billionth): (
        "step 1 gave the reward -1, and compute_reward of what it observed gives 0"
    ),
    odd(
        "ForgetsTheAxis",
        compute_reward=lambda s, a, d, i: -1.0 * (np.linalg.norm(a - d) > s.tolerance),
    ): "is not vectorised",
    odd("CloseGoals", unit=0.001): "its goals differ by 0.000. at most",
    odd("FarGoals", unit=1000): r"its goals lie beyond ±200 \(number 0\)",
    odd("ExitsInStep", step=raising(SystemExit())): "its step raised SystemExit",
    odd("ExitsInReset", reset=raising(SystemExit(0))): "its reset raised SystemExit: 0",
    odd(
        "ExitsAtOnce", __init__=raising(SystemExit("bye"))
    ): "cannot make .* its constructor raised SystemExit: bye",
    odd("ExitsInReward", compute_reward=raising(SystemExit())): r"no info \(SystemExit\)",
    odd("StopsIteration", step=raising(StopIteration())): "its step raised StopIteration",
    odd("OutOfMemory", step=raising(MemoryError())): "its step raised MemoryError",
    odd("Asserts", step=raising(AssertionError())): "its step raised AssertionError",
    odd("Lasting", 10**9): "--buffer-size must be 1000000000 or more",
}

STOPPED = {  # once training has begun
    odd("ShrinksLater", tolerance=3.0, reset=shrinks_without_seed): "compute_reward of what it",
    odd("ExitsLater", step=later(raising(SystemExit()))): "its step raised SystemExit",
    odd(
        "NaNLater", step=later(lambda s, o, *more: ({**o, "achieved_goal": s.x * np.nan}, *more))
    ): "NaN or Inf in its achieved_goal",
    odd(
        "GrowsLater", step=later(lambda s, o, *more: ({**o, "observation": np.zeros(2)}, *more))
    ): "its observation is",
    odd("RewardLater", step=later(lambda s, o, r, *more: (o, 1.0, *more))): "gave the reward 1$",
    odd(
        "OtherRewardLater", step=later(lambda s, o, r, *more: (o, -1.0 - r, *more))
    ): "compute_reward of what it observed gives",
    odd(
        "SuccessLater", step=later(lambda s, o, r, *_: (o, r, 0, 0, {"is_success": None}))
    ): "is_success of step . is None",
    odd(
        "MovesLater", step=later(lambda s, o, *more: ({**o, "desired_goal": -s.g}, *more))
    ): "its goal moved in step",
    odd(
        "CutLater", step=later(lambda s, o, r, a, b, i: (o, r, a, True, i))
    ): "cut an episode off after",
}


def arguments(env, folder, workers=1):
    some = {**SMALL, "env": env, "num_workers": workers, "out": folder, "epochs": 1}
    return [f"--{name.replace('_', '-')}={value}" for name, value in some.items()]


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    """The working folder; no line said yet."""
    monkeypatch.chdir(os.getcwd())
    remark.cache_clear()


@pytest.mark.parametrize("env", LEARNED)
def test_what_makes_no_difference_or_one_line(env, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if env != "DrawnGlobally-v0":
        plain = {**SMALL, "env": "Plain-v0", "epochs": 1, "out": str(tmp_path / "plain")}
        assert 0 < train(Config(**plain))[0]["train_success_rate"] < 1
    main(arguments(env, "run"))
    err = capfd.readouterr().err.splitlines()
    assert len(err) == bool(LEARNED[env]) and LEARNED[env] in "".join(err)
    ours = without_timing(tmp_path / "run")
    if env not in ("DrawnGlobally-v0", "FarObservations-v0", "CloseObservations-v0"):
        assert ours == without_timing(tmp_path / "plain")


@pytest.mark.parametrize("env", REFUSED)
def test_what_is_refused_before_anything_is_written(env, tmp_path, capfd):
    with pytest.raises(UsageError, match=REFUSED[env]):
        examine(env, fits=lambda task: assemble.refuse_what_does_not_fit(complete(Config()), task))
    with pytest.raises(SystemExit) as stop:
        main(arguments(env, tmp_path / "run"))
    assert stop.value.code == 2 and capfd.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("env", STOPPED)
def test_what_only_comes_later_stops_the_run(env, tmp_path, capfd):
    with pytest.raises(SystemExit) as stop:
        main(arguments(env, tmp_path / "run", workers=2))
    (line,) = capfd.readouterr().err.splitlines()
    assert stop.value.code == 1 and line.startswith(f"run.py: stopped in epoch 1: {env}: ")
    assert re.search(STOPPED[env], line), line


@pytest.mark.parametrize(
    ("name", "render", "message"),
    [
        ("DrawsNone", lambda self: None, "no picture .* but <class 'NoneType'>"),
        ("DrawsFloats", lambda self: np.zeros((9, 9, 3)), "no picture .* float64"),
        ("DrawsAList", lambda self: [np.zeros((9, 9, 3), np.uint8)], "no picture .* 'list'"),
        ("DrawsNothing", lambda self: np.zeros((0, 0, 3), np.uint8), "no picture"),
        ("DrawsGrey", lambda self: np.zeros((9, 9), np.uint8), "no picture"),
        ("DrawsNot", None, "its render raised NotImplementedError"),
        ("DrawsALot", raising(SystemExit()), "its render raised SystemExit"),
    ],
)
def test_pictures_that_are_none_are_refused_before_anything_is_played(
    name, render, message, tmp_path, capfd, monkeypatch
):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "as it was")
    env = odd(name, **({"render": render} if render else {}))
    main(arguments(env, tmp_path / "run"))
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        main([f"--play={tmp_path / 'run'}", f"--gif={tmp_path / 'a.gif'}"])
    out, err = capfd.readouterr()
    assert stop.value.code == 2 and out == "" and err.count("\n") == 1
    assert re.search(f"cannot draw {env} .*{message}", err), err
    assert not (tmp_path / "a.gif").exists() and os.environ["MUJOCO_GL"] == "as it was"


def test_a_reward_that_is_not_given_again_shows_in_the_last_step_and_after_a_reset():
    still = np.zeros(1, np.float32)
    for when in ("step", "reset"):
        env = make_env("Plain-v0")
        env.reset(seed=0)
        for _ in range(9 if when == "step" else 3):
            assert env.step(still)[1] == -1
        env.unwrapped.tolerance = 9
        with pytest.raises(EnvironmentFailed, match=r"step 1 gave the reward -1, .* gives 0 \("):
            env.step(still) if when == "step" else env.reset()


def test_the_environments_own_word_says_what_succeeded():
    env = make_env(odd("SaysYes", step=saying(lambda r: True)))
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(1, np.float32))
    assert reward == -1 and info["is_success"] is True


def test_pictures_are_copies():
    canvas = np.zeros((9, 9, 3), np.uint8)
    env = make_env(odd("DrawsInPlace", render=lambda self: canvas), render_mode="rgb_array")
    first = env.render()
    canvas[:] = 255
    assert not first.any() and env.render().all()


@pytest.mark.parametrize(("low", "high"), [(-0.7, 0.3), (0.1, 0.7), (-1e-3, 3e7)])
def test_no_action_leaves_the_bounds_by_rounding(low, high):
    box = gym.spaces.Box(low, high, (1,), np.float64)

    def step(self, action):
        assert box.contains(np.float64(action)), action
        return Line.step(self, 0 * action)

    env = make_env(odd(f"Bounds{low}".replace(".", ""), action_space=box, step=step))
    env.reset(seed=0)
    for action in (-1, 1, 0.3):
        env.step(np.float32([action]))


def test_what_cannot_be_made_in_a_worker_is_said_before_anything_is_written(tmp_path, capfd):
    """As where a port or a licence is taken."""
    main_process = os.getpid()

    def init(self, render_mode=None):
        Line.__init__(self)
        if os.getpid() != main_process:
            raise OSError("the port is taken")

    env = odd("OneOfAKind", __init__=init)
    with pytest.raises(SystemExit) as stop:
        main(arguments(env, tmp_path / "run", workers=2))
    err = capfd.readouterr().err
    assert stop.value.code == 2 and "could not be started" in err and "Traceback" not in err
    assert "the port is taken" in err and not (tmp_path / "run").exists()


def test_global_generators_follow_the_seed_in_each_process(tmp_path):
    """Two workers draw other goals, the same in each run; in tests too."""
    for name in ("a", "b"):
        main(arguments("DrawnGlobally-v0", tmp_path / name, workers=2))
    assert without_timing(tmp_path / "a") == without_timing(tmp_path / "b")
    with ParallelEnvs("DrawnGlobally-v0", 8, 2) as envs:
        envs.reset(2**32 - 3)  # beyond what NumPy takes
        envs.halves[0].reset()
        goals = envs.halves[0].wait()[0]["desired_goal"]
    assert len(np.unique(goals)) == 8


def test_an_environment_that_ignores_its_seed_is_said_to():
    def fresh(self, obs, info):
        self.x = np.random.default_rng().uniform(-1, 1, 1)
        return self.observe(), info

    def trembling(self, obs, *more):
        return {**obs, "observation": obs["observation"] + np.random.default_rng().normal()}, *more

    for env in (
        odd("IgnoresItsSeed", reset=reset_as(fresh)),
        odd("Trembles", step=stepped(trembling)),
    ):
        assert "it does not follow its seed" in examine(env).made
    assert "seed" not in examine("Plain-v0").made + examine("DrawnGlobally-v0").made


def test_the_papers_tasks_are_not_remarked_on(capfd):
    for name in ("FetchPush-v1", "FetchPush-v4", "FetchSilce-v1"):
        examine(name)
    assert capfd.readouterr().err == ""


def test_every_environment_of_a_run_is_closed(tmp_path):
    opened, closed = [], []

    def init(self, render_mode=None):
        Line.__init__(self)
        opened.append(self)

    env = odd("Counted", __init__=init, close=lambda self: closed.append(self))
    train(Config(**{**SMALL, "env": env}, epochs=1, out=str(tmp_path / "run")))
    assert len(opened) == 17 and {*map(id, opened)} == {*map(id, closed)}


def test_a_grown_observation_is_not_taken_for_a_damaged_checkpoint(tmp_path, capfd):
    env = odd("Changes")
    main(arguments(env, tmp_path / "run"))

    class Grown(Line):
        def __init__(self, render_mode=None):
            super().__init__()
            box = gym.spaces.Box(-2, 2, (2,), np.float64)
            self.observation_space = gym.spaces.Dict({**self.observation_space, "observation": box})

        observe = observing(observation=lambda x: np.append(x, 0))

    gym.registry.pop(env)
    gym.register(env, Grown, max_episode_steps=10)
    capfd.readouterr()
    for option in ("--resume", "--play"):
        with pytest.raises(SystemExit) as stop:
            main([f"{option}={tmp_path / 'run'}"])
        err = capfd.readouterr().err
        assert stop.value.code == 2 and "of other sizes" in err and "damaged" not in err


def test_where_rows_are_there_and_no_checkpoint_that_is_said(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / records.CHECKPOINT).unlink()
    with pytest.raises(UsageError, match=r"has 4 epochs in progress.csv and no checkpoint.pt"):
        assemble.restored(folder)


SPAWNED = """
import multiprocessing, sys
import gymnasium, run
from harness.testing import SMALL, Line
class Mine(Line):
    pass
if __name__ == "__main__":
    gymnasium.register("Mine-v0", Mine, max_episode_steps=10)
    multiprocessing.set_start_method("spawn")
    small = {**SMALL, "env": "Mine-v0", "num_workers": 2, "epochs": 1}
    print(len(run.train(run.Config(**small, out=sys.argv[1]))))
"""


def test_what_a_script_registers_is_known_to_processes_that_are_spawned(tmp_path):
    (tmp_path / "script.py").write_text(SPAWNED)
    code, out, err = finish(start(tmp_path / "run", script=tmp_path / "script.py"))
    assert code == 0 and out.splitlines()[-1] == "1", err


def test_a_module_that_is_called_like_one_of_the_projects_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "her.py").write_text("import gymnasium\n")
    with pytest.raises(UsageError, match=rf"the module is {HERE / 'her.py'}: if that is not yours"):
        make_env("her:Mine-v0")


def test_a_renderer_that_is_not_there_is_one_line():
    environment = {**os.environ, "MUJOCO_GL": "no such renderer"}
    done = subprocess.run(
        [sys.executable, HERE / "run.py", "--help"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "MUJOCO_GL" in done.stderr


def test_memory_is_what_the_process_may_have(monkeypatch):
    there = assemble.memory()
    used, limits = 4096 * int(Path("/proc/self/statm").read_text().split()[0]), resource.getrlimit
    allowed = used + 2**30
    monkeypatch.setattr(
        resource,
        "getrlimit",
        lambda kind: (allowed, -1) if kind == resource.RLIMIT_AS else limits(kind),
    )
    assert abs(assemble.memory() - min(2**30, there)) < 2**26
    task = examine("Plain-v0")
    needed = [
        assemble.memory_needed(complete(Config()), replace(task, horizon=steps))
        for steps in (10, 1010)
    ]
    assert needed[1] - needed[0] == 2 * 16 * 1000 * 4 * 3  # two collections by 16 environments
    with pytest.raises(UsageError, match=r"GB are needed .* lower --heads, --batch-size"):
        assemble.refuse_what_does_not_fit(complete(Config(buffer_size=10**9)), task)


def test_memory_that_runs_out_stops_the_run_in_one_line(tmp_path, monkeypatch, capfd):
    for error in (
        MemoryError("no room"),
        RuntimeError("alloc_cpu: can't allocate memory: 9 bytes"),
    ):
        monkeypatch.setattr(EnsembleDDPG, "update_targets", raising(error))
        with pytest.raises(SystemExit) as stop:
            main(arguments("Plain-v0", tmp_path / type(error).__name__))
        assert stop.value.code == 1 and capfd.readouterr().err.count("\n") == 1
