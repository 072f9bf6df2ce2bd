"""Gradients of losses that read the shared parameters only through latents (mode latents of `gradients`).

    encode          latents of every group, with their pullbacks
    differentiate   gradient of each loss with respect to the parameters and latents that it reads

The inputs of a loss are found by tracing it, so that nothing is computed for others: a gradient passes only through those
groups of latents where it can be nonzero, and a head's gradient is not added to zeros from all other losses.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from jaxrl_vis.types import Params
from jaxrl_vis.weighting.base import MAIN, dot, loss_order, split_result, to_float32, weighted_sum

_ALL = "all"  # group of latents without names

AtLatents = Mapping[str, Mapping[str, Any]]
"""Gradients with respect to latents, by loss and by group of latents that it reads."""


def cast_like(tree: Params, template: Params) -> Params:
    """Cast the leaves of a tree to the dtypes of another."""
    return jax.tree.map(lambda leaf, template_leaf: leaf.astype(template_leaf.dtype), tree, template)


@dataclasses.dataclass(frozen=True)
class Encoding:
    """Latents, and their linearisations with respect to the shared parameters.

    Attributes:
        latents: Latents by group.
        pullbacks: By group, function from a gradient in its latents to the gradient in the shared parameters.
        functions: By group, function from the shared parameters to its latents.
        encoder_params: Shared parameters.
        has_names: Whether losses take a dictionary of groups rather than a single one.
    """

    latents: dict[str, Any]
    pullbacks: dict[str, Callable[[Any], tuple[Params]]]
    functions: Mapping[str, Callable[[Params], Any]]
    encoder_params: Params
    has_names: bool

    @property
    def argument(self) -> Any:
        """Latents in the form that losses take."""
        return self.latents if self.has_names else self.latents[_ALL]

    def backward(self, at_latents: AtLatents, coefficients: Mapping[str, jax.Array]) -> Params:
        """Compute the gradient of a weighted sum of losses with respect to the shared parameters, float32 or wider.

        Args:
            at_latents: Gradients of the losses with respect to the latents.
            coefficients: [] float32 by name; losses without one are left out.
        """
        total = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, jnp.promote_types(leaf.dtype, jnp.float32)), self.encoder_params
        )
        for group, pullback in self.pullbacks.items():
            readers = {name: at[group] for name, at in at_latents.items() if name in coefficients and group in at}
            if readers:
                (term,) = pullback(cast_like(weighted_sum(readers, coefficients), self.latents[group]))
                total = jax.tree.map(lambda before, more: before + more.astype(before.dtype), total, term)
        return total

    def dots(self, direction: Params, at_latents: AtLatents) -> dict[str, jax.Array]:
        """Compute the inner products of the losses' gradients with a direction in the shared parameters, [] float32 by name.

        Args:
            direction: Tree like the shared parameters.
            at_latents: Gradients of the losses with respect to the latents.
        """
        along, read = cast_like(direction, self.encoder_params), {group for at in at_latents.values() for group in at}
        tangents = {
            group: jax.jvp(encode, (self.encoder_params,), (along,))[1]
            for group, encode in self.functions.items()
            if group in read
        }
        return {
            name: sum((dot(tangents[group], gradient) for group, gradient in at.items()), jnp.zeros(()))
            for name, at in at_latents.items()
        }

    def gramian(self, at_latents: AtLatents, reduce: Callable[[Any], Any]) -> jax.Array:
        """Compute the inner products of all pairs of losses' gradients in the shared parameters.

        With a_i the gradient of loss i at the latents and J their Jacobian, G_ij = <a_i, J J^T a_j>: for each loss one backward
        pass, J^T a_j, and one forward-mode pass. Only one such gradient is kept in memory at a time.

        Args:
            at_latents: Gradients of all losses with respect to the latents.
            reduce: Function applied to each J^T a_j, as in `gradients.weighted_grad`; the result itself is not reduced.

        Returns:
            [K, K] float32 or wider, in the sorted order of the names.
        """
        names, rows = loss_order(at_latents), []
        for name in names:
            dots = self.dots(reduce(self.backward(at_latents, {name: jnp.ones(())})), at_latents)
            rows.append(jnp.stack([dots[other] for other in names]))
            # Make the next loss's passes depend on this one's; the compiler may otherwise run all of them at once.
            at_latents, rows[-1] = jax.lax.optimization_barrier((at_latents, rows[-1]))
        matrix = jnp.stack(rows)
        return 0.5 * (matrix + matrix.T)


def encode(functions: Callable[..., Any] | Mapping[str, Callable[..., Any]], encoder_params: Params, *args: Any) -> Encoding:
    """Compute latents and their pullbacks to the shared parameters.

    Args:
        functions: ``encode`` of `gradients.weighted_grad`.
        encoder_params: Shared parameters.
        *args: Further arguments of ``functions``.
    """
    has_names = isinstance(functions, Mapping)
    named = functions if isinstance(functions, Mapping) else {_ALL: functions}
    of_picked = {
        group: (lambda encoder_params, encode=encode: encode(encoder_params, *args)) for group, encode in named.items()
    }
    passes = {group: jax.vjp(function, encoder_params) for group, function in of_picked.items()}
    latents = {group: values for group, (values, _) in passes.items()}
    return Encoding(latents, {group: back for group, (_, back) in passes.items()}, of_picked, encoder_params, has_names)


@dataclasses.dataclass(frozen=True)
class LossDerivatives:
    """Losses, and the gradient of each with respect to its inputs.

    Attributes:
        losses: [] float32 by name.
        of_params: Gradients by loss and by index of the parameters' leaf, each shaped like that leaf.
        at_latents: See `AtLatents`.
        extra: Auxiliary output of the loss function; None if it has none.
    """

    losses: dict[str, jax.Array]
    of_params: dict[str, dict[int, jax.Array]]
    at_latents: AtLatents
    extra: Any

    def combine_heads(self, params: Params, coefficients: Mapping[str, jax.Array]) -> Params:
        """Sum the weighted gradients with respect to the parameters, except for the paths through latents: float32."""
        leaves, structure = jax.tree.flatten(params)

        def total(index: int, leaf: jax.Array) -> jax.Array:
            zeros = jnp.zeros(leaf.shape, jnp.promote_types(leaf.dtype, jnp.float32))
            gradients = {name: of[index] for name, of in self.of_params.items() if index in of}
            return sum((coefficients[name] * gradient.astype(zeros.dtype) for name, gradient in gradients.items()), zeros)

        return jax.tree.unflatten(structure, [total(index, leaf) for index, leaf in enumerate(leaves)])


def differentiate(
    losses_fn: Callable[..., Any], has_aux: bool, encoding: Encoding, traced: tuple[Any, Any], params: Params, *args: Any
) -> LossDerivatives:
    """Compute each loss, and its gradients with respect to the parameters and latents that it reads.

    Args:
        losses_fn: (params, latents, *args) -> [] floats by name; with ``has_aux``, followed by any auxiliary output.
        has_aux: See ``losses_fn``.
        encoding: Result of `encode`.
        traced: Result of `jax.make_jaxpr` for ``losses_fn``, with the shapes that it returns.
        params: All parameters.
        args: Further arguments of ``losses_fn``.
    """
    leaves, structure = jax.tree.flatten(params)
    program, results = traced
    losses, of_params, at_latents, extra = {}, {}, {}, None
    reads = _find_reads(program, split_result(results, has_aux)[0], len(leaves), encoding)
    for name, (indices, groups) in reads.items():

        def compute_loss(chosen: dict[int, jax.Array], latents: dict[str, Any], name: str = name) -> tuple[jax.Array, Any]:
            current = [chosen.get(index, leaf) for index, leaf in enumerate(leaves)]
            inputs = encoding.latents | latents
            read = inputs if encoding.has_names else inputs[_ALL]
            by_name, extra = split_result(losses_fn(jax.tree.unflatten(structure, current), read, *args), has_aux)
            return to_float32(jnp.asarray(by_name[name])), extra

        # Differentiate each loss separately, so that the compiler can remove the computation of all others as dead code.
        chosen, read = {index: leaves[index] for index in indices}, {group: encoding.latents[group] for group in groups}
        losses[name], pullback, aux = jax.vjp(compute_loss, chosen, read, has_aux=True)
        of_params[name], at_latents[name] = pullback(jnp.ones_like(losses[name]))
        extra = aux if name == MAIN or MAIN not in reads else extra
    return LossDerivatives(losses, of_params, at_latents, extra)


def _find_reads(program: Any, losses: Mapping[str, Any], num_leaves: int, encoding: Encoding) -> dict[str, Any]:
    """Find where each loss can have a nonzero gradient: indices of the parameters' leaves, and groups of latents.

    Within a nested program, every result is assumed to depend on every argument, so the result may include too many places,
    but never too few.
    """
    variables = program.jaxpr.invars
    of_leaf, rest = variables[:num_leaves], iter(variables[num_leaves:])
    # Leaves of a dictionary come in the order of its sorted keys.
    of_group = {group: [next(rest) for _ in jax.tree.leaves(encoding.latents[group])] for group in sorted(encoding.latents)}
    reads = {}
    for name, result in zip(sorted(losses), program.jaxpr.outvars):  # followed by the auxiliary outputs
        needed = set() if isinstance(result, Literal) else {result}
        for equation in reversed(program.jaxpr.eqns):
            if equation.primitive.name != "stop_gradient" and needed.intersection(equation.outvars):
                needed.update(variable for variable in equation.invars if not isinstance(variable, Literal))
        indices = [index for index, variable in enumerate(of_leaf) if variable in needed]
        reads[name] = indices, [group for group, members in of_group.items() if needed.intersection(members)]
    return reads
