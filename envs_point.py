"""The environments of Appendix A that are ours: PointMass and the sparse Reacher. Importing this
module registers them with gymnasium. Lengths are in metres.

Goal environments: the observation is a dict of "observation", "achieved_goal" and "desired_goal",
and `compute_reward(achieved, desired, info)` is Eq. (1): 0 where the goal is reached, else -1.
"""

import math

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv
from gymnasium.spaces import Box


def goal_space(obs_dim: int, goal_dim: int, bound: float = np.inf) -> gym.spaces.Dict:
    """The observation space of a goal environment, float64, all entries within ±bound."""
    goal = Box(-bound, bound, (goal_dim,), np.float64)
    observation = Box(-bound, bound, (obs_dim,), np.float64)
    return gym.spaces.Dict(observation=observation, achieved_goal=goal, desired_goal=goal)


def sparse_reward(achieved: np.ndarray, desired: np.ndarray, threshold: float) -> np.ndarray:
    """Eq. (1): r = [ψ(s) == g] - 1, where "==" means within `threshold`. (..., G) -> (...)."""
    distance = np.sqrt(np.square(achieved - desired).sum(axis=-1))
    return (distance <= threshold).astype(np.float32) - 1


# -------------------------------------------------------------------------------- PointMass

ROOM = 0.6  # the room is [-0.6, 0.6]²
RADIUS = 0.05  # of the circle that is moved
REACH = ROOM - RADIUS  # as far out as the circle's centre gets
STEP = 0.05  # moved per unit of action, in each axis
WALL_END, WALL_RADIUS = 0.2, 0.03  # the wall: all points within 0.03 of x <= 0.2, y = 0
CLEARANCE = WALL_RADIUS + RADIUS  # the circle's centre stays this far from the wall's axis


def inside_wall(x: float, y: float) -> bool:
    """Whether a circle centred at (x, y) overlaps the wall (touching is not overlapping)."""
    return math.hypot(max(x - WALL_END, 0.0), y) < CLEARANCE


def slide_along_wall(x: float, y: float, to_x: float, to_y: float) -> tuple[float, float]:
    """Where the centre gets from (x, y) towards (to_x, to_y): up to the wall, then along it.

    For the centre, the wall is a strip of half-width CLEARANCE with a round end. It is convex, so
    what is left of the move after the first contact, with the part that points into the wall taken
    out, cannot enter it again. The path is solved for, not sampled, so nothing tunnels.
    """
    dx, dy = to_x - x, to_y - y
    side = 1.0 if y > 0 else -1.0
    # The strip's flat face, of which rounding may have left the centre on the wrong side
    if side * dy < 0 and side * to_y < CLEARANCE <= side * y + 1e-9:
        s = (side * CLEARANCE - y) / dy
        if x + s * dx <= WALL_END:
            return to_x, side * CLEARANCE
    # The round end: the smaller root of |(x, y) + s·(dx, dy) - end|² = CLEARANCE²
    ex, ey = x - WALL_END, y
    a = dx * dx + dy * dy
    b = ex * dx + ey * dy
    discriminant = b * b - a * (ex * ex + ey * ey - CLEARANCE**2)
    if b >= 0 or discriminant <= 0:  # moves away, or passes by
        return to_x, to_y
    s = (-b - math.sqrt(discriminant)) / a
    if s > 1:
        return to_x, to_y
    s = max(s, 0.0)
    nx, ny = ex + s * dx, ey + s * dy
    length = math.hypot(nx, ny)  # CLEARANCE, but for rounding, which would grow from step to step
    nx, ny = nx / length, ny / length  # the normal at the contact
    into = (1 - s) * min(dx * nx + dy * ny, 0.0)
    return to_x - into * nx, to_y - into * ny


class PointMass(gym.Env):
    """PointMassEmptyEnv-v1 and PointMassWallEnv-v1: a circle in a walled room moves to a point.

    Appendix A: observation and achieved goal are the circle's centre (x, y), the goal is the point,
    the action is the distance moved. From the released code: an action of 1 moves it by 0.05, in
    each axis, and success is within 0.05. That code's MuJoCo model has next to no inertia; this one
    has none, and needs no MuJoCo. Start and goal are uniform over the places where the circle's
    centre can be (ours).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    threshold = 0.05

    def __init__(self, wall: bool = False, render_mode: str | None = None):
        self.wall, self.render_mode = wall, render_mode
        self.observation_space = goal_space(2, 2, bound=ROOM)
        self.action_space = Box(-1, 1, (2,), np.float32)
        self._xy = self._goal = (0.0, 0.0)

    def compute_reward(self, achieved_goal, desired_goal, info) -> np.ndarray:
        """Eq. (1). (..., 2) and (..., 2) -> (...), 0 within 0.05 of the goal, else -1."""
        return sparse_reward(achieved_goal, desired_goal, self.threshold)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._xy, self._goal = self._free_place(), self._free_place()
        return self._observe(), {}

    def step(self, action):
        # Plain floats: NumPy's cost on two numbers is most of a step's time.
        x, y = self._xy
        to_x = x + STEP * min(max(float(action[0]), -1.0), 1.0)
        to_y = y + STEP * min(max(float(action[1]), -1.0), 1.0)
        to_x = min(max(to_x, -REACH), REACH)  # the room's walls: slides along
        to_y = min(max(to_y, -REACH), REACH)
        self._xy = slide_along_wall(x, y, to_x, to_y) if self.wall else (to_x, to_y)
        dx, dy = self._xy[0] - self._goal[0], self._xy[1] - self._goal[1]
        success = math.sqrt(dx * dx + dy * dy) <= self.threshold
        return self._observe(), float(success) - 1, False, False, {"is_success": success}

    def _free_place(self) -> tuple[float, float]:
        while True:
            x, y = self.np_random.uniform(-REACH, REACH, size=2).tolist()
            if not (self.wall and inside_wall(x, y)):
                return x, y

    def _observe(self) -> dict[str, np.ndarray]:
        return {
            "observation": np.array(self._xy),
            "achieved_goal": np.array(self._xy),
            "desired_goal": np.array(self._goal),
        }

    def render(self) -> np.ndarray:
        """A picture of the room, (360, 360, 3) uint8."""
        pixels = 360
        edge = ROOM + 2 * WALL_RADIUS
        x, y = np.meshgrid(*2 * [(np.arange(pixels) + 0.5) / pixels * 2 * edge - edge])
        y = -y  # pictures start at the top
        picture = np.full((pixels, pixels, 3), 255, np.uint8)
        picture[np.maximum(abs(x), abs(y)) > ROOM] = (90, 90, 90)
        if self.wall:
            picture[np.hypot(np.maximum(x - WALL_END, 0), y) < WALL_RADIUS] = (90, 90, 90)
        for (cx, cy), radius, colour in (
            (self._xy, RADIUS, (0, 114, 178)),
            (self._goal, 0.02, (213, 94, 0)),
        ):
            picture[np.hypot(x - cx, y - cy) < radius] = colour
        return picture


# -------------------------------------------------------------------------------- Reacher


class SparseReacher(ReacherEnv):
    """Reacher-v2 of the paper: MuJoCo's Reacher with a goal and the sparse reward of Eq. (1).

    Appendix A: the state is 8 numbers, cos and sin of the two joint angles, position and velocity
    of the fingertip in x and y; the goal is the target's x and y. Success within 0.02 is the
    released code's.
    """

    threshold = 0.02

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.observation_space = goal_space(8, 2)

    def compute_reward(self, achieved_goal, desired_goal, info) -> np.ndarray:
        """Eq. (1). (..., 2) and (..., 2) -> (...), 0 within 0.02 of the goal, else -1."""
        return sparse_reward(achieved_goal, desired_goal, self.threshold)

    def step(self, action):
        obs, _, terminated, truncated, _ = super().step(action)
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return obs, reward, terminated, truncated, {"is_success": reward == 0}

    def _get_obs(self):
        # mj_step leaves the bodies a substep behind the joints, here up to a centimetre.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        angles, fingertip = self.data.qpos[:2], self.get_body_com("fingertip")[:2].copy()
        velocity = np.empty(6)  # angular, then linear, along the world's axes
        body = mujoco.mjtObj.mjOBJ_XBODY, self.model.body("fingertip").id
        mujoco.mj_objectVelocity(self.model, self.data, *body, velocity, 0)
        state = np.cos(angles), np.sin(angles), fingertip, velocity[3:5]
        return {
            "observation": np.concatenate(state),
            "achieved_goal": fingertip,
            "desired_goal": self.get_body_com("target")[:2].copy(),
        }


gym.register("PointMassEmptyEnv-v1", PointMass, max_episode_steps=50)
gym.register("PointMassWallEnv-v1", PointMass, max_episode_steps=50, kwargs={"wall": True})
gym.register("SparseReacher-v1", SparseReacher, max_episode_steps=50)
