"""Tests of the names, of what is refused, and of goal environments as they are out there."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import run
from ensemble import EnsembleDDPG
from harness import settings
from harness.errors import EnvironmentFailed, UsageError
from harness.tasks import PAPER_ENVS, examine, make_env
from harness.testing import SMALL_TRAINING, Line, Tracker, main
from harness.workers import ParallelEnvs
from her import EpisodeBuffer
from run import Config, train
from vcp import HERBuffer, update_her_buffer


def test_the_papers_names():
    assert len(PAPER_ENVS) == 16
    assert make_env("FetchSilce-v1").spec.id == "FetchSlide-v4"  # as Appendix A misprints them
    assert make_env("FetchPickAndPlac-v1").spec.id == "FetchPickAndPlace-v4"
    assert make_env("FetchPush-v4").spec.max_episode_steps == 50
    assert make_env("HandManipulateEggFull-v1").spec.max_episode_steps == 100  # its own length
    assert make_env("HandManipulateEggFull-v0").spec.max_episode_steps == 50  # the paper's
    assert "HandReach-v3" in examine("HandReach-v0").made
    assert (examine("HandReach-v0").dt, examine("Tracker-v0").dt) == (0.04, 1)  # or unknown


class Unlearnable(Tracker):
    """`Tracker` with one thing changed."""

    def __init__(self, **changes):
        for name, value in changes.items():
            setattr(self, name, value)


gym.register("Unlearnable-v0", Unlearnable, max_episode_steps=7)


gym.register("Endless-v0", Tracker)


def test_actions_are_rescaled_to_the_environments_bounds():
    env = make_env("Tracker-v0")
    env.reset(seed=0)
    for action, expected in (([-1, -1], [0, -5]), ([1, 1], [10, 5]), ([0, 0.5], [5, 2.5])):
        env.step(np.float32(action))
        np.testing.assert_allclose(env.unwrapped.last, expected)


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({"observation_space": gym.spaces.Box(-1, 1, (3,))}, "no goals"),
        ({"action_space": gym.spaces.Discrete(3)}, "not a flat Box"),
        ({"action_space": gym.spaces.Box(-np.inf, np.inf, (2,))}, "no bounds"),
        ({"compute_reward": None}, "no compute_reward"),
        ({"compute_reward": lambda a, d, i: -1.0}, "not vectorised"),
        ({"compute_reward": lambda a, d, i: -np.abs(a - d)[:, 0]}, "-1 and 0"),
        ({"compute_reward": lambda a, d, i: 2.0 * (a == d)[:, 0]}, "-1 and 0"),
    ],
)
def test_environments_that_cannot_be_learned(changes, missing):
    with pytest.raises(UsageError, match=missing):
        make_env("Unlearnable-v0", **changes)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("CartPole-v1", "has no goals"),
        ("Endless-v0", "no episode length"),
        ("FetchReach-v9", "the nearest names are .*FetchReach-v4"),
        ("FetchRaech-v1", "the nearest names are .*FetchReach-v1"),
        ("FetchReach-v2", "FetchReach-v4"),  # deprecated
        ("no_such_module:Env-v0", "no_such_module"),
        ("FetchReachDense-v4", "-1 and 0"),
        ("", "cannot make"),
    ],
)
def test_names_that_cannot_be_made(name, message):
    with pytest.raises(UsageError, match=message) as error:
        make_env(name)
    assert "\n" not in str(error.value)


def test_an_environment_from_outside_trains(tmp_path):
    (row,) = train(
        Config(**SMALL_TRAINING, env="Tracker-v0", num_workers=1, out=str(tmp_path / "run"))
    )
    assert row["env_steps"] == 3 * 16 * 7


def test_a_module_and_its_id_name_an_environment(tmp_path, monkeypatch):
    text = "import gymnasium, harness.testing\n"
    text += "gymnasium.register('Own-v0', harness.testing.Tracker, max_episode_steps=5)\n"
    (tmp_path / "own_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert make_env("own_module:Own-v0").spec.max_episode_steps == 5


@pytest.mark.parametrize("name", PAPER_ENVS)
def test_one_cycle_of_each_of_the_sixteen(name):
    """Collect, relabel, score, update: shapes, rewards, episode length."""
    env = make_env(name)
    dims = {k: env.observation_space[k].shape[0] for k in ("observation", "desired_goal")}
    obs_dim, goal_dim = dims.values()
    action_dim = env.action_space.shape[0]
    assert env.spec.max_episode_steps == 50
    assert (obs_dim, goal_dim, action_dim) == {
        "Fetch": (25, 3, 4),
        "HandR": (63, 15, 20),
        "HandM": (61, 7, 20),
        "Reach": (8, 2, 2),
        "Point": (2, 2, 2),
    }[name[:5]] or name == "FetchReach-v1"
    agent = EnsembleDDPG(obs_dim, goal_dim, action_dim, gamma=0.98, num_heads=2)
    rng = np.random.default_rng(0)
    with ParallelEnvs(name, 2, 1) as envs:
        envs.reset(0)
        noise = run.exploration(rng, (50, 2, action_dim), 0.2, 0.3)
        policy = run.acting_heads(agent, 2, 2, noise)
        episodes, success = run.rollout(envs, policy, 50)
    assert episodes["obs"].shape == (2, 51, obs_dim) and success.shape == (2,)
    assert episodes["achieved_goal"].shape == (2, 51, goal_dim)
    dims = (obs_dim, goal_dim, action_dim)
    original = EpisodeBuffer(1000, 50, *dims, 0.8, env.compute_reward)
    original.add(episodes, rng)
    buffer = HERBuffer(256, 9.0)
    update_her_buffer(buffer, original, agent.q_variance, 256, rng)
    rewards = buffer.data["reward"]
    assert set(np.unique(rewards)) == {-1.0, 0.0} and rewards.dtype == np.float32
    for k in range(2):
        assert torch.isfinite(agent.update_head(k, buffer.sample(64, rng))).all()


# ---------------------------------------------------------------------- other goal environments


class EndsAtSuccess(Line):
    tolerance = 0.4

    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, info["is_success"], False, info


class Falls(Line):
    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, self.t == 6, False, info


class HasAClock(Line):
    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, False, self.t == 5, info


class NeedsInfo(Line):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return super().compute_reward(achieved_goal, desired_goal, info) + info["tolerance"]


class OnePairAtATime(Line):
    def compute_reward(self, achieved_goal, desired_goal, info):
        assert achieved_goal.shape == (1,), achieved_goal.shape
        return super().compute_reward(achieved_goal, desired_goal, info)


class GoalMoves(Line):
    tolerance = 0.4

    def step(self, action):
        _, reward, *rest = super().step(action)
        if reward == 0:
            self.g = self.np_random.uniform(-1, 1, 1)
        return self.observe(), reward, *rest


class Millimetres(Line):
    unit = 1000


class Raises(Line):
    where = "step"

    def reset(self, **kwargs):
        if self.where == "reset":
            raise RuntimeError("no table\nleft")
        return super().reset(**kwargs)

    def step(self, action):
        if self.where == "step" and self.t == 3:
            raise RuntimeError("no table\nleft")
        return super().step(action)


class RaisesInReset(Raises):
    where = "reset"


class RaisesAtOnce(Line):
    def __init__(self, render_mode=None):
        raise RuntimeError("no table\nleft")


class TwoGoals(Line):
    def __init__(self, render_mode=None):
        super().__init__()
        self.observation_space["achieved_goal"] = gym.spaces.Box(-2, 2, (2,), np.float64)


class OtherShape(Line):
    def observe(self):
        return {**super().observe(), "observation": np.zeros(3)}


class NoWidth(Line):
    def __init__(self, render_mode=None):
        super().__init__()
        self.action_space = gym.spaces.Box(np.float32([1]), np.float32([1]))


class ZeroAndOne(Line):
    best = 1.0


class WithAnImage(Line):
    """Other keys are nobody's business."""

    def __init__(self, render_mode=None):
        super().__init__()
        space = dict(self.observation_space.spaces, image=gym.spaces.Discrete(3))
        self.observation_space = gym.spaces.Dict(space)

    def observe(self):
        return {**super().observe(), "image": 1}


class WideLine(Line):
    tolerance = 0.4


class FarLine(Line):
    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.x, self.g = np.array([-0.9]), np.array([0.9])
        return self.observe(), {}


class InCentimetres(gym.ObservationWrapper):
    def observation(self, obs):
        return {name: 100 * x for name, x in obs.items()}


class MeantForRewards(gym.Wrapper):
    """A wrapper with a reward of its own: reached within 0.3."""

    def step(self, action):
        obs, _, *rest = self.env.step(action)
        near = abs(obs["achieved_goal"] - obs["desired_goal"])[0] <= 0.3
        return obs, float(near) - 1, *rest[:-1], {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.abs(achieved_goal - desired_goal)[..., 0] > 0.3).astype(float)


ODD = [Line, EndsAtSuccess, Falls, HasAClock, NeedsInfo, OnePairAtATime, GoalMoves, Millimetres]
ODD += [Raises, RaisesInReset, RaisesAtOnce, TwoGoals, OtherShape, NoWidth, ZeroAndOne, WithAnImage]
for odd in ODD:
    gym.register(f"{odd.__name__}-v0", odd, max_episode_steps=10)
gym.register("Centimetres-v0", lambda **k: InCentimetres(WideLine(**k)), max_episode_steps=10)
gym.register("Wrapped-v0", lambda **k: MeantForRewards(Line(**k)), max_episode_steps=10)
gym.register("NoLength-v0", Line)
gym.register("FarCentimetres-v0", lambda **k: InCentimetres(FarLine(**k)), max_episode_steps=4)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Falls", "an episode ended in step 6 of 10 without success"),
        ("HasAClock", "cut an episode off after 5 of 10 steps; try --episode-length 5"),
        ("NeedsInfo", r"not take a batch of goals and no info \(KeyError: 'tolerance'\)"),
        ("OnePairAtATime", r"no info \(AssertionError: \(3, 1\)"),
        ("GoalMoves", "its goal moved in step"),
        ("Millimetres", "its goals lie beyond ±200"),
        ("Centimetres", "gave the reward .* a compute_reward of its own"),
        ("Raises", "its step raised RuntimeError: no table left"),
        ("RaisesInReset", "its reset raised RuntimeError: no table left"),
        ("RaisesAtOnce", "cannot make .* RuntimeError: no table left"),
        ("TwoGoals", "achieved_goal and desired_goal differ in size"),
        ("OtherShape", r"its observation is \(3,\) after step 0, its space says \(1,\)"),
        ("NoWidth", "its actions have no width"),
        ("NoLength", "give one, such as --episode-length 50"),
    ],
)
def test_what_would_be_learned_wrongly_is_refused_before_anything_is_written(
    name, message, tmp_path
):
    with pytest.raises(UsageError, match=message) as error:
        train(Config(**SMALL_TRAINING, env=f"{name}-v0", out=str(tmp_path / "run")))
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["Line", "EndsAtSuccess", "ZeroAndOne", "WithAnImage", "Wrapped"])
@pytest.mark.parametrize("workers", [1, 2])
def test_goal_environments_as_they_are_out_there_train(name, workers, tmp_path):
    settings = {**SMALL_TRAINING, "num_workers": workers, "out": str(tmp_path / "run")}
    (row,) = train(Config(**settings, env=f"{name}-v0"))
    assert row["env_steps"] == 3 * 16 * 10


def test_an_episode_that_ends_at_success_is_played_on():
    """All of its 10 steps, and success is read at the last of them."""
    with ParallelEnvs("EndsAtSuccess-v0", 4, 1) as envs:
        envs.reset(0)
        to_the_goal = lambda t, rows, obs, goal: (goal - obs) / 0.2 if t < 7 else -np.sign(goal)  # noqa: E731
        episodes, success = run.rollout(envs, to_the_goal, 10)
    assert episodes["action"].shape == (4, 10, 1)
    away = np.abs(episodes["obs"][:, -1] - episodes["desired_goal"])[:, 0]
    np.testing.assert_array_equal(success, away <= 0.4)
    assert (episodes["obs"][:, 10] != episodes["obs"][:, 8]).all() and not success.all()


def test_rewards_of_0_and_1_count_as_those_of_eq_1():
    task = examine("ZeroAndOne-v0")
    assert "count as -1 and 0" in task.made and "count as" not in examine("Line-v0").made
    goals = np.array([[0.0], [0.05], [0.5]])
    np.testing.assert_array_equal(task.reward_fn(goals, np.zeros((3, 1))), [0, 0, -1])
    env = make_env("ZeroAndOne-v0")
    env.reset(seed=0)
    assert {env.step(np.float32([0]))[1] for _ in range(5)} <= {-1.0, 0.0}


def test_a_wrappers_own_reward_is_what_is_learned_from():
    goals = np.array([[0.0], [0.2], [0.5]])
    rewards = examine("Wrapped-v0").reward_fn(goals, np.zeros((3, 1)))
    np.testing.assert_array_equal(rewards, [0, 0, -1])
    rewards = examine("Line-v0").reward_fn(goals, np.zeros((3, 1)))
    np.testing.assert_array_equal(rewards, [0, -1, -1])


def test_without_is_success_the_reward_says_what_succeeded():
    with ParallelEnvs("Wrapped-v0", 8, 1) as envs:
        envs.reset(0)
        to_most_goals = lambda t, rows, obs, goal: np.clip((goal - obs) / 0.2, -0.3, 0.3)  # noqa: E731
        episodes, success = run.rollout(envs, to_most_goals, 10)
    away = np.abs(episodes["obs"][:, -1] - episodes["desired_goal"])[:, 0]
    np.testing.assert_array_equal(success, away <= 0.3)
    assert success.any() and not success.all()


def test_the_episode_length_can_be_given(tmp_path):
    assert examine("NoLength-v0", 7).horizon == 7 and examine("FetchReach-v1", 20).horizon == 20
    assert examine("HasAClock-v0", 5).horizon == 5  # its own clock's last step is no early end
    for name, length in (("NoLength-v0", 7), ("HasAClock-v0", 5)):
        settings = {**SMALL_TRAINING, "num_workers": 1, "out": str(tmp_path / name)}
        (row,) = train(Config(**settings, env=name, episode_length=length))
        assert row["env_steps"] == 3 * 16 * length


@pytest.mark.parametrize("workers", [1, 2])
def test_what_only_shows_later_stops_the_run_in_one_line(workers, tmp_path, capfd):
    """An environment that falls once its process has played a hundred steps."""
    arguments = [f"{settings.flag(k)}={v}" for k, v in SMALL_TRAINING.items()]
    folder = tmp_path / "run"
    more = ["--env=FallsLater-v0", f"--num-workers={workers}", f"--out={folder}", "--epochs=9"]
    with pytest.raises(SystemExit) as stop:
        main([*arguments, *more])
    assert stop.value.code == 1
    err = [line for line in capfd.readouterr().err.splitlines() if "FallsLater" in line]
    (line,) = err
    assert "FallsLater-v0: an episode ended in step" in line
    assert line.endswith(f"run.py --resume {folder}")


def test_a_reward_that_is_not_the_stored_ones_shows_at_the_end_of_an_episode():
    """Where the goal is not reached while `examine` looks."""
    assert examine("FarCentimetres-v0").horizon == 4
    with pytest.raises(EnvironmentFailed, match=r"step \d gave the reward"):
        with ParallelEnvs("FarCentimetres-v0", 4, 1) as envs:
            envs.reset(0)
            for _ in range(20):
                run.rollout(envs, lambda t, rows, obs, goal: (goal - obs) / 25, 4)


class FallsLater(Line):
    played = 0

    def step(self, action):
        self.played += 1
        obs, reward, _, _, info = super().step(action)
        return obs, reward, self.played == 65 and reward < 0, False, info


gym.register("FallsLater-v0", FallsLater, max_episode_steps=10)


def test_the_pen_tasks_say_that_their_reward_is_odd():
    """gymnasium-robotics leaves the rotation about the pen's axis out of the third row of a batch
    alone; where it does so for each, this test and the exception for the Pen tasks can go."""
    env = make_env("HandManipulatePenRotate-v0")
    rng, pairs = np.random.default_rng(0), []
    for seed in range(4):
        obs, _ = env.reset(seed=seed)
        for _ in range(20):
            obs, *_ = env.step(rng.uniform(-1, 1, 20))
            pairs.append(obs["achieved_goal"])
    achieved, goal = np.array(pairs), np.roll(pairs, 1, axis=0)
    alone = [
        float(env.unwrapped.compute_reward(a, g, {})) for a, g in zip(achieved, goal, strict=True)
    ]
    assert not np.array_equal(env.unwrapped.compute_reward(achieved, goal, {}), alone)
    assert "NOTES.md" in examine("HandManipulatePenRotate-v0").made
