"""`play --live`: requests on the page reach the robot, and the page shows the robot's motion."""

import dataclasses
import socket
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import point_mass
import probe_environments as probes
import pytest
from PIL import Image

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report import live_scene, videos
from jaxrl_vis.run.storage.checkpoint import LIGHT
from jaxrl_vis.run.storage.restoring import Restored
from jaxrl_vis.run.trained import live
from jaxrl_vis.run.trained.policy import Policy, make_policy
from jaxrl_vis_envs import registry

SETTINGS = {"num_envs": 2, "hidden_sizes": (8,), "replay_transitions": 40, "batch_size": 4, "encoder_filters": (4,)}


class Placed(point_mass.PointMass):
    """Point mass whose goal can be placed anywhere near its start."""

    def __init__(self, config: point_mass.PointMassConfig):
        super().__init__(config)
        self.goal_box = (np.full(3, -0.3), np.full(3, 0.3))

    def achieved(self, data: Any) -> jax.Array:
        return jnp.append(data.qpos, 0.0)

    def goal_configuration(self, goal: jax.Array) -> Any:
        return self.configuration(goal[:2])


@pytest.fixture(scope="module")
def policy() -> Iterator[Policy]:
    """Policy of an untrained learner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._ENTRIES, "VisualPoint", registry._Entry(Placed, point_mass.PointMassConfig))
        config = jaxrl_vis.preset("debug", env="VisualPoint", pixels="rgbd", image_size=8, latent_size=8, **SETTINGS)
        trainer = jaxrl_vis.make_trainer(config)
        init = jax.jit(trainer.program.init.__wrapped__)
        yield make_policy(trainer, Restored(LIGHT, 0, init(trainer.run_keys).train, None, {}), 0)


@pytest.fixture(scope="module")
def session(policy: Policy) -> live.Session:
    return live.Session(policy)


def test_the_session_is_the_task_with_the_policy_in_it(policy: Policy, session: live.Session) -> None:
    session.reset()
    start, seen, goal = session.state, session.observation, session.goal
    action = policy(seen, goal)
    expected = policy.env.advance(start, action)
    session.step()
    np.testing.assert_allclose(session.state.data.qpos, expected.data.qpos, atol=1e-6)
    np.testing.assert_array_equal(session.observation, policy.env.observe(session.state))
    assert session.distance == pytest.approx(float(jnp.linalg.norm(session.state.data.qpos - start.goal_state[:2])), abs=1e-6)
    assert np.abs(np.asarray(session.state.data.qpos)).max() > 1e-6, "the ball has moved"


def test_goals_are_placed_shown_and_kept_within_their_box(session: live.Session) -> None:
    session.place_goal(np.array([0.2, -0.1, 0.0]))
    first = np.asarray(session.goal)
    np.testing.assert_allclose(session.goal_data.qpos, [0.2, -0.1])
    np.testing.assert_allclose(session.state.goal_state, [0.2, -0.1, 0])
    place = np.asarray(session.state.data.qpos)
    session.place_goal(np.array([5.0, -0.1, 0.0]))
    np.testing.assert_allclose(session.state.goal_state, [0.3, -0.1, 0])
    assert not np.array_equal(session.goal, first)
    np.testing.assert_array_equal(session.state.data.qpos, place, err_msg="a goal moves no robot")
    session.reset()
    np.testing.assert_allclose(session.state.goal_state, [0.3, -0.1, 0], err_msg="a reset moves no goal")
    assert session.distance == pytest.approx(np.hypot(0.3, 0.1)), "from the start to that goal"
    session.sample_goal()
    assert not np.allclose(session.state.goal_state, [0.3, -0.1, 0])


def test_tasks_without_poses_are_refused(policy: Policy) -> None:
    with pytest.raises(RequestError, match="--live shows tasks on MJX, and VisualPoint is not one"):
        live.Session(dataclasses.replace(policy, env=probes.GoWhereTold()))


class Handle(types.SimpleNamespace):
    """Object that a call of viser adds to the page: its arguments, and the functions called when somebody uses it."""

    def on_click(self, call: Any) -> None:
        self.use = call

    on_update = on_click


class Server:
    """Stand-in for the part of `viser.ViserServer` that a page uses. A test below uses viser itself, if it is installed."""

    def __init__(self) -> None:
        self.added: dict[str, Handle] = {}
        self.scene = self.gui = self
        self.initial_camera = Handle()

    def __getattr__(self, name: str) -> Any:
        if not name.startswith(("add_", "set_", "configure_")):
            raise AttributeError(name)
        images = {"add_image": "image", "add_markdown": "content"}

        def add(first: Any = None, *_: Any, **options: Any) -> Handle:
            handle = Handle(**{"position": (0.0, 0.0, 0.0), **options})
            if name in images:
                setattr(handle, images[name], first)
            self.added[first if isinstance(first, str) else options.get("label", name)] = handle
            return handle

        return add


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def page(server: Server, session: live.Session, tmp_path: Path) -> live.Page:
    """The page of the session."""
    return live.Page(server, session, "ball", tmp_path / "seen.gif")


def test_viser_shows_the_page_to_this_machine_alone(session: live.Session, tmp_path: Path) -> None:
    viser = pytest.importorskip("viser")
    real = viser.ViserServer(host=live.HOST, port=18_059, verbose=False)
    try:
        page = live.Page(real, session, "ball", tmp_path / "seen.gif")
        page.drag(np.zeros(3))
        page.advance()
        with socket.create_connection((live.HOST, real.get_port()), timeout=5):
            pass
        assert real.get_host() == "127.0.0.1" and not real.get_clients()
    finally:
        real.stop()


def test_a_full_disk_is_reported_on_the_page(server: Server, page: live.Page, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(videos, "write_video", full)
    server.added["Record an episode"].use(None)
    for _ in range(page._session.env.horizon + 2):
        page.advance()
    assert "No space left on device" in page._status.content


def test_buttons_do_what_they_say(server: Server, page: live.Page, session: live.Session) -> None:
    page.advance()
    goal, place = np.asarray(session.state.goal_state), np.asarray(session.state.data.qpos)
    server.added["New goal"].use(None)
    page.advance()
    assert not np.allclose(session.state.goal_state, goal)
    np.testing.assert_allclose(server.added["/handle"].position, session.state.goal_state)
    for _ in range(5):
        page.advance()
    assert not np.allclose(session.state.data.qpos, place)
    goal = np.asarray(session.state.goal_state)
    moved = float(np.linalg.norm(session.state.data.qpos))
    server.added["Reset the robot"].use(None)
    page.advance()
    assert float(np.linalg.norm(session.state.data.qpos)) < moved, "one step from the start, which is at 0"
    np.testing.assert_array_equal(session.state.goal_state, goal)


def test_a_dragged_goal_reaches_the_robot_and_the_page(server: Server, page: live.Page, session: live.Session) -> None:
    page.advance()
    seen, handle = server.added["Goal, as the robot sees it"], server.added["/handle"]
    before = seen.image.copy()
    for place in ((-0.1, 0.2, 0.0), (0.25, 0.25, 0.0)):
        handle.position = place
        handle.use(None)
    page.advance()
    np.testing.assert_allclose(session.state.goal_state, [0.25, 0.25, 0])
    assert not np.array_equal(seen.image, before)
    body = session.env.mj_model.body("ball").id
    np.testing.assert_allclose(server.added[f"/goal/{body}"].position, [0.25, 0.25, 0.1], atol=1e-6)
    np.testing.assert_allclose(server.added[f"/robot/{body}"].position, session.state.data.xpos[body], atol=1e-6)
    assert handle.position == (0.25, 0.25, 0.0), "what is dragged stays where the pointer is"
    assert "cm from the goal" in page._status.content


def test_a_recorded_episode_is_whole_and_never_written_over(
    server: Server, page: live.Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, write_video = [], videos.write_video
    monkeypatch.setattr(videos, "write_video", lambda shown, *rest: (written.append(shown), write_video(shown, *rest)))
    for name in ("seen.gif", "seen-2.gif"):
        server.added["Record an episode"].use(None)
        seen = []
        for _ in range(page._session.env.horizon + 1):
            assert not (tmp_path / name).exists()
            page.advance()
            seen.append(np.asarray(page._session.observation))
        np.testing.assert_array_equal(written[-1].frames[0, 1:], seen[:-1], err_msg="the first is that of the start")
        assert written[-1].success.shape == (1, page._session.env.horizon + 1)
        with Image.open(tmp_path / name) as video:
            assert video.n_frames == page._session.env.horizon + 1


def test_a_task_of_states_has_a_page_without_images(policy: Policy, tmp_path: Path) -> None:
    env = point_mass.StatePointMass(point_mass.PointMassConfig())
    algorithm = policy.algorithm._replace(act=lambda *_: jnp.ones((1, 2)), encode_goal=lambda params, goals: goals)
    session, server = live.Session(dataclasses.replace(policy, env=env, algorithm=algorithm)), Server()
    page = live.Page(server, session, "ball", tmp_path / "seen.gif")
    page.advance()
    assert np.shape(session.observation) == np.shape(session.goal) == (4,)
    assert {"New goal", "Reset the robot"} <= server.added.keys()
    assert not {"Record an episode", "/handle", "Now, as the robot sees it"} & server.added.keys()
    assert np.asarray(session.state.data.qpos).min() > 0


def test_every_shape_has_its_size() -> None:
    xml = """<mujoco><asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
    <geom type="box" size=".1 .2 .3"/><geom type="sphere" size=".1"/><geom type="ellipsoid" size=".1 .2 .3"/>
    <geom type="capsule" size=".1 .3"/><geom type="cylinder" size=".1 .3"/><geom type="mesh" mesh="m"/>
    <geom type="sphere" size=".1" group="3"/><geom type="sphere" size=".1" rgba="0 0 0 0"/></worldbody></mujoco>"""
    mj_model = mujoco.MjModel.from_xml_string(xml)
    assert live_scene.visible_geoms(mj_model, 0) == list(range(6))
    halves = [[0.1, 0.2, 0.3], [0.1] * 3, [0.1, 0.2, 0.3], [0.1, 0.1, 0.4], [0.1, 0.1, 0.3]]
    for geom, half in enumerate(halves):
        mesh = live_scene.geom_surface(mj_model, geom)
        assert mesh is not None
        np.testing.assert_allclose(mesh[0].max(axis=0), half, atol=2e-3)
        np.testing.assert_allclose(mesh[0].min(axis=0), -np.array(half), atol=2e-3)
        assert mesh[1].max() < len(mesh[0])
    mesh = live_scene.geom_surface(mj_model, 5)
    assert mesh is not None and len(mesh[0]) == 4


def test_the_command_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["play", "fetch", "--live"]) == 2
    assert "--live needs viser: " in capsys.readouterr().err
    assert cli.main(["play", "fetch", "--live", "--html"]) == 2
    assert "leave out --html" in capsys.readouterr().err


def test_control_c_ends_it_in_order(policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = []

    class Interrupted:
        def __init__(self, **options: Any) -> None:
            assert options["host"] == "127.0.0.1"

        def __getattr__(self, name: str) -> Any:
            return Interrupted.anything

        @staticmethod
        def anything(*_: Any, **__: Any) -> Any:
            raise KeyboardInterrupt

        def stop(self) -> None:
            stopped.append(time.monotonic())

    monkeypatch.setattr(live, "require", lambda: type("viser", (), {"ViserServer": Interrupted}))
    monkeypatch.setattr(live, "Session", lambda policy: None)
    monkeypatch.setattr(live, "Page", lambda *_: type("Page", (), {"advance": Interrupted.anything}))
    live.play_live(policy, "ball", tmp_path / "x.gif")
    assert len(stopped) == 1
