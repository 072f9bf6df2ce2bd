"""Training of other libraries' agents through the adapters, with a record of their success before and after.

    python -m benchmarks.peers.agents sb3 [--env FetchReach] [--steps 20000]     Stable-Baselines3: DDPG with HER, sparse reward
    python -m benchmarks.peers.agents brax [--env FetchReach] [--steps 180000]   brax: PPO, dense reward

The first needs ``pip install '.[gymnasium]' stable-baselines3``. Success is the fraction of 256 episodes within the threshold
at their last step, without exploration. Exit status: 0 if success rose; 1 if not.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

# brax compiles without the options of `compilation.jit`. JAX reads this variable at its first import: a script may set it,
# a library may not. JAX 0.11 does not support the option, and would end the process.
if version("jaxlib").startswith("0.10.") and "fusion_emitters" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

import numpy as np

from jaxrl_vis.bench.record import Measurement, compare_and_keep

EVALUATION_EPISODES = 256
EVALUATION_SEED = 10_000


def evaluate(env: str, act: Callable[[dict[str, np.ndarray]], np.ndarray]) -> dict[str, float]:
    """Evaluate a policy, a function from dictionaries of observations and goals [N, ...] to actions [N, A].

    Returns:
        Mean ``success`` and ``goal_distance`` (in the task's unit) at the last step.
    """
    from jaxrl_vis_envs.adapters.gymnasium import GymnasiumVectorEnv

    envs = GymnasiumVectorEnv(env, EVALUATION_EPISODES)
    observations, _ = envs.reset(seed=EVALUATION_SEED)
    truncated = np.zeros(EVALUATION_EPISODES, bool)
    infos: dict[str, Any] = {}
    while not truncated.all():
        observations, _, _, truncated, infos = envs.step(act(observations))
    return {"success": float(infos["is_success"].mean()), "goal_distance": float(infos["goal_distance"].mean())}


def train_sb3(env: str, steps: int, seed: int) -> Measurement:
    """Train DDPG with hindsight goals and the sparse reward, on one environment; see `training_result`."""
    import gymnasium
    import stable_baselines3
    import torch
    from stable_baselines3.common.noise import NormalActionNoise

    from jaxrl_vis_envs.adapters.gymnasium import GymnasiumEnv

    torch.set_num_threads(1)
    gym_env = GymnasiumEnv(env)
    size = gym_env.goal_env.action_size
    settings: dict[str, Any] = {"gamma": 0.95, "learning_rate": 1e-3, "batch_size": 256, "learning_starts": 1000}
    model = stable_baselines3.DDPG(
        "MultiInputPolicy",
        gym_env,
        replay_buffer_class=stable_baselines3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        buffer_size=steps,
        action_noise=NormalActionNoise(np.zeros(size), 0.2 * np.ones(size)),
        policy_kwargs={"net_arch": [256, 256]},
        seed=seed,
        **settings,
    )

    def act(observations: dict[str, np.ndarray]) -> np.ndarray:
        return model.predict(observations, deterministic=True)[0]

    before, started = evaluate(env, act), time.perf_counter()
    print(before, flush=True)
    model.learn(steps, log_interval=40)
    seconds = time.perf_counter() - started
    versions = {module.__name__: module.__version__ for module in (gymnasium, stable_baselines3, torch)}
    config = {"agent": "stable_baselines3 DDPG + HER", "env": env, "steps": steps, "seed": seed, **settings}
    return training_result(config, before, evaluate(env, act), seconds, versions)


def train_brax(env: str, steps: int, seed: int) -> Measurement:
    """Train PPO on the concatenated observation and goal, with minus the distance as reward; see `training_result`."""
    import functools

    import brax
    import jax
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    from jaxrl_vis_envs.adapters.brax import BraxEnv, share_jax_with_brax

    brax_env = BraxEnv(env, reward="dense")
    reset, step = jax.vmap(brax_env.reset), jax.vmap(brax_env.step)
    keys = jax.random.split(jax.random.PRNGKey(EVALUATION_SEED), EVALUATION_EPISODES)

    @functools.cache
    def evaluation(make_policy: Any) -> Any:
        def play(params: Any) -> dict[str, jax.Array]:
            policy = make_policy(params, deterministic=True)
            play_step = lambda state, _: (step(state, policy(state.obs, jax.random.PRNGKey(0))[0]), None)  # noqa: E731
            return jax.lax.scan(play_step, reset(keys), length=brax_env.episode_length)[0].metrics

        return jax.jit(play)

    curve: list[tuple[int, dict[str, float]]] = []

    def watch(env_steps: int, make_policy: Any, params: Any) -> None:
        curve.append((env_steps, {name: float(values.mean()) for name, values in evaluation(make_policy)(params).items()}))
        print(curve[-1], flush=True)

    settings: dict[str, Any] = {
        "num_envs": 128,
        "unroll_length": 10,
        "batch_size": 128,
        "num_minibatches": 8,
        "num_updates_per_batch": 8,
        "num_resets_per_eval": 3,
        "learning_rate": 5e-4,
        "max_grad_norm": 0.5,  # without it, success fell from 1.0 to .23 after 250,000 steps
        "discounting": 0.95,
        "reward_scaling": 10.0,
        "entropy_cost": 1e-3,
    }
    network_factory = functools.partial(
        networks.make_ppo_networks, policy_hidden_layer_sizes=(128, 128), value_hidden_layer_sizes=(128, 128)
    )
    started = time.perf_counter()
    with share_jax_with_brax():
        ppo.train(
            brax_env,
            num_timesteps=steps,
            episode_length=brax_env.episode_length,
            normalize_observations=True,
            network_factory=network_factory,
            num_evals=7,
            run_evals=False,
            policy_params_fn=watch,
            seed=seed,
            **settings,
        )
    seconds = time.perf_counter() - started
    config = {"agent": "brax PPO", "env": env, "reward": "dense", "steps": curve[-1][0], "seed": seed, **settings}
    versions = {"brax": brax.__version__, "curve": [[at, round(figures["success"], 3)] for at, figures in curve]}
    return training_result(config, curve[0][1], curve[-1][1], seconds, versions)


def training_result(
    config: dict[str, Any], before: dict[str, float], after: dict[str, float], seconds: float, details: dict[str, Any]
) -> Measurement:
    """Make the measurement of a training run from the results of `evaluate`."""
    figures = {f"{name}_before": round(value, 4) for name, value in before.items()}
    figures |= {f"{name}_after": round(value, 4) for name, value in after.items()}
    return Measurement(
        "adapters/success", after["success"], "share", config, {**figures, "train_s": round(seconds, 1), **details}
    )


TRAINERS = {"brax": (train_brax, "FetchReach", 180_000), "sb3": (train_sb3, "FetchReach", 20_000)}


def main(arguments: list[str] | None = None) -> int:
    """Train an agent, print and store the record; return 1 if success did not rise, else 0."""
    parser = argparse.ArgumentParser(description="Trains other libraries' agents through the adapters.")
    parser.add_argument("agent", choices=sorted(TRAINERS))
    parser.add_argument("--env", help="a state environment; default: one that the agent is known to learn")
    parser.add_argument("--steps", type=int, help="environment steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, help="folder of stored records; default: in the user's cache")
    options = parser.parse_args(arguments)
    train, env, steps = TRAINERS[options.agent]
    measurement = train(options.env or env, options.steps or steps, options.seed)
    compare_and_keep("adapters", measurement, options.results)
    return 0 if measurement.details["success_after"] > measurement.details["success_before"] else 1


if __name__ == "__main__":
    sys.exit(main())
