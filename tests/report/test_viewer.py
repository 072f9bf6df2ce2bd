"""Tests of the page that `play --html` writes: its data for brax's viewer."""

import base64
import json
import re
import sys
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import probe_environments as probes

from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.learner.acting.rollout import play
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.report import viewer
from jaxrl_vis_envs.adapters.brax_viewer import Poses, viewer_page

HORIZON = probes.Probe.horizon


class Posed(probes.GoWhereTold):
    """Probe whose state has the body poses of `mjx.Data`: the point is a body."""

    class Data(dict):
        xpos = property(lambda self: self["position"][..., None, :].repeat(3, axis=-1))
        xquat = property(lambda self: jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), (*self["position"].shape, 4)))

    def sample_goal(self, key):
        return self.Data(position=self.start(key)[1])

    def reset(self, key):
        state = super().reset(key)
        return state.replace(data=self.Data(position=state.data))

    def advance(self, state, action):
        state = super().advance(state.replace(data=state.data["position"]), action)
        return state.replace(data=self.Data(position=state.data))

    def observe(self, state):
        return state.data["position"]


jax.tree_util.register_pytree_node(
    Posed.Data, lambda data: ((data["position"],), None), lambda _, leaf: Posed.Data(position=leaf[0])
)


_ARM = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="2 3 .1" rgba=".1 .2 .3 1"/>
    <body name="arm" pos="0 0 1">
      <joint type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 1 0 0" size=".1" rgba="1 0 0 1"/>
      <geom type="ellipsoid" size=".1 .2 .3"/>
      <geom type="box" size=".1 .1 .1" group="3"/>
      <geom type="box" size=".1 .1 .1" rgba="0 0 0 0"/>
    </body>
    <body name="table"><geom type="box" size=".4 .5 .6"/></body>
    <body name="target" mocap="true"><geom type="sphere" size=".1"/></body>
  </worldbody>
</mujoco>
"""


def system_in(page: str) -> dict[str, Any]:
    """Return a page's data for brax's viewer."""
    encoded = re.search(r'var system = "([^"]+)"', page)
    assert encoded is not None
    return json.loads(zlib.decompress(base64.b64decode(encoded[1])))


def test_the_page_holds_the_robot_its_goal_and_their_motion():
    mj_model = mujoco.MjModel.from_xml_string(_ARM)
    rng = np.random.default_rng(0)
    robot, goal = (Poses(rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 4, 4))) for _ in range(2))
    system = system_in(viewer_page(mj_model, robot, goal, 0.04))
    assert list(system["geoms"]) == ["centre of the view", "world", "arm", "goal of arm", "table", "target"]
    assert system["opt"]["timestep"] == 0.04 and len(system["states"]["x"]) == 5
    scale = 5.0 / mj_model.stat.extent
    arm, goal_arm = system["geoms"]["arm"], system["geoms"]["goal of arm"]
    assert [geom["name"] for geom in arm] == [geom["name"] for geom in goal_arm] == ["Capsule", "Mesh"]
    np.testing.assert_allclose(arm[0]["size"][:2], scale * np.array([0.1, 0.5]), atol=1e-4)
    assert goal_arm[0]["size"][0] < arm[0]["size"][0] and goal_arm[0]["size"][1] == arm[0]["size"][1]
    np.testing.assert_allclose(np.abs(arm[1]["vert"]).max(axis=0), scale * np.array([0.1, 0.2, 0.3]), atol=1e-4)
    assert np.max(arm[1]["face"]) == len(arm[1]["vert"]) - 1
    np.testing.assert_allclose(system["geoms"]["world"][0]["size"][:2], scale * np.array([4.0, 6.0]), atol=1e-4)
    for t, state in enumerate(system["states"]["x"]):
        for name, poses in (("arm", robot), ("goal of arm", goal)):
            index = system["geoms"][name][0]["link_idx"]
            np.testing.assert_allclose(state["pos"][index], scale * (poses.positions[t, 1] - mj_model.stat.center), atol=1e-3)
            np.testing.assert_allclose(state["rot"][index], poses.rotations[t, 1], atol=1e-3)


def test_the_page_shows_the_episodes_that_the_video_shows(tmp_path):
    env = Posed()
    settings = {"num_envs": 2, "hidden_sizes": (8,), "replay_transitions": 40, "batch_size": 4, "eval_episodes": 3}
    program = make_train_step(env, preset("debug", **settings))
    trains = program.init(jax.random.key(0)[None]).train
    key = jax.random.key(5)
    posed = jax.jit(lambda trains: viewer.record_poses(program.acting, trains, key, 3))(trains)
    played = jax.jit(lambda trains: play(program.acting, trains, key[None], 3).episodes)(trains)
    episodes = jax.tree.map(lambda leaf: leaf[0], played)
    np.testing.assert_allclose(posed.positions[..., 0, :1], episodes.states[:, :-1], atol=1e-6)
    np.testing.assert_allclose(posed.goal_positions[:, 0, :1], episodes.states[:, -1], atol=1e-6)
    assert posed.rotations.shape == (3, HORIZON + 1, 1, 4)
    env.mj_model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    viewer.write_page(program, trains, key, 3, tmp_path / "new" / "page.html")
    system = system_in((tmp_path / "new" / "page.html").read_text())
    scale = 5.0 / env.mj_model.stat.extent
    shown = np.array([state["pos"][system["geoms"]["world"][0]["link_idx"]][0] for state in system["states"]["x"]])
    # The last step of an episode is held for .6 s, which is one step of this environment.
    expected = [[*states[:-1, 0], states[-2, 0]] for states in np.asarray(episodes.states)]
    np.testing.assert_allclose(shown, scale * (np.ravel(expected) - env.mj_model.stat.center[0]), atol=1e-3)


def test_play_html_says_what_it_cannot_do(tmp_path, monkeypatch, capsys):
    (tmp_path / "config.json").write_text("{}")
    assert cli.main(["play", str(tmp_path), "--html", "--out", "x.gif"]) == 2
    assert "x.gif" in (error := capsys.readouterr().err) and ".html" in error
    monkeypatch.setitem(sys.modules, "brax.io", None)
    monkeypatch.delitem(sys.modules, "jaxrl_vis_envs.adapters.brax_viewer")
    assert cli.main(["play", str(tmp_path), "--html"]) == 2
    error = capsys.readouterr().err
    assert "pip install brax" in error and len(error.splitlines()) == 1
