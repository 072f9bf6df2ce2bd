"""Reads and writes of one number a thread, for Pallas kernels (Triton) that are programs of thousands of operations.

Before Triton decides how the threads of a block share a read or a write, it searches the whole program for others like it, once
for each of them: a kernel that reads 500 numbers takes minutes to compile. Here each thread reads and writes its own numbers
by an instruction of its own (PTX), of which Triton knows nothing. One primitive is missing from Pallas for that, the address of
an array, and is added here.
"""

import functools
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import mlir

from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

LANES = 32
"""Threads of a program: those of a warp."""
_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)

Compute = Callable[[Any, list[jax.Array]], Iterable[Any]]


def as_kernel(name: str, compute: Compute, known: Hashable, outputs: int, interpret: bool) -> Callable[[jax.Array], jax.Array]:
    """A function of episodes as one GPU kernel, in which a thread has an episode and a program 32 of them.

    Calls in one program of one function, with the same ``known`` and for as many episodes, are one kernel: it is compiled once.

    Args:
        name: Of the kernel.
        compute: Makes an episode's outputs of what is known and of the episode's inputs; numbers are [32] float32, one for each
            thread. It is traced once for all numbers of episodes.
        known: What is known before the program runs.
        outputs: How many it makes.
        interpret: Run the kernel without a GPU, slowly.

    Returns:
        Inputs [B, I] float32 -> outputs [B, ``outputs``]. Another axis of `jax.vmap` makes B larger.
    """

    @custom_vmap
    def run(inputs: jax.Array) -> jax.Array:
        batch = inputs.shape[0]
        programs = pl.cdiv(batch, LANES)
        # Threads beyond the last episode compute that again: zeros might be nothing to compute with.
        inputs = jnp.pad(inputs, ((0, programs * LANES - batch), (0, 0)), mode="edge")
        launch = _traced(name, compute, known, outputs, interpret, inputs.T.shape, jax.sharding.get_abstract_mesh())
        results, _ = launch(inputs.T)
        return results.T[:batch]

    @run.def_vmap
    def _(size: int, in_batched: list[bool], inputs: jax.Array) -> tuple[jax.Array, bool]:
        del in_batched  # there is one input, so it is batched
        flat = run(inputs.reshape(-1, inputs.shape[-1]))
        return flat.reshape(size, -1, flat.shape[-1]), True

    return run


@functools.lru_cache(maxsize=16)
def _traced(
    name: str, compute: Compute, known: Hashable, outputs: int, interpret: bool, shape: tuple[int, int], mesh: Any
) -> Callable[[jax.Array], list[jax.Array]]:
    """The kernel for inputs of a ``shape`` [I, 32 * programs], traced; one that was traced within a ``mesh`` stays there.

    XLA takes two kernels for one if they are equal to the last letter. Of one that was traced in another place, the debug
    information is not.
    """
    del mesh
    programs = shape[1] // LANES
    launch = kernel_call(
        functools.partial(_kernel, compute=compute, known=known, interpret=interpret),
        grid=(programs,),
        out_shape=[
            jax.ShapeDtypeStruct((outputs, programs * LANES), jnp.float32),
            jax.ShapeDtypeStruct((programs,), jnp.int32),
        ],
        compiler_params=_COMPILER,
        interpret=interpret,
        name=name,
    )
    return jaxpr_as_fun(jax.make_jaxpr(launch)(jax.ShapeDtypeStruct(shape, jnp.float32)))


def _kernel(inputs: Any, results: Any, done: Any, *, compute: Compute, known: Hashable, interpret: bool) -> None:
    program = pl.program_id(0)
    own = pl.ds(program * LANES, LANES)
    rows = [inputs[row, own] for row in range(inputs.shape[0])] if interpret else read_rows(inputs)
    computed = jax.jit(compute, static_argnums=0)(known, rows)
    numbers = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), (LANES,)) for number in computed]
    if interpret:
        for row, number in enumerate(numbers):
            results[row, own] = number
    else:
        done[program] = write_rows(results, numbers)


@functools.cache
def _address_primitive() -> Any:
    """A primitive that takes an array of a kernel and has its address, for all threads: [32] int64.

    These are insides of JAX. They are imported here so that a JAX that has moved them loses the kernels, and nothing else.
    """
    from jax._src import core
    from jax._src.lib import triton
    from jax._src.pallas.triton import lowering

    primitive = core.Primitive("address")
    primitive.def_abstract_eval(lambda ref: core.ShapedArray((LANES,), jnp.dtype("int64")))

    @lowering.register_lowering(primitive)
    def _(context: Any, pointer: Any) -> Any:
        dialect: Any = triton.dialect  # pyright: ignore[reportPrivateImportUsage]
        address = dialect.ptr_to_int(mlir.ir.IntegerType.get_signless(64), pointer)
        return dialect.splat(mlir.aval_to_ir_type(context.context.mlir_ctx, context.avals_out[0]), address)

    return primitive


def _assemble(lines: str, dtype: Any, *arguments: jax.Array) -> jax.Array:
    """The result, $0, of some instructions with arguments $1, $2, ..., in each thread."""
    letters = {"int64": "l", "int32": "r", "float32": "f"}
    constraints = ",".join(["=" + letters[dtype], *(letters[str(argument.dtype)] for argument in arguments)])
    shape = jax.ShapeDtypeStruct((LANES,), dtype)
    (result,) = plgpu.elementwise_inline_asm(
        lines, args=arguments, constraints=constraints, pack=1, result_shape_dtypes=[shape]
    )
    return result


def _own_address(ref: Any) -> jax.Array:
    """For each thread of all programs, the address of its number in the first row of an array [rows, threads], float32."""
    return _assemble(
        """
        {
        .reg .u32 program, lane;
        mov.u32 program, %ctaid.x;
        mov.u32 lane, %tid.x;
        mad.lo.u32 lane, program, 32, lane;
        mad.wide.u32 $0, lane, 4, $1;
        }
        """,
        "int64",
        _address_primitive().bind(ref),
    )


def read_rows(ref: Any) -> list[jax.Array]:
    """[32] float32 of each row of an array [rows, 32 * programs], of which each thread takes its own column."""
    rows, threads = ref.shape
    address = _own_address(ref)
    return [_assemble(f"ld.global.nc.f32 $0, [$1+{4 * threads * row}];", "float32", address) for row in range(rows)]


def write_rows(ref: Any, values: Iterable[jax.Array]) -> jax.Array:
    """Writes [32] float32 each into the rows of an array [rows, 32 * programs]; the reverse of `read_rows`.

    Returns:
        [] int32, 0, of which the compiler does not know that: it keeps the writes if this is used.
    """
    threads = ref.shape[1]
    address, done = _own_address(ref), jnp.zeros(LANES, jnp.int32)
    for row, value in enumerate(values):
        done = _assemble(f"st.global.f32 [$1+{4 * threads * row}], $2; mov.u32 $0, $3;", "int32", address, value, done)
    return jnp.sum(done)
