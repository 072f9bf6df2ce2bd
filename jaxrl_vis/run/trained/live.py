"""`play --live`: interactive view of a policy in the browser, with a goal that can be dragged in three dimensions.

`Session` steps the policy in its environment; `Page` shows it and forwards the user's requests.
"""

import contextlib
import io
import itertools
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.report import live_scene, videos
from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis_envs import goals
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv

HOST, PORT = "127.0.0.1", 8080  # of this machine alone; the next free port if it is taken
_IDLE = 0.1  # interval between checks for a visitor, s
_SHOWN = 160  # side of an image on the page, px


def require() -> Any:
    """Import viser, and return the module.

    Raises:
        RequestError: viser is missing.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RequestError(f"--live needs viser: {install_command('live')}, or leave out --live for a video") from error
    return viser


class Session:
    """Endless rollout of a policy: episodes do not end, and goals may change at any time.

    Args:
        policy: The policy.
        seed: Seed of starts and goals.

    Attributes:
        state: State of the environment.
        observation: Last observation, the policy's input: [C, H, W] uint8 or [S] float32.
        goal: Goal, in the same form.
        goal_data: `mjx.Data` of the robot at its goal.

    Raises:
        RequestError: The task has no poses to be shown.
    """

    def __init__(self, policy: Policy, seed: int = 0):
        env = policy.env
        if not isinstance(env, MjxGoalEnv):
            raise RequestError(f"--live shows tasks on MJX, and {policy.env_name} is not one: leave it out for a video")
        self.env, self._policy, self._keys = env, policy, map(jax.random.key, itertools.count(seed))

        def begin(key: jax.Array) -> tuple[Any, Any]:
            goal_data = env.sample_goal(key)
            return env.state_at(env.sample_start(key), env.goal_state(key, goal_data)), goal_data

        def look(data: Any) -> tuple[jax.Array, jax.Array]:
            achieved = env.achieved(data)
            return env.observe(env.state_at(data, achieved)), achieved

        def step(parameters: Any, state: Any, observation: jax.Array, goal: jax.Array) -> tuple[Any, jax.Array]:
            act, encode_goal = policy.algorithm.act, policy.algorithm.encode_goal
            state = env.advance(state, act(parameters, observation[None], encode_goal(parameters, goal[None]))[0])
            return state, env.observe(state)

        self._begin, self._look, self._step, self._configure_goal = map(
            jaxrl_vis_envs.jit, (begin, look, step, env.goal_configuration)
        )
        self.reset()
        self.sample_goal()

    @property
    def distance(self) -> float:
        """Distance to the goal, in the task's unit."""
        return float(goals.goal_distance(self.state.achieved_state, self.state.goal_state))

    def reset(self) -> None:
        """Reset the robot to a random start; the goal is kept."""
        goal_state = self.state.goal_state if hasattr(self, "state") else None
        self.state, _ = self._begin(next(self._keys))
        if goal_state is not None:
            self.state = self.state.replace(goal_state=goal_state)
        self.observation, _ = self._look(self.state.data)

    def sample_goal(self) -> None:
        """Sample a goal as at the start of an episode; the robot keeps its pose."""
        _, goal_data = self._begin(next(self._keys))
        self._update_goal(goal_data)

    def place_goal(self, point: np.ndarray) -> None:
        """Set the goal to a given point.

        Args:
            point: [3] (m, world frame); clipped to `MjxGoalEnv.goal_box`.
        """
        assert self.env.goal_box is not None
        low, high = self.env.goal_box
        self._update_goal(self._configure_goal(jnp.asarray(np.clip(point, low, high), jnp.float32)))

    def _update_goal(self, goal_data: Any) -> None:
        image, goal_state = self._look(goal_data)
        self.goal_data, self.goal = goal_data, self.env.as_goal(image)
        self.state = self.state.replace(goal_state=goal_state)

    def step(self) -> None:
        """Take one control step with the policy."""
        self.state, self.observation = self._step(self._policy.parameters, self.state, self.observation, self.goal)


class Page:
    """Web page of a session.

    Args:
        server: `viser.ViserServer`.
        session: The session.
        title: Name of the policy.
        out: File for recorded episodes, .gif or .mp4; further ones are numbered.
    """

    def __init__(self, server: Any, session: Session, title: str, out: Path):
        self._server, self._session, self._out = server, session, out
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._recorded: list[tuple[np.ndarray, bool]] | None = None
        self._dragged: np.ndarray | None = None
        self._note, self._is_dragging = "", False
        env, data = session.env, session.state.data
        self._scene = live_scene.LiveScene(server, env.mj_model, *_poses(data), env.camera)
        self._handle = self._add_handle() if env.goal_box is not None else None
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_layout="fixed")
        gui.set_panel_label(title)
        self._shows_images = videos.shows_images((1, 1, *np.shape(session.goal)))
        if self._shows_images:
            first = videos.EpisodeImages(
                np.asarray(session.observation)[None, None], np.asarray(session.goal)[None], np.zeros(1)
            )
            self._depth_range = videos.range_of_depth(first)
            self._goal_image = gui.add_image(self._to_display(session.goal), label="Goal, as the robot sees it")
            self._image = gui.add_image(self._to_display(session.observation), label="Now, as the robot sees it")
        self._status = gui.add_markdown("")
        if self._handle is not None:
            gui.add_markdown("Drag the arrows in the scene: the green robot is the goal.")
        self._add_button("New goal", session.sample_goal)
        self._add_button("Reset the robot", session.reset)
        if self._shows_images:
            self._add_button("Record an episode", self._begin_recording)
        self._show_goal()

    def run(self) -> None:
        """Step in real time while there are visitors, until an exception such as Ctrl-C."""
        period = self._session.env.control_period
        while True:
            due = time.monotonic() + period
            if not self._server.get_clients():
                time.sleep(_IDLE)
                continue
            self.advance()
            time.sleep(max(0.0, due - time.monotonic()))

    def advance(self) -> None:
        """Process pending requests, take one step, and show it."""
        goal = self._session.goal
        with contextlib.suppress(queue.Empty):
            while True:
                self._requests.get_nowait()()
        if self._session.goal is not goal:
            self._show_goal()
        self._record()
        self._session.step()
        self._show()

    def _add_handle(self) -> Any:
        """Add a handle for dragging the goal; return it."""
        low, high = self._session.env.goal_box or (np.zeros(3), np.zeros(3))
        limits = tuple((float(a), float(b)) for a, b in zip(low, high))
        size = 0.8 * float(np.mean(high - low))
        handle = self._server.scene.add_transform_controls(
            "/handle", size, line_width=4.0, disable_rotations=True, depth_test=False, translation_limits=limits
        )
        handle.on_update(lambda _: self.drag(np.array(handle.position)))
        return handle

    def drag(self, point: np.ndarray) -> None:
        """Request a goal at a point [3] (m, world frame); the latest request since the last step counts."""
        self._dragged = point
        self._requests.put(self._move_goal)

    def _move_goal(self) -> None:
        if self._dragged is not None:
            point, self._dragged, self._is_dragging = self._dragged, None, True
            self._session.place_goal(point)

    def _add_button(self, label: str, action: Callable[[], None]) -> None:
        self._server.gui.add_button(label).on_click(lambda _: self._requests.put(action))

    def _show_goal(self) -> None:
        session = self._session
        self._scene.show(*_poses(session.goal_data), is_goal=True)
        if self._handle is not None and not self._is_dragging:
            self._handle.position = np.asarray(session.state.goal_state, float)
        self._is_dragging = False
        if self._shows_images:
            self._goal_image.image = self._to_display(session.goal)

    def _show(self) -> None:
        session, env = self._session, self._session.env
        self._scene.show(*_poses(session.state.data))
        if self._shows_images:
            self._image.image = self._to_display(session.observation)
        reached = session.distance <= env.threshold
        shown = (
            f"{100 * session.distance:.1f} cm" if env.distance_unit == "m" else f"{session.distance:.2f} {env.distance_unit}"
        )
        self._status.content = f"**{'Reached' if reached else 'On its way'}**: {shown} from the goal\n\n{self._note}"

    def _to_display(self, image: Any) -> np.ndarray:
        """Convert the newest image of an observation [C, H, W] for display, colours beside depth: [H', W', 3] uint8."""
        channels = np.shape(image)[0] // self._session.env.frame_stack
        rows = videos.image_rows(np.asarray(image)[:channels], self._depth_range)
        return np.concatenate([np.asarray(videos.enlarge(row, _SHOWN)) for _, row in rows], axis=1)

    def _begin_recording(self) -> None:
        self._session.reset()
        self._recorded, self._note = [], "Recording ..."

    def _record(self) -> None:
        """Append the observation if an episode is being recorded, and write the video at its end."""
        if self._recorded is None:
            return
        session = self._session
        self._recorded.append((np.asarray(session.observation), session.distance <= session.env.threshold))
        if len(self._recorded) <= session.env.horizon:
            return
        frames, success = zip(*self._recorded)
        self._recorded = None
        channels = len(frames[0]) // session.env.frame_stack
        shown = videos.EpisodeImages(
            np.stack(frames)[None, :, :channels], np.asarray(session.goal)[None, :channels], np.array([success])
        )
        path = _unused_path(self._out)
        try:
            videos.write_video(shown, path, max(0.04, session.env.control_period))
        except OSError as error:  # shown on the page, which continues
            self._note = f"Cannot write `{path}`: {error.strerror or error}"
            return
        self._note = f"Recorded: `{path}`"
        print(path, flush=True)


def _poses(data: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(data.xpos), np.asarray(data.xquat)


def _unused_path(path: Path) -> Path:
    """Return ``path``, or the first free one of path-2, path-3, ..."""
    numbered = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in itertools.count(2))
    return next(choice for choice in itertools.chain([path], numbered) if not choice.exists())


def play_live(policy: Policy, title: str, out: Path) -> None:
    """Serve the page of a policy to this machine until Ctrl-C.

    Args:
        policy: The policy.
        title: Name of the policy.
        out: See `Page`.

    Raises:
        RequestError: viser is missing, no port is free, or the task cannot be shown.
    """
    viser = require()
    session = Session(policy)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # viser always prints a banner
            server = viser.ViserServer(host=HOST, port=PORT, label=title, verbose=False)
    except OSError as error:
        raise RequestError(
            f"--live finds no free port from {PORT} on ({error.strerror or error}): close other pages"
        ) from error
    try:
        page = Page(server, session, title, out)
        page.advance()
        print(f"open http://{HOST}:{server.get_port()} in a browser; Ctrl-C ends it", flush=True)
        page.run()
    except KeyboardInterrupt:
        print()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
