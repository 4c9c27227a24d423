"""What the vector environments of all tasks share: episodes, faults, and arrays of the wanted library.

All work of an action is done on the device of the worlds. NumPy arrays are copies on the host. Arrays of Warp and
tensors of PyTorch are the environment's own memory on the device.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.learn.episodes import delay_actions, end_episodes, forget_actions, limit_actions
from vinesim.learn.task_pictures import ObservedPictures, Pictures, Spectator
from vinesim.learn.variation import Variation
from vinesim.plants.device_buffers import find_device
from vinesim.sensors.camera.world_cameras import WorldCamera
from vinesim.worlds.errors import MissingExtra
from vinesim.worlds.worlds import Worlds

ARRAYS = ("numpy", "torch", "warp")
"""Libraries whose arrays an environment can give and take."""
OBSERVATIONS = ("state", "pictures")
"""What a policy can get: numbers, or numbers and pictures."""
RENDER_MODES = ("rgb_array",)
SMALLEST, LARGEST = 8, 256
"""[px] Limits of the size of observed pictures."""
STEPS = 4
"""Steps of 10 ms between two actions."""


class _Results(NamedTuple):
    """Results of an action, on the device."""

    observation: wp.array
    last: wp.array
    """[world, k] Observations before worlds that end begin again."""
    reward: wp.array
    success: wp.array
    terminated: wp.array
    truncated: wp.array
    ended: wp.array
    fault: wp.array
    pictures: Pictures
    """Empty, unless pictures are observed."""
    last_pictures: Pictures


class TaskEnv(VectorEnv[Any, Any, Any], abc.ABC):
    """A task in ``worlds``. An action lasts :data:`STEPS` steps.

    ``info`` of an action has ``success`` bool [world], ``fault`` int32 [world] (see
    :attr:`vinesim.worlds.worlds.Worlds.faults`), and if worlds ended also ``final_obs`` [world, k], their last
    observations, with ``_final_obs`` bool [world], which worlds ended. These worlds begin again in the same step. A
    world with a fault is terminated with reward -10. Actions count as limited to -1 to 1; one that is not finite is a
    fault.

    With arrays on the device, nothing is copied to the host. Results of an action are overwritten by the action after
    the next one, and ``final_obs`` is always present.

    With ``observation="pictures"`` an observation is a dictionary of ``state``, the numbers, and the pictures of the
    task's cameras (:mod:`vinesim.sensors.camera.world_cameras`): ``rgb`` uint8 [world, camera, row, column, 3],
    ``depth`` float32 m, at most 10 m, which is also that of the sky, and ``labels`` int32
    (:func:`vinesim.scene.ids.label`), both [world, camera, row, column].

    With ``render_mode="rgb_array"``, :meth:`render` draws a picture of each world when it is called.

    Args:
        worlds: the worlds.
        actions: number of an action's components, each from -1 to 1.
        numbers: number of an observation's components.
        device: the device of ``worlds``.
        arrays: one of :data:`ARRAYS`: the library of observations, actions and all other arrays.
        variation: ranges of frictions and delays of the worlds.
        rng: draws from these ranges.
        max_episode_steps: number of actions after which an episode is truncated.
        render_mode: ``"rgb_array"`` or None.
        observation: one of :data:`OBSERVATIONS`.
        cameras: cameras of observed pictures, the same in all worlds.
        picture_size: width and height of observed pictures [px], 8 to 256.
        spectator: camera of :meth:`render`.

    Subclasses call :func:`check_options` before they make the worlds.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": [*RENDER_MODES],
        "render_fps": 25,
    }

    def __init__(
        self,
        worlds: Worlds,
        actions: int,
        numbers: int,
        *,
        device: str,
        arrays: str,
        variation: Variation,
        rng: np.random.Generator,
        max_episode_steps: int,
        render_mode: str | None,
        observation: str,
        cameras: Sequence[WorldCamera],
        picture_size: int,
        spectator: WorldCamera,
    ) -> None:
        self.worlds = worlds
        self.num_envs = worlds.count
        self.render_mode = render_mode
        self._spectator = Spectator(worlds, spectator)
        self.num_actions = actions
        self.num_observations = numbers
        self.max_episode_steps = max_episode_steps
        self.arrays = arrays
        self.device = device
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)
        state = gymnasium.spaces.Box(-np.inf, np.inf, (numbers,), np.float32)
        self.single_observation_space: gymnasium.Space = state
        self._pictures: ObservedPictures | None = None
        if observation == "pictures":
            self._pictures = ObservedPictures(worlds, cameras, picture_size)
            self.single_observation_space = gymnasium.spaces.Dict({"state": state, **self._pictures.spaces})
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._given_action = self.empty(float, actions)  # the last one; ``_action`` is the one that its delay lets act
        self._action = self.empty(float, actions)
        self._history = self.empty(float, variation.delay[1] + 1, actions)
        self._delay = self.on_device(rng.integers(*variation.delay, self.num_envs, endpoint=True), wp.int32)
        worlds.contacts.friction_scale.assign(rng.uniform(*variation.friction, self.num_envs))
        self._has_begun = False
        self._seed = wp.zeros(1, dtype=wp.int32, device=device)
        self.elapsed = self.empty(wp.int32)
        """[world] Number of actions of the episode so far, on the device."""
        self._episode = self.empty(wp.int32)
        self._begins = self.empty(wp.bool)
        self._nowhere = self.empty(wp.bool)
        unused = (self.empty(float), self.empty(wp.bool))
        each = {"threads": self.num_envs, "width": actions}
        delay = KernelLaunch(delay_actions, [self._delay, self._given_action], [self._history, self._action], **each)
        forget = KernelLaunch(forget_actions, [self._begins], [self._history], **each)
        limited = [self._given_action, worlds.faults, worlds.fault_count]
        limit = KernelLaunch(limit_actions, [], limited, threads=self.num_envs)
        self._move = self._graph([limit, delay, *self._moves()])
        self._begin = self._graph([forget, *self._beginnings()])
        self._results = [self._results_of(numbers) for _ in range(2)]
        self._judge = [self._graph(self._judgements(results)) for results in self._results]
        self._observe = [self._graph(self._observations(results.observation, *unused)) for results in self._results]
        self._turn = 0

    def _results_of(self, numbers: int) -> _Results:
        empty = self.empty
        of_worlds = (float, wp.bool, wp.bool, wp.bool, wp.bool, wp.int32)
        pictures = [{} if self._pictures is None else self._pictures.empty() for _ in range(2)]
        return _Results(empty(float, numbers), empty(float, numbers), *(empty(dtype) for dtype in of_worlds), *pictures)

    def empty(self, dtype: Any, *shape: int) -> wp.array:
        """Returns an array of zeros on the device with a row for each world."""
        return wp.zeros((self.num_envs, *shape), dtype=dtype, device=self.device)

    def on_device(self, values: Any, dtype: Any) -> wp.array:
        """Returns a copy of ``values`` on the device."""
        return wp.array(np.asarray(values), dtype=dtype, device=self.device)

    def _graph(self, launches: Sequence[KernelLaunch]) -> KernelGraph:
        return KernelGraph(*launches, device=self.device)

    # ------------------------------------------------------------------ the task

    @abc.abstractmethod
    def _moves(self) -> list[KernelLaunch]:
        """Returns the launches that apply ``_action`` [world, k], which may be an earlier one than the last, to the
        robots."""

    @abc.abstractmethod
    def _observations(self, observation: wp.array, reward: wp.array, success: wp.array) -> list[KernelLaunch]:
        """Returns the launches that write the observation [world, k], the reward and the success [world] of the present
        states."""

    @abc.abstractmethod
    def _beginnings(self) -> list[KernelLaunch]:
        """Returns the launches that begin an episode in the worlds of ``_begins``, after their reset."""

    @property
    @abc.abstractmethod
    def _failed(self) -> wp.array:
        """[world] Whether success is no longer possible, so that the episode ends."""

    def _counts(self) -> list[KernelLaunch]:
        """Returns the launches that follow once after each action, before the observations."""
        return []

    def _judgements(self, results: _Results) -> list[KernelLaunch]:
        given = [self.max_episode_steps, self.worlds.faults, self._failed]
        flags = [results.success, results.terminated, results.truncated, results.ended, results.fault]
        written = [self.elapsed, results.last, results.reward, *flags]
        return [
            *self._counts(),
            *self._observations(results.last, results.reward, results.success),
            KernelLaunch(end_episodes, given, written, threads=self.num_envs),
        ]

    # ------------------------------------------------------------------ gymnasium

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all worlds; see :class:`gymnasium.vector.VectorEnv`. ``seed``: seed of random numbers."""
        if isinstance(seed, list):
            raise ValueError("seed: give one number for all worlds")
        super().reset(seed=seed)
        self._has_begun = True
        self._seed.fill_(int(self.np_random.integers(2**31)))
        self._episode.zero_()
        self.elapsed.zero_()
        self._begins.fill_(True)
        self._begin_again()
        results = self._next_results()
        results.success.zero_()
        self._observe[self._turn]()
        if self._pictures is not None:
            self._pictures.write(results.pictures)
        return self._observed(results.observation, results.pictures), {"success": self._given(results.success)}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one action in each world; see the class and :class:`gymnasium.vector.VectorEnv`. Raises
        :class:`gymnasium.error.ResetNeeded` before the first :meth:`reset`."""
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("step() before reset(): call reset() first")
        self._take(actions)
        results = self._next_results()
        self._move()
        self.worlds.step(STEPS)
        self.worlds.bodies.update_kinematics()
        self._judge[self._turn]()
        if self._pictures is not None:
            self._pictures.write(results.last_pictures)
        on_host = self.arrays == "numpy"
        if any_ended := not on_host or bool(results.ended.numpy().any()):
            wp.copy(self._begins, results.ended)
            self._begin_again()
        self._observe[self._turn]()
        if self._pictures is not None:
            self._pictures.write(results.pictures, self._begins if any_ended else self._nowhere)
        info: dict[str, Any] = {"success": self._given(results.success), "fault": self._given(results.fault)}
        if any_ended:
            last = self._observed(results.last, results.last_pictures)
            info |= {"final_obs": last, "_final_obs": self._given(results.ended)}
        reward, terminated, truncated = map(self._given, (results.reward, results.terminated, results.truncated))
        return self._observed(results.observation, results.pictures), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a picture [height, width, 3] uint8 of the present state of each world, on the host; None without a
        render mode."""
        return None if self.render_mode is None else self._spectator.frames()

    def _next_results(self) -> _Results:
        """Returns the arrays of the older results, which are overwritten now."""
        self._turn = 1 - self._turn
        return self._results[self._turn]

    def _begin_again(self) -> None:
        """Begin an episode in the worlds of ``_begins``."""
        self.worlds.reset(self._begins)
        self._begin()
        self.worlds.bodies.update_kinematics()

    def _take(self, actions: Any) -> None:
        if self.arrays == "numpy":
            given: Any = np.asarray(actions, np.float32)
        elif self.arrays == "warp":
            given = actions
            if not isinstance(given, wp.array):
                raise ValueError(f"actions of type {type(given).__name__}: give an array of Warp, or arrays='numpy'")
        else:
            given = wp.from_torch(actions.detach().contiguous(), dtype=wp.float32)
        if given.shape != self._action.shape:
            raise ValueError(f"actions of shape {given.shape}: give {self._action.shape}, one row for each world")
        self._given_action.assign(given)

    def _observed(self, state: wp.array, pictures: Pictures) -> Any:
        """Returns an observation in arrays of the wanted library."""
        if self._pictures is None:
            return self._given(state)
        return {"state": self._given(state), **{name: self._given(array) for name, array in pictures.items()}}

    def _given(self, array: wp.array) -> Any:
        """Returns an array of the wanted library."""
        if self.arrays == "numpy":
            return array.numpy().copy()
        return array if self.arrays == "warp" else wp.to_torch(array)


def of_world(observation: Any, world: Any) -> Any:
    """Returns the observation of one world, of all worlds' arrays or of a dictionary of them."""
    if isinstance(observation, dict):
        return {name: values[world] for name, values in observation.items()}
    return observation[world]


def check_options(
    numbers: dict[str, int], *, device: str, arrays: str, render_mode: str | None, observation: str, picture_size: int
) -> None:
    """Check what can be wrong with an environment's arguments, before the worlds are made; see :class:`TaskEnv`.

    ``numbers``: arguments that must be whole numbers, at least 1, by name. Raises :class:`ValueError`;
    :class:`~vinesim.worlds.errors.MissingExtra` if PyTorch is wanted and not installed.
    """
    for name, value in numbers.items():
        if not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"{name} {value!r}: give a whole number, at least 1")
    find_device(device)
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode {render_mode!r}: give {' or '.join(RENDER_MODES)}, or None")
    if observation not in OBSERVATIONS:
        raise ValueError(f"observation {observation!r}: give {' or '.join(OBSERVATIONS)}")
    if not isinstance(picture_size, int | np.integer) or not SMALLEST <= picture_size <= LARGEST:
        raise ValueError(f"picture_size {picture_size!r}: give {SMALLEST} to {LARGEST} px")
    if arrays not in ARRAYS:
        raise ValueError(f"arrays {arrays!r}: give one of {', '.join(ARRAYS)}")
    if arrays == "torch":
        try:
            import torch  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtra(f"arrays 'torch' needs PyTorch: pip install torch ({error})") from error
