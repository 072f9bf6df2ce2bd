"""Tests of arms among stalks: kinematics, bending, grasps, and the control loops."""

import dataclasses
import functools
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.grasping.arm import approach, control
from jaxrl_vis.stalks.grasping.arm.choice import MIN_CLEARANCE, choose_approaches, choose_nearest
from jaxrl_vis.stalks.grasping.arm.policy_loop import STALKS, check_policy, reach_by_policy
from jaxrl_vis.stalks.grasping.arm.reach import LOOK_INTERVAL, ArmView, ReachResult, build_arm_model, reach
from jaxrl_vis.stalks.grasping.evaluation.attempts import redetecting_observer, wind_keys
from jaxrl_vis.stalks.grasping.perception.lines import GraspPoint
from jaxrl_vis.stalks.grasping.report import path_figure, video
from jaxrl_vis_envs.plants import TRAINING, bending, draw
from jaxrl_vis_envs.plants.field import Plot, Stalk
from jaxrl_vis_envs.plants.stand import KNEE, MAST_DISTANCE, Stands, stand_of_lines, stand_origin, stands_at
from jaxrl_vis_envs.tasks import stalk_arm
from jaxrl_vis_envs.tasks.stalk_reach import StalkReach

HEIGHT = 0.7
TARGETS = np.array(
    [
        [1.0, 0.0, HEIGHT],  # alone, straight ahead
        [1.25, 0.03, 0.55],  # alone, to the right, lower
        [0.8, -0.02, 0.95],  # alone, to the left, higher
        [2.0, 0.0, HEIGHT],  # of two that stand 18 mm apart
        [3.0, 0.0, HEIGHT],  # nothing there
        [1.0, 0.9, HEIGHT],  # out of reach
        [4.0, 0.0, HEIGHT],  # behind another one in the same line
        [5.0, 0.0, HEIGHT],  # alone, and so thin that jaws that close fast go through it
    ]
)
MASTS = np.array([1.0, 1.0, 1.0, 2.0, 3.0, 1.0, 4.0, 5.0])
THIN = 7
FEET = [(1.0, 0.0), (1.25, 0.03), (0.8, -0.02), (1.991, 0.0), (2.009, 0.0), (4.0, 0.0), (4.0, -0.05), (5.0, 0.0)]
ALONE = [0, 1, 2, 7]


def straight(x: float, y: float, radius: float = 0.006) -> Stalk:
    heights = np.linspace(0.0, 2.4, 61)
    points = np.stack([np.full(61, x), np.full(61, y), heights], axis=1)
    even = np.full(61, radius)
    return Stalk(0, points, even, even, heights, np.zeros(61), np.array([0.2]), 1.0, 0.0)


@functools.cache
def row() -> Plot:
    return Plot(TRAINING, 0, tuple(straight(*place, 0.003 if index == THIN else 0.006) for index, place in enumerate(FEET)), ())


@functools.cache
def stands() -> Stands:
    return stands_at(row(), MASTS, TARGETS, 4)


@functools.cache
def still_air() -> ReachResult:
    return reach(stands(), TARGETS, jax.random.key(0))


def stalks_held(result: ReachResult, index: int) -> set[int]:
    return {int(each) for each in stands().stalk[index][result.held[index]]}


def test_both_solutions_bring_the_grip_to_the_target():
    rng = np.random.default_rng(0)
    radius, bearing = rng.uniform(0.31, 0.69, 200), rng.uniform(-1.2, 1.2, 200)
    target = np.stack([radius * np.sin(bearing), radius * np.cos(bearing) - MAST_DISTANCE, rng.uniform(0.4, 1.3, 200)], axis=1)
    solutions = [stalk_arm.joints_at(target, np.full(200, side), np) for side in (1.0, -1.0)]
    for side, joints in zip((1.0, -1.0), solutions):
        np.testing.assert_allclose(stalk_arm.grip_at(joints, np), target, atol=1e-9)
        assert (np.sign(joints[:, 2]) == side).all()
    assert (np.abs(solutions[0] - solutions[1]).max(axis=1) > 0.01).all()


def test_the_model_has_the_dimensions_that_the_formulas_have():
    model = build_arm_model(4).mj_model
    data = mujoco.MjData(model)
    for target in ([0.1, -0.05, 0.6], [-0.3, 0.02, 1.1]):
        data.qpos[:3] = stalk_arm.joints_at(np.array(target), -1.0, np)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.site("grip").xpos, target, atol=1e-6)
    jaws = [data.geom(name).xpos for name in stalk_arm.JAWS]
    assert np.linalg.norm(jaws[0] - jaws[1]) == pytest.approx(stalk_arm.OPENING + 2 * stalk_arm.JAW_RADIUS)
    assert stalk_arm.OPENING >= 0.04
    np.testing.assert_allclose(
        model.jnt_range[:3, 1], [stalk_arm.SLIDE_RANGE[1], stalk_arm.SHOULDER_RANGE, stalk_arm.ELBOW_RANGE]
    )


@pytest.mark.parametrize(
    ("place", "can"),
    [
        ((0.0, 0.0, 0.7), True),
        ((0.4, 0.0, 0.7), True),
        ((0.45, 0.0, 0.7), False),  # further than both links
        ((0.0, 0.16, 0.7), False),
        ((0.0, -0.2, 0.7), False),  # the folded gripper is there already
        ((0.0, 0.0, 1.31), False),  # above the slide's end
        ((0.0, 0.0, 0.39), False),
        ((0.0, -1.0, 0.7), False),  # behind the mast
    ],
)
def test_what_can_be_reached_is_what_the_geometry_allows(place: tuple[float, float, float], can: bool):
    rail = stand_origin(1.7)
    assert bool(approach.is_within_reach(rail, rail + np.array(place))) is can


def test_the_way_is_a_straight_line_out_of_the_shoulder():
    timing, target = control.Timing(), jnp.array([0.2, 0.05, 0.9])
    times = jnp.linspace(timing.turn, timing.reach, 30)
    way = np.asarray(jax.vmap(lambda time: control.plan_movement(target, jnp.asarray(control.HOME), time, timing))(times))
    np.testing.assert_allclose(way[-1], target, atol=1e-5)
    away, line = way[:, :2] - stalk_arm.SHOULDER, np.asarray(target)[:2] - stalk_arm.SHOULDER
    assert np.abs(away[:, 0] * line[1] - away[:, 1] * line[0]).max() < 1e-5
    assert (np.diff(np.linalg.norm(away, axis=1)) > -1e-6).all()
    np.testing.assert_allclose(way[:, 2], 0.9, atol=1e-5)


def test_room_is_the_least_distance_of_the_open_gripper_from_others():
    target = np.array([[0.0, 0.0, HEIGHT]])

    def beside(x: float, y: float = 0.0, whole_way: bool = False) -> float:
        return float(approach.clearance(target, np.array([[[x, y]]]), np.array([[0.006]]), whole_way).max())

    assert beside(np.nan) == np.inf
    assert beside(0.06) > beside(0.045) > beside(0.03)
    assert beside(0.0) < 0 and beside(0.06) < 0.06 - 0.006 - stalk_arm.OPENING / 2
    # One in the way does not matter beside the jaws at the target, but does on the way there.
    assert beside(0.0, -0.08) > 0.005 > 0 > beside(0.0, -0.08, whole_way=True)


def test_the_folded_arm_needs_room_as_it_turns():
    target = np.array([[-0.42, -0.1, HEIGHT]])

    def beside(x: float, y: float, whole_way: bool = True) -> float:
        return float(approach.clearance(target, np.array([[[x, y]]]), np.array([[0.006]]), whole_way).max())

    assert beside(-0.12, -0.22) < 0 < beside(0.12, -0.22)  # it turns to the left
    assert beside(-0.12, -0.1) > 0.005  # behind where it turns
    assert beside(-0.12, -0.22, whole_way=False) > 0.1


def test_the_way_with_most_room_is_taken():
    origins = np.array([stand_origin(x) for x in (-0.35, 0.0, 0.35)])
    target = np.array([0.0, 0.0, HEIGHT])

    def best(*others: tuple[float, float]) -> approach.Approach:
        return approach.best_approach(origins, target, np.array(others).reshape(-1, 2), np.full(len(others), 0.006))

    assert best()[::2] == (1, np.inf)  # straight ahead, which is shortest
    assert best((0.0, -0.1)).stop in (0, 2) and best((0.0, -0.1)).room > 0.005
    assert best((0.0, -0.1), (-0.06, -0.1)).stop == 2
    assert best((0.0, -0.1), (0.06, -0.1)).stop == 0
    assert best((0.015, 0.0)).room < 0  # there is no room from anywhere
    assert approach.best_approach(origins, np.array([2.0, 0.0, HEIGHT]), np.zeros((0, 2)), np.zeros(0)).stop == -1


def test_stands_pass_through_the_stalks_of_their_plot():
    plot = draw(TRAINING, 3)
    indices = np.arange(0, len(plot.measured), 5)
    targets = np.array([plot.measured[index].at_height(HEIGHT)[0] for index in indices])
    found = stands_at(plot, targets[:, 0], targets)
    for place, index in enumerate(indices):
        assert index in found.stalk[place]
        for slot, stalk in enumerate(found.stalk[place]):
            knee, top = found.knee[place, slot], found.top[place, slot]
            there = knee + (HEIGHT - knee[2]) / (top - knee)[2] * (top - knee) + found.origin[place]
            np.testing.assert_allclose(there, plot.measured[stalk].at_height(HEIGHT)[0], atol=1e-5)
            assert found.radius[place, slot, 1] == pytest.approx(plot.measured[stalk].diameter(HEIGHT) / 2)
    assert stands().stalk[3, 0] in (3, 4) and (stands_at(row(), [1.0], TARGETS[:1], 12).stalk[0] == -1).sum() == 4


def test_a_stand_of_nothing_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"x \[B\] and targets \[B, 3\], got \[2\] and \[1, 3\]"):
        stands_at(row(), np.zeros(2), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="1 reaches and 2 plots"):
        stands_at([row(), row()], np.zeros(1), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="finite"):
        stands_at(row(), np.zeros(1), np.full((1, 3), np.nan))
    empty = stands_at(Plot(TRAINING, 0, (), ()), np.zeros(1), np.zeros((1, 3)))
    assert not empty.is_present.any()


def test_a_stalk_gives_way_like_a_beam():
    """Its stiffness at several heights z, in C MuJoCo, agrees with 3 EI / z^3 of a beam without taper."""
    arms, radius = build_arm_model(4), 0.006
    model = arms.mj_model.__copy__()
    stalk_shapes = jax.tree.map(lambda part: part[0], bending.shapes(stands()))
    fitted = bending.set_stalk_properties(arms.model, arms.layout, stalk_shapes)
    for name in ("body_pos", "body_ipos", "body_mass", "body_inertia", "jnt_stiffness", "dof_damping"):
        getattr(model, name)[:] = getattr(fitted, name)
    rigidity = bending.MODULUS * np.pi * radius**4 / 4
    data, upper = mujoco.MjData(model), int(arms.layout.upper[0])
    force = np.array([0.05, 0.0, 0.0])
    for height, tolerance in ((0.5, 0.01), (0.8, 0.07), (1.0, 0.01)):
        mujoco.mj_resetData(model, data)
        mujoco.mj_forward(model, data)
        torque = np.zeros(model.nv)
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xpos[upper] + [0, 0, height - 0.3], upper, torque)
        hinges = torque / model.jnt_stiffness.clip(1e-9)
        data.qpos[5:] = hinges[5:]
        mujoco.mj_forward(model, data)
        moved = data.xpos[upper] + data.xmat[upper].reshape(3, 3) @ [0, 0, height - 0.3]
        expected = force[0] * height**3 / (3 * rigidity)
        assert moved[0] - data.mocap_pos[0][0] == pytest.approx(expected, rel=tolerance)


def test_stalks_sway_as_far_as_they_are_said_to():
    foot = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], np.float32)
    gusts = jax.vmap(lambda key: bending.sample_gusts(key, 0.02))(jax.random.split(jax.random.key(0), 64))
    times = jnp.linspace(0.0, 60.0, 400)
    sway = jax.vmap(lambda gust: jax.vmap(lambda time: bending.displacement(gust, foot, time))(times))(gusts)
    distance = np.linalg.norm(np.asarray(sway), axis=-1)
    np.testing.assert_allclose(np.sqrt((distance**2).mean()), 0.02 / np.sqrt(2), rtol=0.05)
    # Where the hinges stand so, the stalk is there at the height that counts.
    layout, rest = build_arm_model(4).layout, build_arm_model(4).rest
    model = build_arm_model(4).mj_model
    data = mujoco.MjData(model)
    moved = np.tile(np.array([[0.01, -0.004]], np.float32), (4, 1))
    data.qpos[:] = bending.hinge_angles(layout, model.nv, jnp.asarray(moved))
    data.mocap_pos[:] = rest.mocap_pos
    mujoco.mj_forward(model, data)
    poses = types.SimpleNamespace(xpos=jnp.asarray(data.xpos), geom_xmat=jnp.asarray(data.geom_xmat.reshape(-1, 3, 3)))
    there = bending.at_height(poses, layout, bending.SWAY_HEIGHT)
    np.testing.assert_allclose(np.asarray(there)[:, :2] - data.mocap_pos[layout.mocap][:, :2], moved, atol=2e-4)


def test_a_stalk_that_stands_alone_is_held_alone():
    found = still_air()
    for index, stalk in zip(ALONE, (0, 1, 2, 7)):
        assert stalks_held(found, index) == {stalk}
    assert (found.error[ALONE] < 0.002).all()
    assert not found.arm_contact[ALONE].any() and not found.gripper_contact[ALONE].any()


def test_a_grasp_holds_none_or_several_where_none_or_several_are():
    found = still_air()
    assert stalks_held(found, 3) == {3, 4}
    assert stalks_held(found, 4) == set()
    # The jaws take the one in front along.
    assert stalks_held(found, 6) == {5, 6}


def test_an_arm_is_not_sent_where_it_cannot_go():
    found = still_air()
    np.testing.assert_array_equal(found.reachable, [True, True, True, True, True, False, True, True])
    assert np.isnan(found.error[5]) and not found.held[5].any()
    np.testing.assert_allclose(found.taken[5], np.tile(stand_origin(1.0) + control.HOME, (found.taken.shape[1], 1)), atol=2e-3)


def test_the_way_taken_is_the_one_planned():
    found = still_air()
    assert found.interval * found.path.shape[1] == pytest.approx(control.Timing().reach + control.Timing().close)
    away = np.linalg.norm(found.path - found.taken, axis=-1)[ALONE]
    end = round(control.Timing().reach / found.interval) - 1
    assert away.max() < 0.03 and away[:, end].max() < 0.002
    np.testing.assert_allclose(found.path[ALONE, end], TARGETS[ALONE], atol=1e-4)


def test_wind_moves_stalks_away_from_blind_jaws_and_looking_helps():
    wind, key = 60.0, jax.random.key(5)
    # Eight winds over one stalk that stands alone.
    scenes = Stands(**{field.name: np.repeat(getattr(stands(), field.name)[:1], 8, 0) for field in dataclasses.fields(Stands)})
    targets = np.repeat(TARGETS[:1], 8, axis=0)
    slot = int(np.flatnonzero(scenes.stalk[0] == 0)[0])
    blind = reach(scenes, targets, key, wind)
    times = []

    def look(sight: ArmView) -> np.ndarray:
        times.append(sight.time)
        return sight.stalks[:, slot]

    seeing = reach(scenes, targets, key, wind, observer=look)
    assert times == pytest.approx([LOOK_INTERVAL * count for count in range(1, 24)])
    assert seeing.held[:, slot].sum() > blind.held[:, slot].sum()
    assert not blind.held[:, slot].all()
    # Nothing seen, nothing changed.
    idle = reach(scenes, targets, key, wind, observer=lambda sight: np.full((8, 3), np.nan))
    np.testing.assert_array_equal(idle.taken, blind.taken)


def test_an_arm_meets_the_same_wind_in_any_company():
    keys = wind_keys(np.array([4, 4, 9]), np.array([0, 1, 0]))
    alone = wind_keys(np.array([9]), np.array([0]))
    assert jax.random.key_data(keys[2]).tolist() == jax.random.key_data(alone[0]).tolist()
    assert len({tuple(each) for each in np.asarray(jax.random.key_data(keys)).tolist()}) == 3
    order = np.array([1, 0, 2, 3, 4, 5, 6, 7])
    each = jax.random.split(jax.random.key(1), 8)
    scenes = Stands(**{field.name: getattr(stands(), field.name)[order] for field in dataclasses.fields(Stands)})
    one, other = reach(stands(), TARGETS, each, 20.0), reach(scenes, TARGETS[order], each[order], 20.0)
    np.testing.assert_allclose(one.taken[order], other.taken, atol=1e-5)


def test_what_is_found_again_is_late_wrong_by_as_much_and_expected_to_go_on():
    scenes = Stands(**{field.name: getattr(stands(), field.name)[:3] for field in dataclasses.fields(Stands)})
    slots = [int(np.flatnonzero(scenes.stalk[each] == each)[0]) for each in (0, 1)]
    look = redetecting_observer(scenes, np.array([0, 1, -1]), np.array([[0.002, 0.0], [np.nan, np.nan], [0.0, 0.0]]))
    found = []
    for time in range(4):
        stalks = np.zeros((3, 4, 3))
        stalks[0, slots[0]] = [0.01 * time, 0.0, HEIGHT + 0.001 * time]
        stalks[2] = 1.0
        found.append(look(ArmView(0.1 * time, np.zeros((3, 3)), stalks)))
    assert np.isnan(found[0]).all() and np.isnan(found[1]).all()
    # In the third look the second is known: 10 mm, going on by 10 mm a look for a look and a half.
    np.testing.assert_allclose(found[2][0], [0.010 + 0.015 + 0.002, 0.0, HEIGHT + 0.001], atol=1e-9)
    np.testing.assert_allclose(found[3][0], [0.020 + 0.015 + 0.002, 0.0, HEIGHT + 0.002], atol=1e-9)
    assert np.isnan(found[3][1:, :2]).all()


def line(x: float, y: float, slope: float = 0.0) -> GraspPoint:
    direction = np.array([slope, 0.0, 1.0])
    return GraspPoint(np.array([x, y, HEIGHT]), direction / np.linalg.norm(direction), 0.012, 2, 0.001)


def test_the_height_with_most_room_is_taken_and_what_is_blocked_is_refused():
    stops = np.array([stand_origin(x) for x in (-0.1, 0.0, 0.1)])
    (alone,) = choose_approaches([line(0.0, 0.0)], stops)
    assert not alone.is_blocked and alone.point[2] == HEIGHT and alone.room == np.inf
    # A neighbour that leans over the target at its height, and away from it below.
    leaning, other = choose_approaches([line(0.0, 0.0), line(0.02, -0.03, -0.3)], stops)
    assert leaning.point[2] < HEIGHT and leaning.room > MIN_CLEARANCE
    # Its neighbour is as thick as it is at the height of the grasp, and where it bends to.
    bent = dataclasses.replace(line(0.1, 0.0), bend=(-0.5, 0.0), taper=-0.02)
    rooms = [choose_approaches([line(0.0, 0.0), each], stops, (0.45, 0.45))[0].room for each in (line(0.1, 0.0), bent)]
    up = 0.45 - HEIGHT
    assert rooms[0] - rooms[1] == pytest.approx(0.5 * up**2 - 0.5 * 0.02 * up, abs=0.003)
    # Two that stand as near at every height.
    assert all(each.is_blocked for each in choose_approaches([line(0.0, 0.0), line(0.015, 0.0)], stops))
    # What is out of reach is not blocked.
    (far,) = choose_approaches([line(2.0, 0.0)], stops)
    assert far.stop == -1 and not far.is_blocked
    near = choose_nearest([line(0.08, 0.0), line(2.0, 0.0)], stops, (0.75, 0.9))
    assert near[0].stop == 2 and near[0].point[2] == 0.75 and near[1].stop == -1


def test_stalks_as_found_are_a_stand():
    target = np.array([1.0, 0.0, HEIGHT])
    points = np.array([[1.0, 0.0, 0.9], [1.05, 0.02, 0.6], [3.0, 0.0, 0.7]])
    directions = np.array([[0.1, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 1.0]])
    found = stand_of_lines(points, directions, np.array([0.005, 0.006, 0.007]), 1.02, target, 2)
    assert sorted(found.stalk[0].tolist()) == [0, 1] and len(found) == 1
    slot = int(np.flatnonzero(found.stalk[0] == 0)[0])
    knee, top = found.knee[0, slot], found.top[0, slot]
    there = knee + (0.9 - knee[2]) / (top - knee)[2] * (top - knee) + found.origin[0]
    np.testing.assert_allclose(there, points[0], atol=1e-6)
    assert found.radius[0, slot, 1] == pytest.approx(0.005) and knee[2] == pytest.approx(KNEE)
    assert (stand_of_lines(points[:1], directions[:1], np.array([0.005]), 1.02, target, 2).stalk == [[0, -1]]).all()


def test_a_policy_drives_the_arm_and_its_goals_are_of_what_was_found():
    seen = []

    @dataclasses.dataclass(frozen=True, eq=False)
    class Onwards:
        """Policy that moves the grip straight ahead, and records its observations and goals."""

        env: StalkReach

        def __call__(self, observation: jax.Array, goal: jax.Array) -> jax.Array:
            jax.debug.callback(lambda *images: seen.append(images), observation, goal)
            return jnp.array([0.0, 0.6, 0.0])

    policy = Onwards(jaxrl_vis_envs.make("VisualStalkReach", image_size=16))
    plot = Plot(TRAINING, 0, (straight(1.0, 0.137), straight(1.12, 0.1)), ())
    targets = np.array([[1.0, 0.137, 0.75]])
    truth = stands_at(plot, np.array([1.0]), targets, STALKS)
    lines = np.array([[1.0, 0.137, 0.75]]), np.array([[0.0, 0.0, 1.0]])
    found = stand_of_lines(*lines, np.array([0.006]), 1.0, targets[0], STALKS)
    result = reach_by_policy(truth, found, targets, policy, wind_keys(np.zeros(1, int), np.zeros(1, int)), 0.0)
    jax.effects_barrier()
    assert {int(each) for each in truth.stalk[0][result.held[0]]} == {0}
    assert result.taken.shape == (1, 60, 3) and result.error[0] < 0.005
    assert not result.arm_contact[0, truth.stalk[0] == 1].any()
    observation, goal = (np.asarray(each) for each in seen[-1])
    assert observation.shape == goal.shape == (4, 16, 16)
    # The second stalk was not found: it is in what the policy sees, and not in its goal.
    assert (np.abs(observation[3].astype(int) - goal[3]) > 40).sum() > 4
    with pytest.raises(RequestError, match="must be a run of VisualStalkReach"):
        check_policy(types.SimpleNamespace(env=None, env_name="VisualFetchReach"))


def test_requests_that_make_no_sense_are_refused():
    key = jax.random.key(0)
    with pytest.raises(ValueError, match=r"targets must be \[B, 3\] for 8 stands"):
        reach(stands(), TARGETS[:3], key)
    with pytest.raises(ValueError, match="finite"):
        reach(stands(), np.full((8, 3), np.nan), key)
    with pytest.raises(ValueError, match="wind_mm must be at least 0"):
        reach(stands(), TARGETS, key, -1.0)
    with pytest.raises(ValueError, match="sides must be 1 or -1"):
        reach(stands(), TARGETS, key, sides=np.zeros(8))
    nothing = reach(stands_at([], np.zeros(0), np.zeros((0, 3)), 4), np.zeros((0, 3)), key)
    assert nothing.held.shape == (0, 4) and nothing.path.shape == (0, 120, 3)


def test_the_figure_shows_both_ways(tmp_path: Path):
    found = still_air()
    path_figure.draw_path(tmp_path / "new" / "way.png", stands(), TARGETS, found, 1)
    path_figure.draw_path(tmp_path / "unreachable.png", stands(), TARGETS, found, 5)
    assert Image.open(tmp_path / "new" / "way.png").size[0] > 600


def test_the_video_shows_the_arm_at_work(tmp_path: Path):
    video.write_reaches(tmp_path / "arm.gif", stands(), still_air(), [0, 1, 2, 3, -1, -1, 5, 7], [1], size=48)
    with Image.open(tmp_path / "arm.gif") as shown:
        assert shown.n_frames == 60 and shown.size == (48, 48 + 34)
        frames = []
        for index in (0, 30, 59):
            shown.seek(index)
            frames.append(np.asarray(shown.convert("RGB"))[34:].astype(int))
    assert all((np.abs(one - other).max(axis=-1) > 40).sum() > 10 for one, other in zip(frames, frames[1:]))
    with pytest.raises(RequestError, match="must end in one of"):
        video.write_reaches(tmp_path / "arm.avi", stands(), still_air(), [0] * 8, [0])
