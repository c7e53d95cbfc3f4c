"""Tests of the border to environments that are somebody else's: `Line` with one thing changed each.

Either it learns what `Line` learns, or one line says what is wrong: before anything is written,
with exit code 2, or with 1 once training has begun.
"""

import multiprocessing
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv

from ensemble import EnsembleDDPG
from harness import assemble, records
from harness.border import remark
from harness.errors import EnvironmentFailed, UsageError
from harness.settings import Config, complete
from harness.tasks import examine, make_env
from harness.testing import SMALL, Line, main, without_timing
from harness.workers import ParallelEnvs
from run import train

ANY = np.finfo(np.float32)
NO_SERVER = RuntimeError("no\nserver.")


def odd(length=10, **changes):
    """The name of a `Line` with these methods and attributes in place of its own."""
    name = f"Odd{len(gym.registry)}-v0"
    gym.register(name, type("Odd", (Line,), changes), max_episode_steps=length)
    return name


def spaces(**others):
    return Dict({**Line.observation_space, **others})


def raising(error):
    def method(self, *args, **kwargs):
        raise error

    return method


def seeing(change, key="observation"):
    """An `observe` in which this key is `change` of the environment."""
    return lambda self: {**Line.observe(self), key: change(self)}


def aiming(change):
    return seeing(change, "desired_goal")


def saying(success):
    """A `stepped` whose is_success is this function of the reward."""
    return lambda s, o, r, a, b, i: (o, r, a, b, {"is_success": success(r)})


def ended_for_good(self, obs, reward, terminated, *more):
    """Says so in each step after a success, whatever happens then."""
    self.ended = reward == 0 or (self.t > 1 and self.ended)
    return obs, reward, self.ended, *more


def falls_later(self, obs, reward, terminated, truncated, info):
    """Ends in step 2 by its word on success, and in step 9 by a fall."""
    return obs, reward, self.t in (2, 9), truncated, {"is_success": self.t == 2}


def in_place(self, achieved_goal, desired_goal, info):
    """Works in what float32 goals are not copied into."""
    apart = np.asarray(desired_goal, np.float32)
    apart -= np.asarray(achieved_goal, np.float32)
    return -1.0 * (np.abs(apart)[..., 0] > self.tolerance)


def overwritten(self):
    """Observes in the same arrays each time."""
    self.arrays = getattr(self, "arrays", None) or {k: x + 0 for k, x in Line.observe(self).items()}
    for name, x in Line.observe(self).items():
        self.arrays[name][:] = x
    return self.arrays


def almost_there(self):
    """Nearer to the goal than float32 can tell."""
    return {**Line.observe(self), "achieved_goal": self.g + 1e-9}


def moves_the_action(self, action):
    result = Line.step(self, action)
    action.fill(9)
    return result


def drawn_globally(self, *, seed=None, options=None):
    Line.reset(self, seed=seed)
    self.x, self.g = np.random.uniform(-1, 1, 1), np.array([random.uniform(-1, 1)])  # noqa: NPY002
    return self.observe(), {}


def changes_folder(self, render_mode=None):
    os.chdir(tempfile.gettempdir())


class Nearer(gym.Wrapper):
    """A wrapper with a reward of its own, reached within 0.3, and no word on success."""

    def step(self, action):
        obs, *_ = self.env.step(action)
        return obs, self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}), 0, 0, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -1.0 * (np.abs(achieved_goal - desired_goal)[..., 0] > 0.3)


gym.register("Nearer-v0", lambda: Nearer(Line()), max_episode_steps=10)

PLAIN, DRAWN = odd(), odd(reset=drawn_globally)

LEARNED = [  # what is said of an environment, and another in which the same is learned
    ("", odd(compute_reward=in_place), PLAIN),
    ("", odd(observe=overwritten), PLAIN),
    ("", odd(step=moves_the_action), PLAIN),
    ("", odd(best=1.0), PLAIN),
    ("", odd(best=1.0, rewarded=lambda s, r: r == 1), PLAIN),
    ("", odd(rewarded=lambda s, r: np.int8(r)), PLAIN),
    ("", odd(stepped=lambda s, o, r, *more: (o, np.array(r), *more)), PLAIN),
    ("", odd(stepped=lambda s, o, r, a, b, i: (o, r, a, b, {})), PLAIN),
    ("", odd(stepped=lambda s, o, r, a, b, i: (o, r, r == 0, s.t == 10, i)), PLAIN),
    ("", odd(stepped=ended_for_good), PLAIN),
    ("", odd(stepped=saying(lambda r: 1.0 + r)), PLAIN),
    ("", odd(stepped=saying(lambda r: np.array([r == 0]))), PLAIN),
    ("", odd(observe=seeing(lambda s: [*s.x])), PLAIN),
    ("", odd(observe=seeing(lambda s: None, "image")), PLAIN),
    ("", "Nearer-v0", odd(tolerance=0.3)),
    ("", DRAWN, DRAWN),
    ("close raised RuntimeError: no server", odd(close=raising(NO_SERVER)), PLAIN),
    ("close raised SystemExit: 3", odd(close=raising(SystemExit(3))), PLAIN),
    ("[0] of its observation move only", odd(observe=seeing(lambda s: 999 + s.x)), None),
    (
        "[0] of its observation move only",
        odd(observe=seeing(lambda s: s.x / 999)),
        None,
    ),
    (
        "[1] of its goals move only",
        odd(
            observation_space=spaces(
                **{key: Box(-2, 2, (2,)) for key in ("achieved_goal", "desired_goal")}
            ),
            observe=lambda s: {
                **Line.observe(s),
                "achieved_goal": s.x * [1, 1e-3],
                "desired_goal": s.g * [1, 1e-3],
            },
        ),
        None,
    ),
]

REFUSED = [  # before anything is written
    ("creation raised RuntimeError: no server$", odd(__init__=raising(NO_SERVER))),
    ("spaces raised RuntimeError", odd(action_space=property(raising(NO_SERVER)))),
    ("it has no goals", odd(observation_space=Line.space)),
    ("it has no goals", odd(observation_space=Dict(observation=Line.space))),
    ("are not all flat Boxes", odd(observation_space=spaces(observation=Discrete(3)))),
    ("are not all flat Boxes", odd(observation_space=spaces(observation=Box(-1, 1, (2, 2))))),
    ("are not all flat Boxes", odd(observation_space=spaces(observation=Box(-1, 1, (0,))))),
    ("_goal differ in size", odd(observation_space=spaces(achieved_goal=Box(-2, 2, (2,))))),
    ("not a flat Box", odd(action_space=Discrete(3))),
    ("not a flat Box", odd(action_space=Box(-1, 1, (0,)))),
    ("not a flat Box", odd(action_space=Box(-1, 1, (2, 2)))),
    ("actions are whole numbers", odd(action_space=Box(0, 10, (1,), np.int64))),
    ("actions need bounds", odd(action_space=Box(-np.inf, 1, (1,)))),
    ("actions need bounds", odd(action_space=Box(np.float32([0, 1]), np.float32([1, 1])))),
    ("actions need bounds", odd(action_space=Box(ANY.min, ANY.max, (1,)))),
    ("give one, such as --episode-length 50", odd(length=None)),
    ("it has no compute_reward", odd(compute_reward=None)),
    ("it has no compute_reward", odd(compute_reward=property(raising(AttributeError())))),
    (r"no info \(KeyError: 'x'\)", odd(compute_reward=lambda s, a, d, i: i["x"])),
    (r"no info \(ValueError", odd(compute_reward=lambda s, a, d, i: ["near"] * len(a))),
    (r"it gave \[\[", odd(rewarded=lambda s, r: np.stack([r, r], -1))),
    (r"at once: .* it gave -?\d", odd(rewarded=lambda s, r: r.mean())),
    (r"it gave \[nan, nan, nan\]", odd(compute_reward=lambda s, a, d, i: [None] * len(a))),
    ("must give -1 and 0 ", odd(compute_reward=lambda s, a, d, i: -np.abs(a - d)[..., 0])),
    ("must give -1 and 0 ", odd(rewarded=lambda s, r: 5 + r)),
    ("dt raised RuntimeError", odd(dt=property(raising(NO_SERVER)))),
    ("reset raised TypeError", odd(reset=lambda s: Line.reset(s))),
    ("step raised ValueError: not enough", odd(stepped=lambda s, o, r, a, b, i: (o, r, a, i))),
    ("step raised SystemExit$", odd(step=raising(SystemExit()))),
    (r"is \(\) after step 0, its space says \(1,\)", odd(observe=seeing(lambda s: None))),
    (r"goal is \(1, 1\) after step 1", odd(observe=aiming(lambda s: np.ones((1,) * (1 + s.t))))),
    ("reset raised ValueError: could not", odd(observe=seeing(lambda s: ["far"]))),
    ("NaN or Inf in its observation after step 0", odd(observe=seeing(lambda s: s.x * np.nan))),
    ("NaN or Inf in its observation after step 0", odd(observe=seeing(lambda s: s.x * 1e300))),
    ("NaN or Inf in its desired_goal after step 0", odd(observe=aiming(lambda s: s.g * np.inf))),
    ("is_success of step 1 is None, not", odd(stepped=saying(lambda r: None))),
    ("is_success of step 1 is nan, not", odd(stepped=saying(lambda r: np.nan))),
    ("step 1 gave the reward -0.5$", odd(stepped=lambda s, o, r, *more: (o, -0.5, *more))),
    ("step 1 gave the reward nan$", odd(stepped=lambda s, o, r, *more: (o, np.nan, *more))),
    ("goal moved in step 3;", odd(observe=aiming(lambda s: s.g + s.t // 3))),
    ("in step 9 of 10 without success", odd(stepped=falls_later)),
    ("in step 1 of 10 without success", odd(stepped=lambda s, o, r, a, b, i: (o, r, r < 0, b, i))),
    ("try --episode-length 5", odd(stepped=lambda s, o, r, a, b, i: (o, r, a, s.t == 5, i))),
    (r"\(10, 1\) goals gave \(3,\)", odd(rewarded=lambda s, r: r[:3] if r.ndim else r)),
    ("compute_reward gave 1", odd(rewarded=lambda s, r: r + 2 * (np.size(r) > 9))),
    ("compute_reward gave nan", odd(rewarded=lambda s, r: r * (1 if np.size(r) < 9 else np.nan))),
    (
        "needs a compute_reward of",
        odd(tolerance=9, stepped=lambda s, o, r, *more: (o, -1.0, *more)),
    ),
    ("reward -1, and .* gives 0", odd(tolerance=0.5, rewarded=lambda s, r: r * (s.resets < 6))),
    ("reward -1, .* gives 0", odd(tolerance=0, observe=almost_there)),
    ("its goals move beyond ±200 or by less than 0.01", odd(unit=0.001)),
    ("its goals move beyond ±200 or by less than 0.01", odd(unit=1000)),
    ("GB are needed .* or --episode-length", odd(length=10**12)),  # and not played
]

STOPPED = [  # once training has begun: in the second episode or the first
    ("ended in step 1 of", odd(stepped=lambda s, o, r, a, b, i: (o, r, s.unseeded > 2, b, {}))),
    ("step raised SystemExit: 3", odd(rewarded=lambda s, r: r if s.unseeded < 2 else sys.exit(3))),
    (
        "NaN or Inf in its desired_goal",
        odd(observe=aiming(lambda s: s.g * (1 if s.unseeded < 3 else np.inf))),
    ),
    ("gave nan", odd(rewarded=lambda s, r: r * (1 if r.ndim < 1 or s.unseeded < 2 else np.nan))),
]


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    """The working folder; no line said yet."""
    monkeypatch.chdir(os.getcwd())
    remark.cache_clear()


def arguments(env, folder, workers=1):
    some = {**SMALL, "env": env, "num_workers": workers, "out": folder, "epochs": 1}
    return [f"--{name.replace('_', '-')}={value}" for name, value in some.items()]


def ended(capfd, *argv):
    """How the command line ends: the exit code, what is on stdout and on stderr."""
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(argv)
    return stop.value.code, *capfd.readouterr()


def played(env):
    """All that `Border` hands out in two episodes, as it is afterwards, and the rewards again."""
    env, seen, results = make_env(env), [], []
    for seed in (0, 4):
        seen.append(env.reset(seed=seed)[0])
        for _ in range(10):
            action = np.sign(seen[-1]["desired_goal"] - seen[-1]["achieved_goal"]) / 2
            given = action.copy()
            obs, reward, *_, info = env.step(action)
            assert action == given and type(info["is_success"]) is bool
            seen.append(obs)
            results.append((reward, info["is_success"]))
    rows = {key: np.array([obs[key] for obs in seen]) for key in seen[0]}
    assert all(x.dtype == np.float32 for x in rows.values()) and len(set(results)) == 2
    return results, env.compute_reward(rows["achieved_goal"], rows["desired_goal"]), rows


@pytest.mark.parametrize(("line", "env", "like"), LEARNED)
def test_what_makes_no_difference_or_one_line(line, env, like, capfd):
    if like:
        np.testing.assert_equal(played(env), played(like))
    for _ in range(2):
        examine(env).close()
    err = capfd.readouterr().err
    assert err.count("\n") == bool(line) and line in err and env in (err or env)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_with_all_of_these_trains_as_one_without(
    workers, tmp_path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    changes = {"observe": seeing(lambda s: None, "image"), "__init__": changes_folder}
    changes["stepped"] = lambda s, o, r, *more: (o, r, r == 1, s.t == 10, {})
    env = odd(best=1.0, close=raising(NO_SERVER), **changes)
    main(arguments(PLAIN, "plain", workers))
    main(arguments(env, "run", workers))
    (line,) = {*capfd.readouterr().err.splitlines()}  # of each process
    assert line.startswith(f"run.py: {env}: ") and "close raised RuntimeError: no server" in line
    (row,) = without_timing(tmp_path / "plain")
    assert 0 < row["train_success_rate"] < 1 and row["env_steps"] == 3 * 16 * 10
    assert without_timing(tmp_path / "run") == [row]


@pytest.mark.parametrize(("message", "env"), REFUSED)
def test_what_is_refused_before_anything_is_written(message, env, tmp_path, capfd):
    code, out, err = ended(capfd, *arguments(env, tmp_path / "run"))
    assert code == 2 and out == "" and err.count("\n") == 1 and re.search(message, err), err
    assert "EnvironmentFailed" not in err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(("message", "env"), STOPPED)
def test_what_only_comes_later_stops_the_run(workers, message, env, tmp_path, capfd):
    code, _, err = ended(capfd, *arguments(env, tmp_path / "run", workers))
    assert code == 1 and err.startswith(f"run.py: stopped in epoch 1: {env}: ")
    assert err.count("\n") == 1 and re.search(message, err), err
    assert not multiprocessing.active_children() and threading.active_count() == 1


@pytest.mark.parametrize(
    ("message", "render"),
    [
        ("no picture but None", lambda self: None),
        (r"no picture .* \(1, 9, 9, 3\)", lambda self: [np.zeros((9, 9, 3), np.uint8)]),
        ("no picture", lambda self: np.zeros((9, 9), np.uint8)),
        ("no picture .* float64", lambda self: np.zeros((9, 9, 3))),
        ("no picture", lambda self: np.zeros((0, 0, 3), np.uint8)),
        ("no picture", lambda self: np.zeros((9, 9, 4), np.uint8)),
        ("render raised NotImplementedError", Line.render),  # gymnasium's, where there is no other
    ],
)
def test_pictures_that_are_none_are_refused(message, render):
    with pytest.raises(EnvironmentFailed, match=message):
        make_env(odd(render=render)).render()


def test_what_cannot_be_drawn_is_refused_before_anything_is_played(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "as it was")
    main(arguments(PLAIN, tmp_path / "run"))
    picture = tmp_path / "a.gif"
    code, out, err = ended(capfd, f"--play={tmp_path / 'run'}", f"--gif={picture}")
    assert code == 2 and out == "" and err.count("\n") == 1 and f"cannot draw {PLAIN} (" in err
    assert not picture.exists() and os.environ["MUJOCO_GL"] == "as it was"


def test_pictures_are_copies_and_a_window_gives_none():
    canvas = np.zeros((9, 9, 3), np.uint8)
    env = make_env(odd(render=lambda self: canvas))
    first = env.render()
    canvas[:] = 255
    assert not first.any() and env.render().all()
    assert make_env(odd(render=lambda self: None), render_mode="human").render() is None


@pytest.mark.parametrize("when", ["step", "reset"])
def test_a_reward_that_is_not_given_again_shows_in_the_last_step_and_after_a_reset(when):
    env, still = make_env(PLAIN), np.zeros(1, np.float32)
    env.reset(seed=0)
    for _ in range(9 if when == "step" else 3):
        assert env.step(still)[1] == -1
    env.unwrapped.tolerance = 9
    with pytest.raises(EnvironmentFailed, match=r"step 1 gave the reward -1, .* gives 0 \("):
        env.step(still) if when == "step" else env.reset()


def test_the_environments_own_word_says_what_succeeded():
    env = make_env(odd(tolerance=0, stepped=saying(lambda r: True)))
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(1, np.float32))
    assert reward == -1 and info["is_success"] is True


def test_what_cannot_be_made_in_a_worker_is_said_before_anything_is_written(
    tmp_path, capfd, monkeypatch
):
    """As where a port or a licence is taken, or there can be no more processes."""
    main_process = os.getpid()

    def init(self, render_mode=None):
        if os.getpid() != main_process:
            raise OSError("the port is taken")

    code, _, err = ended(capfd, *arguments(odd(__init__=init), tmp_path / "run", workers=2))
    assert code == 2 and "could not be started" in err and "Traceback" not in err
    assert "the port is taken" in err and not (tmp_path / "run").exists()
    monkeypatch.setattr("harness.assemble.ParallelEnvs", raising(OSError("no process left")))
    code, _, err = ended(capfd, *arguments(PLAIN, tmp_path / "run", workers=2))
    assert code == 2 and "the run cannot be set up: OSError: no process left" in err


@pytest.mark.parametrize(("low", "high"), [(-0.7, 0.3), (-1, 0.7), (-1e-3, 3e7)])
def test_actions_are_rescaled_to_the_bounds_and_do_not_leave_them_by_rounding(low, high):
    box, taken = Box(np.array([low, -1]), np.array([high, 9]), dtype=np.float64), []

    def step(self, action):
        taken.append(action)
        return Line.step(self, 0 * action[:1])

    env = make_env(odd(action_space=box, step=step))
    env.reset(seed=0)
    for action in ([-1, -1], [0.3, 0], [1, 1]):
        env.step(np.float32(action))
        assert box.contains(np.float64(taken[-1]))
    part = (np.array(taken) - [low, -1]) / [high - low, 10]
    np.testing.assert_allclose(part, [[0, 0], [0.65, 0.5], [1, 1]], atol=1e-6)


def test_what_is_said_of_an_environment():
    trembles = odd(observe=seeing(lambda s: s.x + np.random.default_rng().normal() * (s.t == 10)))
    for env, more in (
        (PLAIN, ""),
        (DRAWN, ""),
        (odd(best=1.0), "; its rewards of 0 and 1 count as -1 and 0"),
        (trembles, "; it does not follow its seed, so that runs differ"),
    ):
        assert examine(env).made == f"{env}: 10 steps an episode{more}"


@pytest.mark.parametrize(("tolerance", "episodes"), [(0, 8 + 1), (9, 1 + 1)])
def test_as_many_episodes_are_examined_as_it_takes_to_reach_a_goal(tolerance, episodes):
    """And the first one again, to see whether the seed decides all of it."""
    steps = []

    def step(self, action):
        steps.append(action)
        return Line.step(self, action)

    examine(odd(tolerance=tolerance, step=step))
    assert len(steps) == episodes * 10


def test_what_a_script_registers_is_known_to_processes_that_are_not_forked(monkeypatch):
    def elsewhere(name, **settings):
        gym.registry.pop(name)
        return make_env(name, **settings)

    monkeypatch.setattr("harness.workers.make_env", elsewhere)
    with ParallelEnvs(odd(), 1, 1) as envs:
        envs.reset(0)


@pytest.mark.slow
def test_workers_can_be_spawned(monkeypatch):
    monkeypatch.setattr("harness.workers.AsyncVectorEnv", partial(AsyncVectorEnv, context="spawn"))
    with ParallelEnvs(odd(), 2, 2) as envs:
        envs.reset(0)


def test_global_generators_follow_the_seed_in_each_process():
    """Two workers draw other numbers, the same each time."""
    drawn = []
    for _ in range(2):
        with ParallelEnvs(DRAWN, 8, 2) as envs:
            envs.reset(2**32 - 3)  # beyond what NumPy takes
            envs.halves[0].reset()
            drawn.append(envs.halves[0].wait()[0])
    np.testing.assert_equal(*drawn)
    for key in ("observation", "desired_goal"):
        assert len(np.unique(drawn[0][key])) == 8


def test_every_environment_is_closed(tmp_path):
    opened, closed = [], []
    changes = {"__init__": lambda s, **_: opened.append(s), "close": lambda s: closed.append(s)}
    small = Config(**{**SMALL, "env": odd(**changes)}, epochs=1, out=str(tmp_path / "run"))
    train(small)
    assert len(opened) == 17 and {*map(id, opened)} == {*map(id, closed)}
    with pytest.raises(UsageError):
        examine(odd(**changes, step=raising(NO_SERVER)))
    assert len(opened) == 18 and closed[-1] is opened[-1]


def test_a_grown_observation_is_not_taken_for_a_damaged_checkpoint(tmp_path, capfd):
    env = odd()
    main(arguments(env, tmp_path / "run"))
    grown = spaces(observation=Box(-2, 2, (2,)))
    other = odd(observation_space=grown, observe=seeing(lambda s: np.append(s.x, 0)))
    gym.registry[env] = replace(gym.registry[other], id=env)
    for option in ("--resume", "--play"):
        code, _, err = ended(capfd, f"{option}={tmp_path / 'run'}")
        assert code == 2 and "of other sizes" in err and "damaged" not in err


def test_where_rows_are_there_and_no_checkpoint_that_is_said(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / records.CHECKPOINT).unlink()
    before = (folder / "progress.csv").read_bytes()
    for resumed_or_played in (
        lambda: assemble.restored(folder),
        lambda: train(Config(**SMALL, epochs=9, out=str(folder)), resume=True),
    ):
        with pytest.raises(UsageError, match=r"has 4 epochs in progress.csv and no checkpoint.pt"):
            resumed_or_played()
    assert (folder / "progress.csv").read_bytes() == before


def test_memory_is_what_the_process_may_have(monkeypatch):
    there, limits = assemble.memory(), resource.getrlimit
    allowed = 4096 * int(Path("/proc/self/statm").read_text().split()[0]) + 2**30
    lowered = lambda kind: (allowed, -1) if kind == resource.RLIMIT_AS else limits(kind)  # noqa: E731
    monkeypatch.setattr(resource, "getrlimit", lowered)
    assert abs(assemble.memory() - min(2**30, there)) < 2**26


def test_what_does_not_fit_into_the_memory_is_refused():
    task, config = examine(PLAIN), complete(Config())
    less = assemble.memory_needed(config, task)
    task.horizon = 1010
    more = assemble.memory_needed(config, task)
    assert more - less == 2 * 16 * 1000 * 4 * 3  # two collections by 16 environments
    with pytest.raises(UsageError, match=r"GB are needed .* lower --heads, --batch-size"):
        assemble.refuse_what_does_not_fit(complete(Config(buffer_size=10**13)), task)


@pytest.mark.parametrize(
    "error", [MemoryError("no room"), RuntimeError("can't allocate memory: 9")]
)
def test_memory_that_runs_out_stops_the_run_in_one_line(error, tmp_path, monkeypatch, capfd):
    with pytest.raises(UsageError, match="the run cannot be set up: MemoryError: no room"):
        examine(PLAIN, fits=raising(MemoryError("no room")))
    monkeypatch.setattr(EnsembleDDPG, "update_targets", raising(error))
    code, _, err = ended(capfd, *arguments(PLAIN, tmp_path / "run"))
    assert code == 1 and err.count("\n") == 1
