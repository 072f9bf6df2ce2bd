"""PyTorch implementation of `jaxrl_vis.learner`'s learner, optimised for speed; `comparison` measures it.

    Learner.step    gather -> normalise -> losses -> gradients -> Adam -> target networks, compiled as one function; target
                    networks that are updated less often than every step are updated by a second one, `Learner.update_targets`
    Compiled()      sample the batches of all steps, then run them one by one: on a GPU, replay one CUDA graph per step

Parameters are float32 tensors by name ("encoder/kernel_0", "head/output/bias"); large kernels have a copy in the compute
dtype of the networks, which Adam updates with them. Everything is updated in place, because a CUDA graph has fixed addresses.

The replay stores images in the encoder's layout, see `layout`, which saves the rearrangement that ours does in every step.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch  # pyright: ignore[reportMissingImports]
import torch.nn.functional as F  # noqa: N812 - its usual name  # pyright: ignore[reportMissingImports]

from benchmarks.peers.torch import layout

NETWORKS = ("actor", "critic", "target_actor", "target_critic")

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8  # Adam's, as in optax
_REARRANGED = 64  # episodes rearranged at a time

Tensors = dict[str, Any]  # torch.Tensor by name


@dataclasses.dataclass(frozen=True)
class Rules:
    """Hyper-parameters, from a `Config` and its `Resolved`.

    Attributes:
        encoder: Layout of images and kernels, see `layout`.
        dtype: Compute dtype of the networks.
        levels: Number of convolutions (kernel 2x2, stride 2) of the encoder.
        hidden: Number of hidden layers of a head.
        shared_encoder: The actor reads the critic's latents, without a gradient into them.
        target_encoder: Target networks have their own encoders; otherwise their heads read the latents of the online networks.
        actor_interval: Gradient steps of the critic per step of the actor.
        frame_stack: Number of images in an observation.
        horizon, batch_size, threshold, discount, reward_positive, reward_negative, relabel_probability, balance_probability,
            filter_threshold, target_minimum, target_maximum, action_penalty, target_decay, target_update_interval,
            actor_learning_rate, critic_learning_rate, normalizer_clip: The same as in ours.
    """

    encoder: layout.Encoder
    dtype: Any
    levels: int
    hidden: int
    shared_encoder: bool
    target_encoder: bool
    actor_interval: int
    frame_stack: int
    horizon: int
    batch_size: int
    threshold: float
    discount: float
    reward_positive: float
    reward_negative: float
    relabel_probability: float
    balance_probability: float
    filter_threshold: float
    target_minimum: float
    target_maximum: float
    action_penalty: float
    target_decay: float
    target_update_interval: int
    actor_learning_rate: float
    critic_learning_rate: float
    normalizer_clip: float


class Replay:
    """Episodes on the device, as in `replay.ReplayState`, with images in the encoder's layout.

    Args:
        observations: NumPy array [N, T+2, C, H, W] uint8.
        states: NumPy array [N, T+2, G] float32.
        actions: NumPy array [N, T, A] float32.
        rules: Rules with the layout of images.
        device: PyTorch device.
    """

    def __init__(self, observations: Any, states: Any, actions: Any, rules: Rules, device: str):
        self.episodes, self.slots = observations.shape[:2]
        self.observations = torch.empty(0)
        for first in range(0, self.episodes, _REARRANGED):
            images = torch.tensor(observations[first : first + _REARRANGED], device=device)
            images = layout.to_layout(images, rules.encoder, rules.levels).flatten(0, 1)
            if first == 0:
                rows = self.episodes * self.slots
                self.observations = torch.empty((rows, *images.shape[1:]), dtype=torch.uint8, device=device)
            start = first * self.slots
            self.observations[start : start + len(images)] = images
        self.states = torch.tensor(states, device=device).flatten(0, 1)
        self.actions = torch.tensor(actions, device=device).flatten(0, 1)


class Learner:
    """Networks, optimisers, statistics and replay on one device.

    Args:
        rules: Hyper-parameters.
        networks: Float32 parameters by network (`NETWORKS`) and name, with our names and shapes.
        statistics: (mean, scale) of observations and of goals, [C, H, W] float32 each.
        replay: Replay on the device.
        device: PyTorch device of all tensors.
    """

    def __init__(
        self,
        rules: Rules,
        networks: Mapping[str, Mapping[str, Any]],
        statistics: tuple[tuple[Any, Any], tuple[Any, Any]],
        replay: Replay,
        device: str,
    ):
        self.rules, self.replay, self.device = rules, replay, device
        self.networks: dict[str, Tensors] = {
            network: {name: layout.from_ours(name, leaf.to(device), rules.encoder) for name, leaf in networks[network].items()}
            for network in NETWORKS
        }
        self.copies: dict[str, Tensors] = {
            network: {name: leaf.to(rules.dtype) for name, leaf in parameters.items() if self._is_copied(name, leaf)}
            for network, parameters in self.networks.items()
        }
        self.moments: dict[str, list[Tensors]] = {
            network: [{name: torch.zeros_like(leaf) for name, leaf in self.networks[network].items()} for _ in range(2)]
            for network in ("actor", "critic")
        }
        # Scalars float32: gradient steps of each network, on the device because Adam's corrections depend on them.
        self.counts = {network: torch.zeros((), device=device) for network in ("actor", "critic")}
        self.statistics = [
            tuple(layout.to_layout(plane.to(device), rules.encoder, rules.levels) for plane in pair) for pair in statistics
        ]
        self.losses = torch.zeros(2, device=device)
        self.updates = 0  # on the host: it decides what the next step updates

    def _is_copied(self, name: str, leaf: Any) -> bool:
        """Return True for a parameter with a copy in the compute dtype: the large kernels except those of the last layer."""
        return leaf.ndim >= 2 and leaf.dtype != self.rules.dtype and "output" not in name

    # -- Networks

    def _parameters(self, network: str) -> Tensors:
        return {**self.networks[network], **self.copies[network]}

    def _encode(self, parameters: Tensors, inputs: Any) -> Any:
        """Encode normalised images [M, ...] to latents [M, latent]."""
        dtype, values = self.rules.dtype, inputs
        if self.rules.encoder == "convolutions":
            values = values.permute(0, 3, 1, 2)
        for level in range(self.rules.levels):
            kernel, bias = parameters[f"encoder/kernel_{level}"].to(dtype), parameters[f"encoder/bias_{level}"].to(dtype)
            if self.rules.encoder == "convolutions":
                values = torch.relu(F.conv2d(values, kernel, bias, stride=2))
            else:
                values = torch.relu(torch.addmm(bias, values.reshape(-1, kernel.shape[0]), kernel))
        if self.rules.encoder == "convolutions":
            values = values.permute(0, 2, 3, 1)
        kernel, bias = parameters["encoder/latent/kernel"].to(dtype), parameters["encoder/latent/bias"].to(dtype)
        return torch.addmm(bias, values.reshape(inputs.shape[0], -1), kernel)

    def _encode_pair(self, parameters: Tensors, inputs: Any) -> Any:
        """Encode two observations [2 B, ...] to two latents [B, latent]."""
        return self._encode(parameters, inputs).chunk(2)

    def _head(self, parameters: Tensors, *inputs: Any) -> Any:
        values = torch.cat([part.to(self.rules.dtype) for part in inputs], dim=1)
        for layer in range(self.rules.hidden):
            kernel, bias = (parameters[f"head/hidden_{layer}/{part}"].to(self.rules.dtype) for part in ("kernel", "bias"))
            values = torch.relu(torch.addmm(bias, values, kernel))
        return torch.addmm(parameters["head/output/bias"], values.float(), parameters["head/output/kernel"])

    def _act(self, parameters: Tensors, latents: Any) -> Any:
        return torch.tanh(self._head(parameters, latents[0], latents[1]))

    def _value(self, parameters: Tensors, latents: Any, action: Any) -> Any:
        return self._head(parameters, latents[0], latents[1], action)[:, 0]

    # -- Batches

    def draw(self, steps: int) -> Any:
        """Sample transitions and goals for many steps: episodes, times and goal slots [steps, 3, B] int64; see `relabel`."""
        rules, shape = self.rules, (steps, self.rules.batch_size)
        random = functools.partial(torch.rand, shape, device=self.device)
        episode = torch.randint(0, self.replay.episodes, shape, device=self.device)
        time = torch.randint(0, rules.horizon, shape, device=self.device)
        future = (time + 1 + (random() * (rules.horizon - time)).long()).clamp(max=rules.horizon)
        strategy = random()
        slot = torch.where(strategy < rules.relabel_probability, future, rules.horizon + 1)
        slot = torch.where(strategy < rules.relabel_probability * rules.balance_probability, time + 1, slot)
        return torch.stack([episode, time, slot], dim=1)

    def _batch(self, choice: Any) -> tuple[Any, Any, Any]:
        """Gather normalised images [3 B, ...] (before, goal, after), actions [B, A] and rewards [B]."""
        rules, replay = self.rules, self.replay
        episode, time, slot = choice[0], choice[1], choice[2]
        start = episode * replay.slots
        reached, wanted = start + time + 1, start + slot
        images = replay.observations[torch.cat([start + time, wanted, reached])]
        distance = torch.linalg.vector_norm(replay.states[reached] - replay.states[wanted], dim=1)
        reward = torch.where(distance <= rules.threshold, rules.reward_positive, rules.reward_negative)
        return self._normalized(images), replay.actions[episode * rules.horizon + time], reward

    def _normalized(self, images: Any) -> Any:
        before, goal, after = images.chunk(3)
        (mean, scale), (goal_mean, goal_scale) = self.statistics
        goal = self._as_goal(goal)
        if goal_mean is mean and self.rules.frame_stack == 1:
            parts = [(images, mean, scale)]
        else:
            parts = [(before, mean, scale), (goal, goal_mean, goal_scale), (after, mean, scale)]
        limit = self.rules.normalizer_clip
        return torch.cat([((rows.float() - at) * by).clamp(-limit, limit).to(self.rules.dtype) for rows, at, by in parts])

    def _as_goal(self, images: Any) -> Any:
        """Repeat the newest of stacked images over the stack; channels are adjacent in every layout."""
        if self.rules.frame_stack == 1:
            return images
        pixels = 1 if self.rules.encoder == "convolutions" else 4**self.rules.levels
        images = images.unflatten(-1, (pixels, self.rules.frame_stack, -1))
        return images[..., :1, :].expand_as(images).flatten(-3)

    # -- A gradient step

    def gradients(self, choice: Any, with_actor: bool = True) -> tuple[Any, Any, Tensors, Tensors]:
        """Compute the losses of critic and actor on one batch, and their gradients by name.

        Args:
            choice: Batch [3, B] int64, see `draw`.
            with_actor: Differentiate the actor's loss as well; otherwise it is 0 and without gradients.

        Returns:
            Losses of critic and actor, scalars float32, and gradients of critic and actor, with the shapes and dtypes of the
            parameters, {} for an actor without gradients.
        """
        rules = self.rules
        actor, critic, target_actor, target_critic = map(self._parameters, NETWORKS)
        images, action, reward = self._batch(choice)
        size = rules.batch_size
        before_and_goal, goal_and_after = images[: 2 * size], images[size:]

        def td_target(goal: Any) -> Any:
            """Compute TD targets [B]; ``goal`` are the critic's latents [B, latent], used if targets have no encoder."""
            if rules.target_encoder:
                goal, after = self._encode_pair(target_critic, goal_and_after)
            else:
                after = self._encode(critic, goal_and_after[size:])
            latents = after, goal
            actor_latents = latents
            if not rules.shared_encoder:
                actor_latents = self._encode_pair(target_actor if rules.target_encoder else actor, goal_and_after)[::-1]
            value = self._value(target_critic, latents, self._act(target_actor, actor_latents))
            return (reward + rules.discount * value).clamp(rules.target_minimum, rules.target_maximum)

        def critic_loss(learned: Tensors) -> tuple[Any, Any]:
            latents = self._encode_pair(learned, before_and_goal)
            value, fixed = self._value(learned, latents, action), tuple(latent.detach() for latent in latents)
            keep = 1.0 - ((reward == rules.reward_negative) & (value > rules.filter_threshold)).float()
            return (keep * (value - td_target(fixed[1])).square()).sum() / keep.sum().clamp(min=1.0), fixed

        def actor_loss(actor: Tensors) -> Any:
            actor_latents = latents if rules.shared_encoder else self._encode_pair(actor, before_and_goal)
            chosen = self._act(actor, actor_latents)
            return rules.action_penalty * chosen.square().mean() - self._value(critic, latents, chosen).mean()

        critic_gradients, (critic_error, latents) = torch.func.grad_and_value(critic_loss, has_aux=True)(critic)
        if not with_actor:
            return critic_error, torch.zeros_like(critic_error), critic_gradients, {}
        actor_gradients, policy_loss = torch.func.grad_and_value(actor_loss)(actor)
        return critic_error, policy_loss, critic_gradients, actor_gradients

    def apply(self, critic: Tensors, actor: Tensors, with_targets: bool = True) -> None:
        """Apply Adam to the critic, and to the actor if it has gradients; update the target networks if ``with_targets``."""
        self._adam("critic", critic, self.rules.critic_learning_rate)
        if actor:
            self._adam("actor", actor, self.rules.actor_learning_rate)
        if with_targets:
            self.update_targets()

    def update_targets(self) -> None:
        """Update the target networks: exponential moving average of the online networks."""
        for network in ("critic", "actor"):
            target = self.networks[f"target_{network}"]
            online = [self.networks[network][name] for name in target]
            torch._foreach_lerp_(list(target.values()), online, 1.0 - self.rules.target_decay)
            self._copy(f"target_{network}")

    def _adam(self, network: str, gradients: Tensors, learning_rate: float) -> None:
        parameters = list(self.networks[network].values())
        slopes = [gradients[name].float() for name in self.networks[network]]
        means, squares = (list(moments.values()) for moments in self.moments[network])
        count = self.counts[network].add_(1.0)
        torch._foreach_lerp_(means, slopes, 1.0 - _BETA_1)
        torch._foreach_mul_(squares, _BETA_2)
        torch._foreach_addcmul_(squares, slopes, slopes, 1.0 - _BETA_2)
        sizes = torch._foreach_sqrt(squares)
        torch._foreach_div_(sizes, (1.0 - _BETA_2**count).sqrt())
        torch._foreach_add_(sizes, _EPSILON)
        changes = torch._foreach_div(means, sizes)
        torch._foreach_mul_(changes, -learning_rate / (1.0 - _BETA_1**count))
        torch._foreach_add_(parameters, changes)
        self._copy(network)

    def _copy(self, network: str) -> None:
        copies = self.copies[network]
        if copies:
            torch._foreach_copy_(list(copies.values()), [self.networks[network][name] for name in copies])

    def step(self, choices: Any, cursor: Any, next_updates: tuple[bool, bool]) -> None:
        """Take one gradient step and write its losses to ``losses``.

        Args:
            choices: Batches [steps, 3, B] int64, see `draw`.
            cursor: Index of the step, [1] int64; incremented in place.
            next_updates: Whether this step updates the actor, and whether it updates the target networks.
        """
        critic_error, policy_loss, critic, actor = self.gradients(choices.index_select(0, cursor)[0], next_updates[0])
        self.apply(critic, actor, next_updates[1])
        self.losses.copy_(torch.stack([critic_error, policy_loss]))
        cursor.add_(1)

    def next_updates(self) -> tuple[bool, bool]:
        """Return the flags of the next step for the actor and the target networks, and count the step."""
        self.updates += 1
        return self.updates % self.rules.actor_interval == 0, self.updates % self.rules.target_update_interval == 0


class Compiled:
    """Compiled `Learner.step`; on a GPU autotuned and captured as CUDA graphs. Compiling takes some gradient steps.

    Args:
        learner: Learner to compile.
        steps: Gradient steps of one call.
    """

    def __init__(self, learner: Learner, steps: int):
        self.learner, self.steps = learner, steps
        self._choices = learner.draw(steps)
        self._cursor = torch.zeros(1, dtype=torch.long, device=learner.device)
        on_gpu = learner.device != "cpu"
        # The graphs are captured here and not by PyTorch, which skips steps that change their inputs.
        mode = "max-autotune-no-cudagraphs" if on_gpu else None
        compile_ = functools.partial(torch.compile, fullgraph=True, dynamic=False, mode=mode)
        step, update_targets = compile_(learner.step), compile_(learner.update_targets)
        # Infrequent updates of target networks run after the step, which would otherwise be compiled twice.
        at_every_step = learner.rules.target_update_interval == 1
        interval = math.lcm(learner.rules.actor_interval, learner.rules.target_update_interval)
        self._calls: dict[tuple[bool, bool], Callable[[], None]] = {}
        for with_actor, with_targets in {learner.next_updates() for _ in range(interval)}:

            def call(with_actor: bool = with_actor, with_targets: bool = with_targets) -> None:
                step(self._choices, self._cursor, (with_actor, at_every_step))
                if with_targets and not at_every_step:
                    update_targets()

            call()
            self._calls[with_actor, with_targets] = self._capture_graph(call) if on_gpu else call

    def _capture_graph(self, call: Callable[[], None]) -> Callable[[], None]:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                self._cursor.zero_()
                call()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            call()
        return graph.replay

    def __call__(self) -> Any:
        """Sample batches and dispatch all steps; return the last losses of critic and actor, [2] float32, asynchronously."""
        self._choices.copy_(self.learner.draw(self.steps))
        self._cursor.zero_()
        for _ in range(self.steps):
            self._calls[self.learner.next_updates()]()
        return self.learner.losses
