"""Script that trains on four CPU devices; a separate process, as JAX fixes the number of devices when it starts.

It prints a line of JSON: the result of each comparison by name, such as the largest difference.
"""

import json
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import quick_jax  # noqa: F401
from learners import train_iteration

from jaxrl_vis.config import preset
from jaxrl_vis.learner.parallel.sharding import DATA, Layout, Shards, Spec
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.storage.arrays import named_leaves
from jaxrl_vis.run.storage.checkpoint import Checkpoints

ENV = probes.GoWhereTold()
CONFIG = preset(
    "debug",
    num_envs=8,
    updates_per_iteration=4,
    batch_size=16,
    replay_transitions=3 * 8 * ENV.horizon,
    eval_episodes=8,
    seeds=2,
)
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")


class Emulated(Layout):
    """Layout with the shards of each learner side by side on one device: the same functions, mapped by `jax.vmap`."""

    def spread(self, function, in_specs, out_specs, jit, final_specs=None, **options):
        count = self.shards.count

        def split(spec, leaf):
            if DATA not in spec:
                return jnp.broadcast_to(leaf, (count, *leaf.shape))
            axis = spec.index(DATA)
            return jnp.moveaxis(leaf.reshape(*leaf.shape[:axis], count, -1, *leaf.shape[axis + 1 :]), axis, 0)

        def join(spec, leaf):
            if DATA not in spec:
                return leaf[0]
            axis = spec.index(DATA)
            leaf = jnp.moveaxis(leaf, 0, axis)
            return leaf.reshape(*leaf.shape[:axis], -1, *leaf.shape[axis + 2 :])

        def are_alike(spec, leaf):
            """Return True if a leaf is sharded, or if the copies of a replicated leaf are equal on all shards."""
            same = jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
            return DATA in spec or jnp.array_equal(same, jnp.broadcast_to(same[0], same.shape), equal_nan=True)

        def each(change, specs, tree):
            return jax.tree.map(
                lambda spec, part: jax.tree.map(lambda leaf: change(spec, leaf), part),
                specs,
                tree,
                is_leaf=lambda leaf: isinstance(leaf, Spec),
            )

        @jax.jit  # all of it: taken apart and put together leaf by leaf, it would be dozens of programs
        def mapped(*arguments):
            found = jax.vmap(function, axis_name=DATA)(*each(split, in_specs, arguments))
            return each(join, out_specs, found), each(are_alike, out_specs, found)

        def call(*arguments):
            found, alike = mapped(*arguments)
            assert all(jax.tree.leaves(jax.device_get(alike)))
            return found

        return call


def trained(config, layout=None, iterations=3):
    """Train, and return the program, the last loop state, and the metrics of all iterations and of an evaluation."""
    program = make_train_step(ENV, config, layout)
    keys = jnp.stack([jax.random.key(seed) for seed in range(config.run.seeds)])
    loop, found = program.init(program.layout.put(keys, program.layout.by_seed)), []
    for _ in range(iterations):
        loop, metrics = train_iteration(program, loop)
        found.append(jax.device_get(metrics))
    key = program.layout.put(jax.random.key(9), program.layout.replicated)
    return program, loop, [*found, jax.device_get(program.evaluate(loop.train, key)[0])]


def trained_by_run(config, iterations=3):
    """Train with the programs of a run, and return the last loop state and the metrics of all iterations."""
    programs = Programs(config, make_train_step(ENV, config))
    loop, found = programs.init(programs.run_keys), []
    for _ in range(iterations):
        loop, metrics = programs.train_iteration(loop)
        found.append(jax.device_get(metrics))
    return loop, found


def plain(tree):
    leaves = named_leaves(tree).items()
    keys = {name for name, leaf in leaves if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)}
    return {name: np.asarray(jax.random.key_data(leaf) if name in keys else leaf) for name, leaf in leaves}


def difference(one, other):
    """Return the largest absolute difference between two trees, whose leaves are compared flattened."""
    one, other = plain(one), plain(other)
    assert one.keys() == other.keys()
    return max(float(np.max(np.abs(one[name].ravel().astype(np.float64) - other[name].ravel()))) for name in one)


def restored_differences(loop, folder):
    """Save a checkpoint and restore it on several numbers of devices.

    Return, by name of the case, the names of leaves that differ, and the numbers of devices on which the replay lies.
    """
    checkpoints = Checkpoints(Path(folder), echo=lambda line: None)
    checkpoints.save_full(3, loop, {})
    found = {}
    for devices, parts in ((1, None), (2, 1), (2, 2), (4, 2), (4, 4)):
        config = CONFIG.replace(devices=devices, data_devices=parts)
        programs = Programs(config, make_train_step(ENV, config))
        restored = checkpoints.restore_for_resume(programs.shapes)
        assert restored is not None and restored.loop is not None
        expected, there = plain(loop), plain(restored.loop)
        differing = [name for name in expected if expected[name].tobytes() != there[name].tobytes()]
        places = {leaf.sharding.num_devices for leaf in jax.tree.leaves(restored.loop.replay)}
        found[f"{devices} devices, {parts} along data"] = [differing, sorted(places)]
    checkpoints.close()
    return found


def resumed(loop, folder, program):
    """Save the loop state of several devices, restore it on one, and train for an iteration there.

    Return the number of the iteration, and True if all metrics are finite.
    """
    checkpoints = Checkpoints(Path(folder), echo=lambda line: None)
    checkpoints.save_full(3, loop, {})
    restored = checkpoints.restore_for_resume(jax.eval_shape(program.init, jnp.stack([jax.random.key(0)] * CONFIG.run.seeds)))
    checkpoints.close()
    after, metrics = train_iteration(program, restored.loop)
    return int(after.iteration), all(np.isfinite(values).all() for values in metrics.values())


def main() -> None:
    found = {}
    one, alone, of_one = trained(CONFIG)
    program, loop, of_two = trained(CONFIG.replace(devices=2))
    found["seeds: metrics"], found["seeds: state"] = difference(of_one, of_two), difference(alone, loop)
    playing = loop.train, loop.key, jnp.int32(0), program.exploration
    programs = program.play.lower(*playing), program.learn.lower(loop, program.parts_spec)
    text = "".join(lowered.compile().as_text() for lowered in programs)  # what has just run
    found["seeds: communication"] = [word for word in COLLECTIVES if word in text]

    wide = CONFIG.replace(devices=4, data_devices=2)
    program, loop, of_four = trained(wide)
    _, emulated, of_parts = trained(wide, Emulated(shards=Shards(2)))
    found["data: metrics"], found["data: state"] = difference(of_parts, of_four), difference(emulated, loop)
    loop_of_run, of_run = trained_by_run(wide)
    found["run: metrics"], found["run: state"] = difference(of_four[:-1], of_run), difference(loop, loop_of_run)
    rollouts = [
        {name: metrics[name] for name in ("train/success", "train/goal_distance")} for metrics in (of_one[0], of_four[0])
    ]
    found["data: first rollout"] = difference(*rollouts)
    with tempfile.TemporaryDirectory() as folder:
        found["restored"] = restored_differences(loop, folder)
    with tempfile.TemporaryDirectory() as folder:
        found["resumed on one"] = resumed(loop, folder, one)
    print(json.dumps(found))


if __name__ == "__main__":
    sys.exit(main())
