"""The learner in environments with known answers, and the mechanisms of the thesis on batches with known shares."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest
from learners import begin, iteration_of_one, train_iteration, update_arguments

from jaxrl_vis.config import preset
from jaxrl_vis.learner.acting import rollout
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.compiled.programs import Programs

DISCOUNT = 0.75  # 1 - 1/horizon of the probes
# Probes that are learned with the same settings.
ALIKE = (probes.ThreeStepsAway(), probes.TwoPlaces(), probes.TwoGoals())
KEYS = jax.random.key(0)[None]


def trained(env, iterations=12, **overrides):
    settings = {
        "num_envs": 16,
        "updates_per_iteration": 50,
        "batch_size": 64,
        "hidden_sizes": (64, 64),
        "replay_transitions": 4000,
        "target_decay": 0.95,
        "action_penalty": 0.0,
        "normalizer_floor": 0.1,
        "eval_episodes": 64,
        "relabel_probability": 0.0,
    }
    program = make_train_step(env, preset("debug", **{**settings, **overrides}))
    iterate = functools.partial(train_iteration, program)
    if env in ALIKE and not overrides:
        iterate = functools.partial(iteration_of_one(ALIKE, program.config), ALIKE.index(env))
    loop = begin(program, jax.random.key(7)[None])
    for _ in range(iterations):
        loop, metrics = iterate(loop)
    # On the host: on a device each size of leaf would be a program to compile.
    return program, jax.tree.map(lambda leaf: leaf[0], jax.device_get(loop.train)), metrics


def values(program, train, observations, goals, action=0.0):
    """Return the critic's values of [B] points and goals."""
    networks = program.networks

    @jax.jit
    def value(train, points, goals):
        latents = jnp.stack([networks.prepare(networks.scaling(train.normalizer), each) for each in (points, goals)])
        return networks.value(train.agent.critic, latents, jnp.full((points.shape[0], 1), action))

    return np.asarray(value(train, *(np.array(each, np.float32)[:, None] for each in (observations, goals))))


def test_value_of_a_place_that_is_always_the_goal():
    program, train, _ = trained(probes.AlwaysThere(), reward_positive=1.0, reward_negative=0.0, iterations=25)
    np.testing.assert_allclose(values(program, train, [0.0], [0.0]), [1.0 / (1.0 - DISCOUNT)], atol=0.1)


def test_values_are_discounted():
    program, train, _ = trained(ALIKE[0])
    expected = [-1.0 - DISCOUNT, -1.0, 0.0]
    np.testing.assert_allclose(values(program, train, [-3.0, -2.0, -1.0], [0.0] * 3), expected, atol=0.15)


def test_value_depends_on_the_observation():
    program, train, _ = trained(ALIKE[1], iterations=25)
    np.testing.assert_allclose(values(program, train, [0.0, 1.0], [0.0, 0.0]), [0.0, -1.0 / (1.0 - DISCOUNT)], atol=0.3)


def test_value_depends_on_the_goal():
    program, train, _ = trained(ALIKE[2], iterations=25)
    np.testing.assert_allclose(values(program, train, [0.0, 0.0], [0.0, 1.0]), [0.0, -1.0 / (1.0 - DISCOUNT)], atol=0.3)


def test_policy_goes_where_the_goal_is():
    program, train, _ = trained(probes.GoWhereTold(), relabel_probability=0.9, iterations=25)
    outcome, _ = program.evaluate(jax.tree.map(lambda leaf: leaf[None], train), jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.95


def test_policy_depends_on_the_observation():
    program, train, _ = trained(probes.GoAgainstTheSign())
    outcome, _ = program.evaluate(jax.tree.map(lambda leaf: leaf[None], train), jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.95


def test_seeds_side_by_side_learn_what_they_learn_alone():
    """Three seeds in one program give each seed's own run (to rounding: batched products sum in another order)."""
    config = preset("debug", num_envs=4, updates_per_iteration=3, batch_size=8)
    program = make_train_step(probes.GoWhereTold(), config)
    keys = jax.random.split(jax.random.key(1), 3)
    together = program.init(keys)
    for _ in range(2):
        together, _ = train_iteration(program, together)
    for seed in range(3):
        alone = program.init(keys[seed][None])
        for _ in range(2):
            alone, _ = train_iteration(program, alone)
        for left, right in zip(jax.tree.leaves(alone.train), jax.tree.leaves(together.train), strict=True):
            np.testing.assert_allclose(left[0], right[seed], rtol=1e-4, atol=1e-5)


def test_one_trace_and_a_new_episode_every_time():
    traces = 0

    class Counting(probes.GoWhereTold):
        def advance(self, state, action):
            nonlocal traces
            traces += 1
            return super().advance(state, action)

    program = make_train_step(Counting(), preset("debug"))
    loop = begin(program, KEYS)
    goals = []
    for _ in range(3):
        loop, _ = train_iteration(program, loop)
        written = (int(loop.iteration) - 1) % program.replay.num_rollouts * program.config.run.num_envs
        goals.append(np.asarray(loop.replay.episodes.states)[0, written, -1, 0])
    assert traces == 1
    assert len(set(goals)) == 3


@functools.cache
def filtering(positive=None, negative=None):
    settings = {"num_envs": 32, "updates_per_iteration": 1, "batch_size": 256}
    settings |= {"method": "indicator_balance_filter", "reward_positive": positive, "reward_negative": negative}
    return make_train_step(probes.PointImage(), preset("debug", **settings))


@pytest.mark.parametrize("rewards", [(), (0.0, -1.0)])
def test_a_fresh_filter_drops_nothing(rewards):
    """No negative is dropped at initialisation, under +1/-1 and under 0/-1 (there the critic must start below the band)."""
    program = filtering(*rewards)
    _, metrics = train_iteration(program, begin(program, KEYS))
    assert metrics["train/filtered_share"][0] == 0.0
    assert metrics["train/positive_share"][0] > 0.3


def test_the_filter_drops_negatives_that_the_critic_values_like_positives():
    """Place 0 is its own goal, seen with noise in one byte, so most of its indicator rewards are false negatives."""
    program = filtering()
    loop = begin(program, KEYS)
    agent = loop.train.agent
    head = agent.critic["head"]
    last = sorted(head)[-1]
    confident = {**head, last: {**head[last], "bias": head[last]["bias"] + 1e3}}
    agent = agent.replace(critic={**agent.critic, "head": confident})
    loop = loop.replace(train=loop.train.replace(agent=agent))
    _, metrics = train_iteration(program, loop)
    assert metrics["train/filtered_share"][0] == 1.0


@pytest.mark.parametrize(
    ("method", "expected"),
    # T = 4. Future relabelling hits slot t+1 with probability mean(1/(T-t)) = H_T/T = 0.5208; every other slot differs.
    [("indicator", 0.9 * 25 / 48), ("indicator_balance_filter", 0.45 + 0.45 * 25 / 48)],
)
def test_share_of_positives_is_the_one_derived(method, expected):
    program = make_train_step(
        probes.PointImage(), preset("debug", method=method, num_envs=256, updates_per_iteration=40, batch_size=512)
    )
    _, metrics = train_iteration(program, begin(program, jax.random.key(3)[None]))
    assert abs(float(metrics["train/positive_share"][0]) - expected) < 0.012


def test_replay_is_written_in_place():
    """The compiled iteration aliases the replay, and its temporary buffers are far smaller than a second copy."""
    config = preset("debug", replay_transitions=200_000, seeds=2)
    programs = Programs(config, make_train_step(probes.PointImage(), config))
    memory = programs.compiled("learn").memory_analysis()
    replay = 2 * programs.program.replay_bytes
    assert replay > 10e6
    assert memory.alias_size_in_bytes >= replay
    assert memory.temp_size_in_bytes < 0.2 * replay


@pytest.mark.parametrize(("interval", "updates"), [(1, 1), (3, 2), (3, 3)])
def test_targets_follow_once_an_interval(interval, updates):
    """Targets move only after an interval of updates has passed, and then towards the online networks of that step."""
    config = preset("debug", num_envs=4, batch_size=8, target_update_interval=interval, target_decay=0.9)
    program = make_train_step(probes.GoWhereTold(), config.replace(updates_per_iteration=updates))
    first = jax.device_get(begin(program, KEYS).train.agent)
    train = jax.device_get(program.update_many(*update_arguments(program, KEYS[0]))[0]).agent
    moved = jax.tree.map(lambda new, old: bool(np.any(new != old)), train.target_critic, first.target_critic)
    assert any(jax.tree.leaves(moved)) == (updates >= interval)
    if interval == 1:  # and by how much: a tenth of the way to where the online network is
        for target, online, old in zip(*map(jax.tree.leaves, (train.target_actor, train.actor, first.actor))):
            np.testing.assert_allclose(target, 0.9 * old + 0.1 * online, atol=1e-6)


def test_exploration_has_its_shares_and_spread():
    """Uniform actions have the requested share; the others deviate from the policy by the requested standard deviation."""
    program = make_train_step(probes.GoWhereTold(), preset("debug"))
    train = jax.tree.map(lambda leaf: np.asarray(leaf)[0], begin(program, KEYS).train)
    observations, count = jnp.zeros((20_000, 1)), 20_000

    def actions(exploration):
        @jax.jit
        def act(key, train):
            algorithm = program.algorithm
            policy = algorithm.policy_params(train.agent, train.statistics)
            action = algorithm.act(policy, observations, algorithm.encode_goal(policy, observations))
            return rollout.explore(action, exploration, key)

        return np.asarray(act(jax.random.key(5), train))[:, 0]

    policy = actions(rollout.NO_EXPLORATION)
    assert np.ptp(policy) == 0.0 and abs(policy[0]) < 0.5
    noise = actions(rollout.Exploration(0.0, 0.1)) - policy
    assert abs(noise.std() - 0.1) < 0.003 and abs(noise.mean()) < 0.003
    random = actions(rollout.Exploration(1.0, 0.1))
    assert abs(random.mean()) < 0.02 and abs(random.std() - 1 / np.sqrt(3)) < 0.01 and np.abs(random).max() <= 1.0
    share = np.mean(actions(rollout.Exploration(0.3, 0.0)) != policy)
    assert abs(share - 0.3) < 4 * np.sqrt(0.21 / count)
    assert np.abs(actions(rollout.Exploration(0.0, 5.0))).max() == 1.0  # clipped


def test_success_counts_at_the_last_step():
    """A robot that passes through its goal and goes on has failed; one that arrives at the very end has not."""

    class Passing(probes.GoWhereTold):
        """Probe that moves by one per step, whatever the action; the goal is its position after ``reached`` steps."""

        def __init__(self, reached):
            self.reached = reached

        def start(self, key):
            return jnp.zeros(1), jnp.full(1, float(self.reached))

        def advance(self, state, action):
            position = state.data + 1.0
            return self._measure(position, position, state.goal_state, state.obs)

    for reached, success in ((2, 0.0), (probes.Probe.horizon, 1.0)):
        program = make_train_step(Passing(reached), preset("debug", eval_episodes=4))
        outcome, recording = program.evaluate(begin(program, KEYS).train, jax.random.key(1))
        assert outcome["eval/success"][0] == success
        assert outcome["eval/goal_distance"][0] == probes.Probe.horizon - reached
        np.testing.assert_array_equal(recording["success"], success)


@pytest.mark.parametrize("source", ["rollouts", "relabelled"])
def test_goals_can_have_statistics_of_their_own(source):
    """Goals of this probe never equal what is observed: shared statistics mix the two, separate ones do not."""
    settings = {"normalizer_source": source, "num_envs": 64, "relabel_probability": 0.0, "updates_per_iteration": 1}
    env = probes.ThreeStepsAway()  # from -3 to 0, and the goal is 0

    def statistics(normalizers):
        program = make_train_step(env, preset("debug", normalizers=normalizers, **settings))
        loop, metrics = train_iteration(program, begin(program, KEYS))
        assert metrics["guard/nonfinite"][0] == 0
        outcome, _ = program.evaluate(loop.train, jax.random.key(1))
        assert np.isfinite(outcome["eval/goal_distance"]).all()
        return loop.train.normalizer, loop.train.goal_normalizer

    shared, none = statistics("shared")
    observed, goals = statistics("separate")
    assert none is None and float(goals.mean[0, 0]) == 0.0 and float(goals.sum_of_squares[0, 0]) == 0.0
    per_episode = {"rollouts": 5, "relabelled": 4}[source]  # T+1 observations, or T transitions
    assert float(observed.count[0]) == 64 * per_episode
    assert float(observed.mean[0, 0]) < float(shared.mean[0, 0]) < 0.0


CHEAPER = {
    "shared": {"encoders": "shared"},
    "no target encoder": {"target_encoder": False},
    "all": {"encoders": "shared", "target_encoder": False, "actor_interval": 2, "random_shift": 1},
}


@pytest.mark.parametrize("options", CHEAPER.values(), ids=CHEAPER)
def test_saved_encoders_are_not_there(options):
    """With shared encoders, the actor has none of its own; without target encoders, the target critic has none."""
    program = make_train_step(probes.SeenGoWhereTold(), preset("debug", **options))
    agent = jax.eval_shape(program.init, jax.random.key(7)[None]).train.agent
    assert ("encoder" in agent.actor) == (options.get("encoders") != "shared")
    assert ("encoder" in agent.target_critic) == options.get("target_encoder", True)


def test_policy_learns_from_images_with_fewer_encoders():
    """The policy reaches the goals of goal images; an actor that steps half as often needs longer."""
    settings = {"encoder_filters": (8, 8), "relabel_probability": 0.9, "normalizer_floor": 1.0}
    program, train, _ = trained(probes.SeenGoWhereTold(), iterations=30, batch_size=32, **settings, **CHEAPER["all"])
    outcome, _ = program.evaluate(jax.tree.map(lambda leaf: leaf[None], train), jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.9


def test_a_shared_encoder_learns_nothing_from_the_actor():
    """The critic and its encoder take the same first steps for any step size of the actor."""

    def critic_after(learning_rate):
        config = preset("debug", encoders="shared", actor_learning_rate=learning_rate, batch_size=8, updates_per_iteration=1)
        program = make_train_step(probes.SeenGoWhereTold(), config)
        return jax.device_get(program.update_many(*update_arguments(program, KEYS[0]))[0]).agent

    slow, fast = critic_after(1e-5), critic_after(1e-1)
    jax.tree.map(np.testing.assert_array_equal, slow.critic, fast.critic)
    assert any(jax.tree.leaves(jax.tree.map(lambda one, other: bool(np.any(one != other)), slow.actor, fast.actor)))


def test_the_actor_steps_once_an_interval():
    config = preset("debug", num_envs=4, batch_size=8, updates_per_iteration=6)
    counts = {}
    for interval in (1, 3):
        program = make_train_step(probes.GoWhereTold(), config.replace(actor_interval=interval))
        train, metrics = program.update_many(*update_arguments(program, KEYS[0]))
        counts[interval] = tuple(
            int(moments[0].count[0]) for moments in (train.agent.actor_optimizer, train.agent.critic_optimizer)
        )
        assert np.isfinite(metrics["train/actor_loss"]).all()
    assert counts == {1: (6, 6), 3: (2, 6)}


def test_a_target_sums_the_rewards_of_several_steps():
    """With targets that never learn, the critic learns the value three steps away from the sum of the episode's rewards."""
    program, train, _ = trained(probes.ThreeStepsAway(), n_step=4, target_decay=1.0, iterations=25)
    # Targets never learn: what they add is the fresh critic's value, which is near 0, after the episode's end.
    expected = [-1.0 - DISCOUNT, -1.0, 0.0]
    np.testing.assert_allclose(values(program, train, [-3.0, -2.0, -1.0], [0.0] * 3), expected, atol=0.3)


@pytest.mark.parametrize("method", ["oracle", "indicator"])
def test_reached_goals_are_replaced(method):
    """Relabelled goals that are already reached are replaced by observations from other episodes.

    Each point stays at its own random position, so all goals from its own episode are already reached.
    """

    class Elsewhere(probes.AlwaysThere):
        def start(self, key):
            place = 1000.0 * jax.random.uniform(key, (1,))
            return place, -1.0 - place

    shares = {}
    for kept in (1.0, 0.25, 0.0):
        config = preset("debug", num_envs=16, batch_size=512, relabel_probability=1.0, trivial_goals=kept, method=method)
        program = make_train_step(Elsewhere(), config)
        _, metrics = program.update_many(*update_arguments(program, KEYS[0]))
        shares[kept] = float(metrics["train/positive_share"][0])
    same = 1 / 16  # the other episode may be the same one
    assert shares[1.0] == 1.0 and shares[0.0] == pytest.approx(same, abs=0.05)
    assert shares[0.25] == pytest.approx(0.25 + 0.75 * same, abs=0.06)
