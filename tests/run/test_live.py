"""`play --live`: what a person asks for on the page reaches the robot, and what the robot does reaches the page."""

import dataclasses
import socket
import sys
import time
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
from jaxrl_vis.report import live_scene
from jaxrl_vis.run.storage.checkpoint import LIGHT, Restored
from jaxrl_vis.run.trained import live
from jaxrl_vis.run.trained.policy import Policy, make_policy
from jaxrl_vis_envs import registry

SETTINGS = {"num_envs": 2, "hidden_sizes": (8,), "replay_transitions": 40, "batch_size": 4, "encoder_filters": (4,)}


class Placed(point_mass.PointMass):
    """The ball, whose goal can be put anywhere near its start."""

    def __init__(self, config: point_mass.PointMassConfig):
        super().__init__(config)
        self.goal_box = (np.full(3, -0.3), np.full(3, 0.3))

    def achieved(self, data: Any) -> jax.Array:
        return jnp.append(data.qpos, 0.0)

    def goal_configuration(self, goal: jax.Array) -> Any:
        return self.configuration(goal[:2])


@pytest.fixture(scope="module")
def policy() -> Iterator[Policy]:
    """A policy that has learned nothing."""
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
    session.new_goal()
    assert not np.allclose(session.state.goal_state, [0.3, -0.1, 0])


def test_tasks_without_poses_are_refused(policy: Policy) -> None:
    with pytest.raises(RequestError, match="--live shows tasks on MJX, and VisualPoint is none"):
        live.Session(dataclasses.replace(policy, env=probes.GoWhereTold()))


@pytest.fixture
def page(session: live.Session, tmp_path: Path) -> Iterator[live.Page]:
    """The page of the session on a port of its own."""
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(host=live.HOST, port=18_059, verbose=False)
    yield live.Page(server, session, "ball", tmp_path / "seen.gif")
    server.stop()


def test_the_page_is_for_this_machine_alone(page: live.Page) -> None:
    address = (live.HOST, page._server.get_port())
    with socket.create_connection(address, timeout=5):
        pass
    assert page._server.get_host() == "127.0.0.1"


def test_a_dragged_goal_reaches_the_robot_and_the_page(page: live.Page, session: live.Session) -> None:
    page.advance()
    before = page._goal_image.image.copy()
    for place in ((-0.1, 0.2, 0.0), (0.25, 0.25, 0.0)):
        page.drag(np.array(place))
    page.advance()
    np.testing.assert_allclose(session.state.goal_state, [0.25, 0.25, 0])
    assert not np.array_equal(page._goal_image.image, before)
    body = session.env.mj_model.body("ball").id
    np.testing.assert_allclose(page._scene._goal[body].position, [0.25, 0.25, 0.1], atol=1e-6)
    np.testing.assert_allclose(page._scene._robot[body].position, session.state.data.xpos[body], atol=1e-6)
    assert "from the goal" in page._status.content


def test_a_recorded_episode_begins_at_the_start_and_is_never_written_over(page: live.Page, tmp_path: Path) -> None:
    for name in ("seen.gif", "seen-2.gif"):
        page._begin_recording()
        for _ in range(page._session.env.horizon + 1):
            assert not (tmp_path / name).exists()
            page.advance()
        with Image.open(tmp_path / name) as video:
            assert video.n_frames == page._session.env.horizon + 1


def test_every_shape_has_its_size() -> None:
    xml = """<mujoco><asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
    <geom type="box" size=".1 .2 .3"/><geom type="sphere" size=".1"/><geom type="ellipsoid" size=".1 .2 .3"/>
    <geom type="capsule" size=".1 .3"/><geom type="cylinder" size=".1 .3"/><geom type="mesh" mesh="m"/>
    <geom type="sphere" size=".1" group="3"/><geom type="sphere" size=".1" rgba="0 0 0 0"/></worldbody></mujoco>"""
    mj_model = mujoco.MjModel.from_xml_string(xml)
    assert live_scene.visible_geoms(mj_model, 0) == list(range(6))
    halves = [[0.1, 0.2, 0.3], [0.1] * 3, [0.1, 0.2, 0.3], [0.1, 0.1, 0.4], [0.1, 0.1, 0.3]]
    for geom, half in enumerate(halves):
        mesh = live_scene.surface(mj_model, geom)
        assert mesh is not None
        np.testing.assert_allclose(mesh[0].max(axis=0), half, atol=2e-3)
        np.testing.assert_allclose(mesh[0].min(axis=0), -np.array(half), atol=2e-3)
        assert mesh[1].max() < len(mesh[0])
    mesh = live_scene.surface(mj_model, 5)
    assert mesh is not None and len(mesh[0]) == 4


def test_the_command_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["play", "fetch", "--live"]) == 2
    assert "--live needs viser: " in capsys.readouterr().err
    assert cli.main(["play", "fetch", "--live", "--html"]) == 2
    assert "leave out --html" in capsys.readouterr().err


def test_control_c_ends_it_in_order(policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = []

    class Server:
        def __init__(self, **options: Any) -> None:
            assert options["host"] == "127.0.0.1"

        def __getattr__(self, name: str) -> Any:
            return Server.anything

        @staticmethod
        def anything(*_: Any, **__: Any) -> Any:
            raise KeyboardInterrupt

        def stop(self) -> None:
            stopped.append(time.monotonic())

    monkeypatch.setattr(live, "require", lambda: type("viser", (), {"ViserServer": Server}))
    monkeypatch.setattr(live, "Session", lambda policy: None)
    monkeypatch.setattr(live, "Page", lambda *_: type("Page", (), {"advance": Server.anything}))
    live.play_live(policy, "ball", tmp_path / "x.gif")
    assert len(stopped) == 1
