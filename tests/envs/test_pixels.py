"""Images for environments of other libraries, by one call: for brax, stand-ins of others, plain models and Gymnasium."""

import dataclasses
import pickle
from types import SimpleNamespace
from typing import Any

import brax.envs
import cv2
import gymnasium
import jax
import jax.numpy as jnp
import make_pixels_references
import mujoco
import numpy as np
import pytest
import render_references
from brax.envs.wrappers import training
from brax.training.agents.ppo.networks_vision import make_ppo_networks_vision
from flax import struct
from gymnasium.utils.env_checker import check_env
from mujoco import mjx
from render_comparison import Tally, near_edges, surface_kinds
from render_models import poses_of

import jaxrl_vis_envs
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.adapters.brax import BraxEnv
from jaxrl_vis_envs.render import Frame, Scene, render

SIZE = 16
_XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="2 2 .1" rgba=".8 .8 .8 1"/>
    <body name="cart" pos="0 0 .3">
      <joint name="slide" type="slide" axis="1 0 0" damping="1"/>
      <geom name="box" type="box" size=".3 .2 .2" rgba=".9 .1 .1 1"/>
      <geom type="sphere" size=".1" pos="0 0 .3" rgba=".1 .1 .9 1"/>
    </body>
    <camera name="front" pos="0 -2 .8" xyaxes="1 0 0 0 .3 .95"/>
    <camera name="side" pos="2 -.3 .6" xyaxes="0 1 0 -.2 0 1" fovy="60"/>
    <camera pos="0 0 3" resolution="4 4" sensorsize=".02 .01" focal=".02 .015" principal=".002 .001"/>
    <camera name="flat" pos="0 -2 .8" xyaxes="1 0 0 0 .3 .95" projection="orthographic" fovy="2"/>
  </worldbody>
  <actuator><motor joint="slide" gear="20"/></actuator>
</mujoco>
"""

TEXTURED_XML = _XML.replace(
    "<worldbody>",
    """<asset>
    <texture name="checker" type="2d" builtin="checker" rgb1="1 1 1" rgb2=".1 .1 .6" width="32" height="32"/>
    <texture name="stripes" type="2d" builtin="gradient" rgb1=".9 .9 .1" rgb2=".5 0 .5" width="16" height="64"/>
    <material name="cover" texture="checker" texrepeat="2 2"/>
  </asset><worldbody>""",
).replace('rgba=".9 .1 .1 1"', 'material="cover"')


@pytest.fixture(scope="module")
def cart() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(_XML)


@struct.dataclass
class PlaygroundState:
    """The fields of MuJoCo Playground's `mjx_env.State`."""

    data: mjx.Data
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


class PlaygroundEnv:
    """Stand-in for MuJoCo Playground's `mjx_env.MjxEnv`, with the members that its tasks define: a cart that is pushed."""

    def __init__(self) -> None:
        self._mj_model = mujoco.MjModel.from_xml_string(_XML)
        self._mjx_model = mjx.put_model(self._mj_model)

    def reset(self, rng: jax.Array) -> PlaygroundState:
        data = mjx.make_data(self._mjx_model)
        data = data.replace(qpos=jax.random.uniform(rng, (1,), minval=-0.5, maxval=0.5))
        zero = jnp.zeros(())
        return PlaygroundState(data, self._obs(data), zero, zero, {"reward/upright": zero}, {"rng": rng})

    def step(self, state: PlaygroundState, action: jax.Array) -> PlaygroundState:
        data = state.data.replace(qpos=state.data.qpos + 0.1 * action)
        return state.replace(data=data, obs=self._obs(data), reward=data.qpos[0])

    def _obs(self, data: mjx.Data) -> dict[str, jax.Array]:
        return {"state": data.qpos, "privileged_state": jnp.concatenate([data.qpos, data.qvel])}

    observation_size = {"state": (1,), "privileged_state": (2,)}
    action_size = 1

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self._mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        return self._mjx_model

    @property
    def unwrapped(self) -> "PlaygroundEnv":
        return self


def truth(mj_model: mujoco.MjModel, qpos: Any, camera: str | int, size: int = SIZE) -> Frame:
    """Return the image of a model at joint positions, rendered directly."""
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[:] = qpos
    mujoco.mj_forward(mj_model, mj_data)
    return render(Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size), mj_data)


def assert_same_colours(image: Any, frame: Frame) -> None:
    """Compare float images from 0 to 1 with those of a frame, apart from rounding at edges."""
    difference = np.abs(np.rint(255.0 * np.asarray(image)) - np.asarray(frame.rgb))
    assert np.mean(difference > 1) < 0.01 and np.asarray(frame.rgb).std() > 5


# -- Environments


@pytest.fixture(scope="module")
def playground() -> pixels.PixelEnv:
    return pixels.wrap(PlaygroundEnv(), cameras=("front", "side"), image_size=SIZE, goal_image=jnp.array([0.4]))


def test_playground_state_in_and_out(playground: pixels.PixelEnv) -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 2)

    @jaxrl_vis_envs.jit
    def rollout(keys: jax.Array) -> Any:
        start = jax.vmap(playground.reset)(keys)

        def step(state: Any, action: jax.Array) -> Any:
            return jax.vmap(playground.step, (0, None))(state, action), state.obs

        return start, jax.lax.scan(step, start, jnp.array([[1.0], [2.0]]))[0]

    start, end = rollout(keys)
    assert isinstance(end, PlaygroundState)
    shapes = {name: leaf.shape[1:] for name, leaf in end.obs.items()}
    image = (SIZE, SIZE, 3)
    cameras = {f"pixels/{name}{goal}": image for name in ("front", "side") for goal in ("", "/goal")}
    assert shapes == playground.observation_size == {"state": (1,), "privileged_state": (2,), **cameras}
    np.testing.assert_allclose(end.data.qpos, start.data.qpos + 0.3, rtol=1e-5)
    np.testing.assert_array_equal(end.obs["state"], end.data.qpos)
    for index in range(2):
        for camera in ("front", "side"):
            assert_same_colours(end.obs[f"pixels/{camera}"][index], truth(playground.mj_model, end.data.qpos[index], camera))
            assert_same_colours(end.obs[f"pixels/{camera}/goal"][index], truth(playground.mj_model, [0.4], camera))
    assert playground.action_size == 1 and playground.mjx_model is playground.env.mjx_model


@pytest.mark.parametrize("layout", ["dict", "images", "image"])
def test_several_frames_show_the_last_images(layout: Any) -> None:
    env = pixels.wrap(PlaygroundEnv(), "front", SIZE, goal_image=jnp.array([0.4]), frames=3, layout=layout)

    @jaxrl_vis_envs.jit
    def episode(key: jax.Array) -> list[Any]:
        states = [env.reset(key)]
        for _ in range(2):
            states.append(env.step(states[-1], jnp.array([2.0])))
        return states

    def stack(state: Any) -> np.ndarray:
        """Return the three images and that of the goal, [4, H, W, 3]."""
        names = ("pixels/front", "pixels/front/goal")
        joined = state.obs if layout == "image" else jnp.concatenate([state.obs[name] for name in names], axis=-1)
        return np.moveaxis(np.asarray(joined).reshape(SIZE, SIZE, 4, 3), 2, 0)

    states = episode(jax.random.PRNGKey(0))
    assert stack(states[0]).shape == (4, SIZE, SIZE, 3)
    images = [truth(env.mj_model, state.data.qpos, "front") for state in states]
    goal = truth(env.mj_model, [0.4], "front")
    for shown, expected in zip([*stack(states[0]), *stack(states[2])], [*images[:1] * 3, goal, *images, goal], strict=True):
        assert_same_colours(shown, expected)
    sizes = env.observation_size
    assert (sizes if layout == "image" else sizes["pixels/front"])[-1] == (12 if layout == "image" else 9)


def test_materials_and_textures_of_randomized_models_are_drawn() -> None:
    """Environments have different colours and textures of a material, as with Playground's randomisation of images."""
    env = PlaygroundEnv()
    env._mj_model = mujoco.MjModel.from_xml_string(TEXTURED_XML)
    env._mjx_model = model = mjx.put_model(env._mj_model)
    wrapped = pixels.wrap(env, "front", SIZE, textures=("stripes",))
    role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    stripes, rgba = env._mj_model.texture("stripes").id, jnp.array([0.2, 1.0, 0.2, 1.0])
    textures = jnp.stack([model.mat_texid, model.mat_texid.at[0, role].set(stripes)])
    colours = jnp.stack([model.mat_rgba, model.mat_rgba.at[0].set(rgba)])

    def reset(texture: jax.Array, colour: jax.Array) -> Any:
        inner = wrapped.unwrapped
        inner._mjx_model = model.replace(mat_texid=texture, mat_rgba=colour)
        try:
            return inner.reset(jax.random.PRNGKey(0)).obs["pixels/front"]
        finally:
            inner._mjx_model = model

    images = jaxrl_vis_envs.jit(jax.vmap(reset))(textures, colours)
    other = mujoco.MjModel.from_xml_string(TEXTURED_XML)
    qpos = jaxrl_vis_envs.jit(env.reset)(jax.random.PRNGKey(0)).data.qpos
    assert_same_colours(images[0], truth(other, qpos, "front"))
    other.mat_texid[0, role], other.mat_rgba[0] = stripes, rgba
    assert_same_colours(images[1], truth(other, qpos, "front"))
    assert np.abs(np.asarray(images[1] - images[0])).max() > 0.2


def test_randomized_models_are_drawn(playground: pixels.PixelEnv) -> None:
    """The unwrapped environment's model is replaced while tracing, as by Playground's wrapper for domain randomisation."""
    model = playground.mjx_model
    heights = jnp.array([0.0, 0.5])
    colours = jnp.stack([model.geom_rgba, model.geom_rgba.at[1].set(jnp.array([0.0, 1.0, 0.0, 1.0]))])

    def reset(height: jax.Array, rgba: jax.Array) -> Any:
        env = playground.unwrapped
        env._mjx_model = model.replace(geom_rgba=rgba, body_pos=model.body_pos.at[1, 2].add(height))
        try:
            return env.reset(jax.random.PRNGKey(0)).obs["pixels/front"]
        finally:
            env._mjx_model = model

    images = jaxrl_vis_envs.jit(jax.vmap(reset))(heights, colours)
    assert playground.env._mjx_model is model
    green = (images[..., 1] > 0.2) & (images[..., 0] < 0.05)
    rows = np.nonzero(np.asarray(green[1]).any(axis=1))[0]
    assert not green[0].any() and green[1].sum() > 5 and rows.mean() < SIZE / 2


def test_environment_never_seen_before_works_from_its_class_and_a_camera_name() -> None:
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class State:
        data: Any
        obs: jax.Array

    class Unseen:
        mj_model = mujoco.MjModel.from_xml_string(_XML)

        def reset(self, key: jax.Array) -> State:
            data = mjx.make_data(self.mj_model)
            return State(data, data.qpos)

        def step(self, state: State, action: jax.Array) -> State:
            return State(state.data.replace(qpos=action), action)

    env = pixels.wrap(Unseen(), "front", SIZE)
    state = jaxrl_vis_envs.jit(lambda: env.step(env.reset(jax.random.key(0)), jnp.array([0.3])))()
    assert type(state) is State and set(state.obs) == {"state", "pixels/front"}
    assert_same_colours(state.obs["pixels/front"], truth(env.mj_model, [0.3], "front"))


@pytest.mark.parametrize("backend", ["mjx", "generalized"])
def test_brax_environments_under_brax_wrappers(backend: str) -> None:
    env = pixels.wrap(
        brax.envs.get_environment("inverted_pendulum", backend=backend),
        image_size=SIZE,
        layout="images",
        goal_image=jnp.zeros(2),
    )
    assert env.backend == backend and env.observation_size == {
        "pixels/free": (SIZE, SIZE, 3),
        "pixels/free/goal": (SIZE, SIZE, 3),
    }
    wrapped = training.wrap(env, episode_length=1, action_repeat=1)
    first = jaxrl_vis_envs.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    state = jaxrl_vis_envs.jit(wrapped.step)(first, jnp.ones((2, 1)))
    # What a step returns can be stepped again.
    again = jax.eval_shape(wrapped.step, state, jnp.ones((2, 1)))
    assert list(map(jnp.shape, jax.tree.leaves(again))) == list(map(jnp.shape, jax.tree.leaves(state)))
    assert isinstance(state, brax.envs.State) and state.done.all()
    # The episode began anew, where the first one did.
    np.testing.assert_array_equal(state.obs["pixels/free"], first.obs["pixels/free"])
    qpos = np.asarray(state.pipeline_state.q[0])
    assert_same_colours(state.obs["pixels/free"][0], truth(env.views.mj_model, qpos, -1))
    assert_same_colours(state.obs["pixels/free/goal"][0], truth(env.views.mj_model, [0.0, 0.0], -1))


def test_brax_wrapper_for_domain_randomization_is_followed() -> None:
    env = pixels.wrap(training.EpisodeWrapper(brax.envs.get_environment("inverted_pendulum"), 5, 1), image_size=SIZE)
    system = env.sys

    def randomize(system: Any) -> tuple[Any, Any]:
        green = jnp.full_like(system.geom_rgba, 0.0).at[:, 1:].set(1.0).at[:, 2].set(0.0)
        axes = jax.tree.map(lambda leaf: None, system).tree_replace({"geom_rgba": 0})
        return system.tree_replace({"geom_rgba": jnp.stack([system.geom_rgba, green])}), axes

    wrapped = training.DomainRandomizationVmapWrapper(env, randomize)
    images = jaxrl_vis_envs.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2)).obs["pixels/free"]
    assert env.env.unwrapped.sys is system
    assert_same_colours(images[0], truth(env.views.mj_model, jnp.zeros(2), -1))
    shown = np.asarray(images[1]).reshape(-1, 3)
    assert (shown[:, 1] > 0.1).any() and shown[shown[:, 1] > 0.1][:, [0, 2]].max() < 0.1


def test_observations_have_the_form_that_brax_vision_networks_take(playground: pixels.PixelEnv) -> None:
    networks = make_ppo_networks_vision(playground.observation_size, playground.action_size)
    obs = jax.eval_shape(playground.reset, jax.random.PRNGKey(0)).obs
    zeros = jax.tree.map(lambda leaf: jnp.zeros((2, *leaf.shape), leaf.dtype), obs)
    network = networks.policy_network
    logits = jax.eval_shape(lambda: network.apply(None, network.init(jax.random.PRNGKey(0)), zeros))
    assert logits.shape == (2, 2)


def test_plain_model_and_step_function(cart: mujoco.MjModel) -> None:
    def push(data: mjx.Data, action: jax.Array) -> mjx.Data:
        return data.replace(qpos=data.qpos + action)

    env = pixels.wrap(
        cart, "front", SIZE, ("rgb", "depth"), lambda state: state.pipeline_state.qpos + 0.2,
        layout="image", dtype="uint8", depth_range=(1.0, 3.0), step=push,
    )  # fmt: skip
    state = jaxrl_vis_envs.jit(lambda: env.step(env.reset(jax.random.key(0)), jnp.array([-0.2])))()
    assert state.obs.shape == env.observation_size == (SIZE, SIZE, 8) and state.obs.dtype == jnp.uint8
    for start, at in ((0, -0.2), (4, 0.2)):
        frame = truth(cart, [at], "front")
        assert_same_colours(state.obs[..., start : start + 3] / 255.0, frame)
        np.testing.assert_allclose(
            state.obs[..., start + 3], np.rint(255 * np.clip((np.asarray(frame.depth) - 1) / 2, 0, 1)), atol=1
        )
    np.testing.assert_allclose(state.info["unwrapped_obs"], [-0.2, 0.0], atol=1e-6)


def test_state_tasks_of_this_project_have_images_through_their_adapter_to_brax() -> None:
    env = pixels.wrap(BraxEnv("Reacher", reward="dense"), None, SIZE, goal_image=lambda state: state.pipeline_state.data.qpos)
    state, first = jaxrl_vis_envs.jit(lambda: (env.step(start := env.reset(jax.random.PRNGKey(0)), jnp.ones(2)), start))()
    start, end = (np.asarray(each.pipeline_state.data.qpos) for each in (first, state))
    assert not np.allclose(start, end)
    assert_same_colours(state.obs["pixels/free"], truth(env.views.mj_model, end, -1))
    assert_same_colours(state.obs["pixels/free/goal"], truth(env.views.mj_model, start, -1))
    assert state.obs["state"].shape == (env.env.observation_size,)


def test_plain_model_without_a_step_function_is_driven_by_its_actuators(cart: mujoco.MjModel) -> None:
    env = pixels.wrap(cart, "front", 8)
    state = jaxrl_vis_envs.jit(lambda: env.step(env.reset(jax.random.key(0)), jnp.array([1.0])))()
    assert env.action_size == 1 and state.obs["state"][1] > 0


def test_gymnasium_environments_stay_on_the_host() -> None:
    inner = gymnasium.make("InvertedPendulum-v5")
    env = pixels.wrap(inner, None, SIZE, ("rgb", "depth", "bodies"), np.array([0.0, 0.3]))
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    observation, *_ = env.step(np.array([2.0]))
    assert observation in env.observation_space and observation["pixels/free"].dtype == np.uint8
    assert_same_colours(observation["pixels/free"] / 255.0, truth(inner.unwrapped.model, inner.unwrapped.data.qpos, -1))
    assert_same_colours(observation["pixels/free/goal"] / 255.0, truth(inner.unwrapped.model, [0.0, 0.3], -1))
    assert set(np.unique(observation["pixels/free/bodies"])) <= set(env.views.body_names)
    assert all(observation[name].flags.writeable for name in observation)


class TargetEnv(gymnasium.Env):
    """Environment of a cart; rendering moves the site of its target and computes poses afterwards, as in Gymnasium-Robotics."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        spec = mujoco.MjSpec.from_string(_XML)
        # Not at the origin: MuJoCo ignores later positions of a site that starts there.
        spec.worldbody.add_site(name="target", pos=[0.6, 0.0, 1.0], size=[0.1, 0.1, 0.1], rgba=[0.0, 1.0, 0.0, 1.0])
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self.data.qpos.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 10)
        return self.data.qpos.copy(), 0.0, False, False, {}

    def _render_callback(self) -> None:
        self.model.site("target").pos = TARGET
        mujoco.mj_forward(self.model, self.data)


TARGET = (-0.6, 0.0, 1.0)  # m


def test_targets_that_move_when_gymnasium_robotics_renders_are_in_the_images() -> None:
    inner, bare = TargetEnv(), TargetEnv()
    env = pixels.wrap(inner, "front", SIZE, ("rgb", "segmentation"), site_groups=(0, 1, 2))
    bare.reset()
    env.reset(seed=0)
    for _ in range(2):
        observation, *_ = env.step(np.ones(1))
        bare.step(np.ones(1))
    # Neither the physics nor the model has noticed.
    np.testing.assert_array_equal(inner.data.xpos, bare.data.xpos)
    np.testing.assert_array_equal(inner.data.qpos, bare.data.qpos)
    np.testing.assert_array_equal(inner.model.site_pos, bare.model.site_pos)
    inner._render_callback()
    expected = np.asarray(render(env.views.scenes["front"], inner.data).segmentation)
    assert inner.model.ngeom in expected
    np.testing.assert_array_equal(observation["pixels/front/segmentation"][..., 0], expected)


def test_frames_on_the_host_are_gymnasiums() -> None:
    with pytest.raises(ValueError, match="FrameStackObservation"):
        pixels.wrap(gymnasium.make("InvertedPendulum-v5"), frames=3)


def test_wrapped_environments_can_be_pickled(playground: pixels.PixelEnv) -> None:
    copy = pickle.loads(pickle.dumps(playground))
    assert copy.observation_size == playground.observation_size


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(cameras="fornt"), "there is no camera 'fornt'"),
        (dict(cameras=[]), "at least one camera"),
        (dict(cameras=["front", "front"]), "same name"),
        (dict(outputs="rgbd"), "outputs must be among"),
        (dict(outputs=()), "outputs must be among"),
        (dict(image_size={"side": 8}), "image_size by camera must name front"),
        (dict(clip_range=(2.0, 1.0)), "clip_range must be"),
        (dict(depth_range=(2.0, 1.0)), "depth_range must be"),
        (dict(layout="tuple"), "layout must be one of"),
        (dict(dtype="int8"), "dtype must be one of"),
        (dict(frames=0), "frames must be a whole number"),
        (dict(textures=("wood",)), "textures must be among the model's"),
        (dict(step=lambda data, action: data), "step is for a mujoco.MjModel"),
    ],
)
def test_wrong_options_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pixels.wrap(PlaygroundEnv(), **{"cameras": "front", **arguments})


def test_what_has_no_model_is_refused() -> None:
    with pytest.raises(ValueError, match="object has no MuJoCo model"):
        pixels.wrap(object())
    with pytest.raises(ValueError, match="got the class PlaygroundEnv"):
        pixels.wrap(PlaygroundEnv)
    with pytest.raises(ValueError, match="renders itself"):
        pixels.wrap(jaxrl_vis_envs.make("Reacher"))


# -- Views


def test_views_share_their_arrays_and_give_all_outputs(cart: mujoco.MjModel) -> None:
    views = pixels.Views(
        cart,
        {"front": "front", "above": 2},
        {"front": 24, "above": (12, 20)},
        {"front": pixels.OUTPUTS, "above": "depth"},
        {"front": (0.1, 7.0), "above": None},
    )
    front, above = views.scenes["front"], views.scenes["above"]
    assert front.rgba is above.rgba and front.size is above.size and front.light_position is above.light_position
    assert float(front.zfar) == 7.0 and float(above.zfar) == pytest.approx(cart.vis.map.zfar * cart.stat.extent)
    mj_data = mujoco.MjData(cart)
    mujoco.mj_forward(cart, mj_data)
    images = jax.tree.map(np.asarray, jax.jit(lambda: views(mj_data))())
    frame = render(front, mj_data, normals=True)
    assert {name: set(outputs) for name, outputs in images.items()} == {"front": set(pixels.OUTPUTS), "above": {"depth"}}
    assert images["above"]["depth"].shape == (12, 20)
    for output in ("rgb", "depth", "segmentation", "normals"):
        np.testing.assert_allclose(images["front"][output], getattr(frame, output), atol=1 if output == "rgb" else 1e-5)
    shown = {views.geom_names[label] for label in np.unique(images["front"]["segmentation"])}
    assert shown == {"floor", "box", "geom 2", "sky"}
    assert {views.body_names[label] for label in np.unique(images["front"]["bodies"])} == {"world", "cart", "sky"}
    np.testing.assert_array_equal(images["front"]["bodies"] == 1, np.isin(images["front"]["segmentation"], (1, 2)))
    assert images["front"]["depth"].max() == 7.0


@pytest.mark.parametrize("camera", ["front", "side", 2])
def test_intrinsics_project_points_as_opencv_does(cart: mujoco.MjModel, camera: str | int) -> None:
    mj_data = mujoco.MjData(cart)
    mujoco.mj_forward(cart, mj_data)
    scene = Scene.from_mjmodel(cart, camera=camera, height=20, width=30)
    depth = render(scene, mj_data).depth
    world, local = np.asarray(scene.points(depth, mj_data)), np.asarray(scene.points(depth))
    transform = np.asarray(scene.extrinsics(mj_data), np.float64)
    turn, _ = cv2.Rodrigues(transform[:3, :3])
    projected, _ = cv2.projectPoints(
        world.reshape(-1, 3).astype(np.float64), turn, transform[:3, 3], np.asarray(scene.intrinsics(), np.float64), None
    )
    rows, columns = np.indices((20, 30))
    np.testing.assert_allclose(projected.reshape(20, 30, 2), np.stack([columns, rows], axis=-1), atol=2e-3)
    np.testing.assert_allclose(local[..., 2], depth)
    np.testing.assert_allclose(local @ transform[:3, :3] + (-transform[:3, 3] @ transform[:3, :3]), world, atol=1e-3)
    # Points of the floor are on the floor.
    floor = np.asarray(render(scene, mj_data).segmentation) == 0
    assert floor.any()
    np.testing.assert_allclose(world[floor][:, 2], 0.0, atol=1e-4)


def test_orthographic_cameras_have_points_and_no_intrinsics(cart: mujoco.MjModel) -> None:
    mj_data = mujoco.MjData(cart)
    mujoco.mj_forward(cart, mj_data)
    scene = Scene.from_mjmodel(cart, camera="flat", height=20, width=30)
    frame = render(scene, mj_data)
    floor = np.asarray(frame.segmentation) == 0
    np.testing.assert_allclose(np.asarray(scene.points(frame.depth, mj_data))[floor][:, 2], 0.0, atol=1e-4)
    with pytest.raises(ValueError, match="orthographic"):
        scene.intrinsics()
    with pytest.raises(ValueError, match="jax.vmap"):
        scene.points(jnp.zeros((2, 20, 30)))


# -- Parity


@pytest.mark.parametrize("name", make_pixels_references.MODELS)
def test_images_of_wrapped_environments_equal_those_of_mujoco(name: str) -> None:
    model = make_pixels_references.MODELS[name]
    mj_model, references = model.load(), render_references.load(name)
    size = references.rgb.shape[1:3]
    env = pixels.wrap(
        mj_model, model.camera, size, ("rgb", "depth", "segmentation"), step=lambda data, qpos: data.replace(qpos=qpos)
    )

    @jaxrl_vis_envs.jit
    def draw(scenes: dict[str, Scene], qpos: jax.Array) -> Any:
        # Scenes are an argument: megabytes of textures, which are constants otherwise, take longer to compile than the rest.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(env.views, "scenes", scenes)
            # One after the other: under `jax.vmap` as much again would have to be traced.
            return jax.lax.map(lambda each: env.step(env.reset(jax.random.key(0)), each).obs, qpos)

    images = jax.tree.map(np.asarray, draw(env.views.scenes, jnp.asarray(references.qpos, jnp.float32)))
    tally, prefix = Tally(surface_kinds(mj_model)), f"pixels/{model.camera}"
    for index in range(len(references.qpos)):
        colours = np.rint(255.0 * images[prefix][index]).astype(np.uint8)
        ours = Frame(colours, images[f"{prefix}/depth"][index, :, :, 0], images[f"{prefix}/segmentation"][index, :, :, 0])
        tally.add(ours, Frame(references.rgb[index], references.depth[index], references.segmentation[index]))
    assert not tally.failures(), tally.measures()


@pytest.mark.parametrize("name", make_pixels_references.MODELS)
def test_normals_are_those_of_the_depths_of_mujoco(name: str) -> None:
    """The reference is the surface through MuJoCo's depths, where one object fills a pixel's neighbourhood."""
    model = make_pixels_references.MODELS[name]
    mj_model, references = model.load(), render_references.load(name)
    views = pixels.Views(mj_model, model.camera, references.rgb.shape[1:3], ("normals", "segmentation"))
    mj_data, poses = mujoco.MjData(mj_model), []
    for qpos in references.qpos:
        mj_data.qpos[:] = qpos
        mujoco.mj_forward(mj_model, mj_data)
        poses.append(poses_of(mj_data))
    draw = jaxrl_vis_envs.jit(lambda poses: jax.lax.map(lambda each: views(SimpleNamespace(**each))[model.camera], poses))
    ours = jax.tree.map(np.asarray, draw(jax.tree.map(lambda *rows: np.stack(rows), *poses)))
    scene = views.scenes[model.camera]
    points = np.stack([np.asarray(scene.points(depth), np.float64) for depth in references.depth]) * [1.0, -1.0, -1.0]
    across, down = points[:, 1:-1, 2:] - points[:, 1:-1, :-2], points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    expected = np.cross(down, across)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    inner, labels = np.s_[:, 1:-1, 1:-1], references.segmentation
    smooth = (~near_edges(labels) & (labels >= 0))[inner]
    angles = np.rad2deg(np.arccos(np.clip(np.sum(expected * ours["normals"][inner], axis=-1), -1.0, 1.0)))
    floor = smooth & (mj_model.geom_type[np.maximum(labels, 0)] == mujoco.mjtGeom.mjGEOM_PLANE)[inner]
    assert floor.sum() > 200 and np.median(angles[floor]) < 1.0
    # Differences over two pixels blur the curvature of thin capsules.
    assert (smooth & ~floor).sum() > 30 and np.median(angles[smooth & ~floor]) < 8.0
    assert np.all(ours["normals"][ours["segmentation"] < 0] == 0)
