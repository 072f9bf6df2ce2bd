"""From grasp points to attempts: where the robot stops for each, which way the arm goes, and what comes of it.

The robot stops where it took its pairs, and knows these places by its stitches. For each grasp point it chooses, of these stops
and both solutions of the arm, the way on which the other grasp points leave most room. The truth is used only to see what the
jaws hold, and what they could have held.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import jax
import numpy as np

from jaxrl_vis.grasping import arm
from jaxrl_vis.grasping.evaluate import RADIUS, Scene, stretch_of
from jaxrl_vis.grasping.lines import PREFERRED
from jaxrl_vis.grasping.metric import Attempt, Standing, match
from jaxrl_vis.grasping.perceive import Perception
from jaxrl_vis.grasping.reach import reach
from jaxrl_vis_envs.plants import Plot
from jaxrl_vis_envs.plants.stand import MAST_DISTANCE, Stands, concatenated, origin_of, stands_at

_USUAL = 0.007  # m: radius of a stalk whose thickness is not known


@dataclasses.dataclass(frozen=True)
class Plan:
    """The attempts of one run, before the arm moves.

    Attributes:
        run: Its number.
        targets: [B, 3] float64, m in the plot's frame.
        stalks: [B] int, the stalk that each is matched with; -1 for none.
        errors: [B] float64, horizontal distance from that stalk, m; nan for none.
        sides: [B] float64, 1 or -1: which solution the arm takes.
        stands: The true stalks around the arm, from where it tries each.
        standing: The stalks of the stretch.
    """

    run: int
    targets: np.ndarray
    stalks: np.ndarray
    errors: np.ndarray
    sides: np.ndarray
    stands: Stands
    standing: tuple[Standing, ...]


def plan(scene: Scene, perception: Perception, number: int) -> Plan:
    """What the arm is to try in a run.

    Args:
        scene: The run.
        perception: What was made of it.
        number: Of the run, in the metric.
    """
    plot, mount, poses = scene.plot, scene.mount, scene.drive.poses
    low, high = stretch_of(plot)
    # What the robot knows: its stops by its stitches, in the frame of the last one, and the grasp points in it.
    stops = np.array([motion(np.array([0.0, MAST_DISTANCE, 0.0])) for motion in perception.to_last]) * [1.0, 1.0, 0.0]
    radii = np.array([0.5 * each.thickness for each in perception.points])
    radii = np.where(np.isfinite(radii), radii, _USUAL)
    chosen, sides, targets = [], [], []
    for place, each in enumerate(perception.points):
        others = [other for other in range(len(radii)) if other != place]
        beside = np.array([perception.points[other].at_height(each.point[2]) for other in others]).reshape(-1, 3)
        way = arm.best_way(stops, each.point, beside[:, :2], radii[others])
        # It goes to that stop, and sends its arm to where the grasp point is from there.
        from_there = perception.to_last[way.stop].inverse()(each.point)
        targets.append(poses[way.stop].to_world(mount.pose.to_camera(from_there)))
        chosen.append(way.stop)
        sides.append(way.side)
    targets = np.array(targets).reshape(-1, 3)
    places = np.array([[stalk.at_height(target[2])[0][:2] for stalk in plot.measured] for target in targets])
    places = places.reshape(len(targets), len(plot.measured), 2)
    stalks = match(targets[:, :2], places, RADIUS)
    origins = np.array([origin_of(pose.position[0]) for pose in poses])
    standing = _standing(plot, origins, number)
    known = {each.stalk for each in standing}
    kept = [
        place
        for place, (target, stalk) in enumerate(zip(targets, stalks))
        if (stalk in known if stalk >= 0 else low <= target[0] <= high)
    ]
    off = [np.linalg.norm(targets[each, :2] - places[each, stalks[each]]) if stalks[each] >= 0 else np.nan for each in kept]
    return Plan(
        run=number,
        targets=targets[kept],
        stalks=stalks[kept],
        errors=np.array(off, float),
        sides=np.array(sides, float)[kept],
        stands=stands_at(plot, origins[np.array(chosen, int)[kept], 0], targets[kept]),
        standing=standing,
    )


def from_any_stop(points: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Which points the arm can go to from any of the places where the left camera was, as far as its geometry goes.

    Args:
        points: [B, 3], m in the robot frame of one pair.
        stops: [S, 3], where the robot frames of all pairs begin in that frame, m.

    Returns:
        [B] bool.
    """
    masts = (stops + [0.0, MAST_DISTANCE, 0.0]) * [1.0, 1.0, 0.0]
    return np.asarray(arm.reachable(masts[:, None], points[None]).any(axis=0))


def _standing(plot: Plot, origins: np.ndarray, number: int) -> tuple[Standing, ...]:
    """The true stalks of the stretch, and whether and how freely they could be reached."""
    low, high = stretch_of(plot)
    middles = np.array([stalk.at_height(PREFERRED)[0] for stalk in plot.measured]).reshape(-1, 3)
    radii = np.array([0.5 * stalk.diameter(PREFERRED) for stalk in plot.measured])
    found = []
    for index, middle in enumerate(middles):
        if not low <= middle[0] <= high:
            continue
        others = np.arange(len(middles)) != index
        way = arm.best_way(origins, middle, middles[others, :2], radii[others], enough=np.inf)
        beside = np.linalg.norm(middles[others, :2] - middle[:2], axis=1)
        found.append(Standing(number, index, way.stop >= 0, way.room, float(beside.min(initial=np.inf))))
    return tuple(found)


_MOST = 1024  # arms in a program


def carry_out(plans: Iterable[Plan], wind_mm: float, seed: int = 0) -> list[Attempt]:
    """Sends an arm to each target of all runs, side by side.

    Args:
        plans: One for each run.
        wind_mm: How far stalks sway, mm. What wind an arm meets does not depend on other runs.
        seed: Of the wind.
    """
    attempts: list[Attempt] = []
    for block in _blocks(list(plans)):
        runs = np.repeat([each.run for each in block], [len(each.targets) for each in block])
        places = np.concatenate([np.arange(len(each.targets)) for each in block])
        winds = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), runs)
        keys = jax.vmap(jax.random.fold_in)(winds, places)
        targets, stalks, errors, sides = (
            np.concatenate([getattr(each, name) for each in block]) for name in ("targets", "stalks", "errors", "sides")
        )
        stands = concatenated([each.stands for each in block])
        result = reach(stands, targets, keys, wind_mm, sides=sides)
        for place, (run, stalk, error) in enumerate(zip(runs, stalks, errors)):
            others = stands.stalk[place] != stalk
            attempts.append(
                Attempt(
                    run=int(run),
                    stalk=int(stalk) if stalk >= 0 else None,
                    held=frozenset(stands.stalk[place][result.held[place]].tolist()),
                    reachable=bool(result.reachable[place]),
                    collided=bool((result.touched[place] & others).any()),
                    brushed=bool((result.brushed[place] & others).any()),
                    aim_error=float(error),
                )
            )
    return attempts


def _blocks(plans: list[Plan]) -> Iterator[list[Plan]]:
    """Plans that are carried out together: as many as have at most `_MOST` targets, but at least one."""
    block: list[Plan] = []
    for each in plans:
        if not len(each.targets):
            continue
        if block and sum(len(other.targets) for other in block) + len(each.targets) > _MOST:
            yield block
            block = []
        block.append(each)
    if block:
        yield block
