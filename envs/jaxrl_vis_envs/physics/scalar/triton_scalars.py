"""One scalar per thread in Pallas kernels (Triton) of thousands of operations: loads, stores and the launch.

Episodes have a thread each (`episode_kernel`) or a warp (`warp_kernel`).

Triton analyses the whole program once for each load and store to distribute it over the threads of a block, so a kernel with
500 loads takes minutes to compile. Here each thread loads and stores its own scalars by inline PTX, which Triton does not
analyse. This needs a primitive that Pallas lacks and that is added here: the address of an array.
"""

import functools
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import mlir

from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

WARP_SIZE = 32
"""Number of threads of a kernel's program, one warp."""
_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)

Compute = Callable[[Any, list[jax.Array]], Iterable[Any]]


def episode_kernel(
    name: str, compute: Compute, constants: Hashable, outputs: int, interpret: bool
) -> Callable[[jax.Array], jax.Array]:
    """Wrap a function of one episode as a GPU kernel with one thread per episode, 32 threads per program.

    Calls within one program with the same ``compute``, ``constants`` and batch size share one kernel, compiled once.

    Args:
        name: Name of the kernel.
        compute: Function from ``constants`` and an episode's inputs to its outputs; scalars are [32] float32, one per thread.
            It is traced once for all batch sizes.
        constants: Constants of the kernel.
        outputs: Number of outputs.
        interpret: Run the kernel without a GPU, slowly.

    Returns:
        The function from inputs [B, I] float32 to outputs [B, ``outputs``]; axes of `jax.vmap` are merged into B.
    """

    def run(inputs: jax.Array) -> jax.Array:
        batch = inputs.shape[0]
        programs = pl.cdiv(batch, WARP_SIZE)
        # Threads beyond the last episode repeat it: zeros might be invalid inputs.
        inputs = jnp.pad(inputs, ((0, programs * WARP_SIZE - batch), (0, 0)), mode="edge")
        launch = _trace_kernel(name, compute, constants, outputs, interpret, inputs.T.shape, jax.sharding.get_abstract_mesh())
        results, _ = launch(inputs.T)
        return results.T[:batch]

    return _merge_vmap_axes(run)


def _merge_vmap_axes(call: Callable[[jax.Array], jax.Array]) -> Callable[[jax.Array], jax.Array]:
    """Return a function of inputs [B, I] that merges axes of `jax.vmap` into B."""
    run = custom_vmap(call)

    @run.def_vmap
    def _(size: int, in_batched: list[bool], inputs: jax.Array) -> tuple[jax.Array, bool]:
        del in_batched  # there is one input, so it is batched
        flat = run(inputs.reshape(-1, inputs.shape[-1]))
        return flat.reshape(size, -1, flat.shape[-1]), True

    return run


@functools.lru_cache(maxsize=16)
def _trace_kernel(
    name: str, compute: Compute, constants: Hashable, outputs: int, interpret: bool, shape: tuple[int, int], mesh: Any
) -> Callable[[jax.Array], list[jax.Array]]:
    """Trace the kernel for inputs of a ``shape`` [I, 32 * programs]; a trace is reused only within its ``mesh``.

    XLA merges kernels whose code is identical, debug information included, and that differs between traces from two places.
    """
    del mesh
    programs = shape[1] // WARP_SIZE
    launch = kernel_call(
        functools.partial(_kernel, compute=compute, constants=constants, interpret=interpret),
        grid=(programs,),
        out_shape=[
            jax.ShapeDtypeStruct((outputs, programs * WARP_SIZE), jnp.float32),
            jax.ShapeDtypeStruct((programs,), jnp.int32),
        ],
        compiler_params=_COMPILER,
        interpret=interpret,
        name=name,
    )
    return jaxpr_as_fun(jax.make_jaxpr(launch)(jax.ShapeDtypeStruct(shape, jnp.float32)))


def warp_kernel(
    name: str, compute: Callable[..., Iterable[Any]], constants: Hashable, table: np.ndarray, outputs: int, interpret: bool
) -> Callable[[jax.Array], jax.Array]:
    """Wrap a function of one episode as a GPU kernel with a warp of 32 threads (lanes) per episode.

    Calls within one program with the same ``compute``, ``constants`` and batch size share one kernel, compiled once.

    Args:
        name: Name of the kernel.
        compute: Function from ``constants``, an episode's inputs and the rows of ``table`` to its outputs; scalars are [32]
            float32, one per lane. Inputs are the same in all lanes, and outputs have to be.
        constants: Constants of the kernel.
        table: [R, 32], a number per lane in each row.
        outputs: Number of outputs.
        interpret: Run the kernel without a GPU, slowly.

    Returns:
        The function from inputs [B, I] float32 to outputs [B, ``outputs``]; axes of `jax.vmap` are merged into B.
    """

    def run(inputs: jax.Array) -> jax.Array:
        mesh = jax.sharding.get_abstract_mesh()
        launch = _trace_warp_kernel(name, compute, constants, table.shape[0], outputs, interpret, inputs.shape, mesh)
        results, _ = launch(inputs, jnp.asarray(table, jnp.float32))
        return results

    return _merge_vmap_axes(run)


@functools.lru_cache(maxsize=16)
def _trace_warp_kernel(
    name: str,
    compute: Compute,
    constants: Hashable,
    rows: int,
    outputs: int,
    interpret: bool,
    shape: tuple[int, int],
    mesh: Any,
) -> Callable[..., list[jax.Array]]:
    """Trace the kernel for inputs of a ``shape`` [B, I]; see `_trace_kernel`."""
    del mesh
    launch = kernel_call(
        functools.partial(_warp_kernel, compute=compute, constants=constants, interpret=interpret),
        grid=(shape[0],),
        out_shape=[jax.ShapeDtypeStruct((shape[0], outputs), jnp.float32), jax.ShapeDtypeStruct((shape[0],), jnp.int32)],
        compiler_params=_COMPILER,
        interpret=interpret,
        name=name,
    )
    arguments = [jax.ShapeDtypeStruct(size, jnp.float32) for size in (shape, (rows, WARP_SIZE))]
    return jaxpr_as_fun(jax.make_jaxpr(launch)(*arguments))


def _warp_kernel(
    inputs: Any,
    table: Any,
    results: Any,
    done: Any,
    *,
    compute: Callable[..., Iterable[Any]],
    constants: Hashable,
    interpret: bool,
) -> None:
    program = pl.program_id(0)
    if interpret:
        numbers = [jnp.broadcast_to(inputs[program, column], (WARP_SIZE,)) for column in range(inputs.shape[1])]
        rows = [table[row, :] for row in range(table.shape[0])]
    else:
        own, lanes = _program_address(inputs), _lane_address(table)
        numbers = [_load(own, 4 * column) for column in range(inputs.shape[1])]
        rows = [_load(lanes, 4 * WARP_SIZE * row) for row in range(table.shape[0])]
    computed = jax.jit(compute, static_argnums=0)(constants, numbers, rows)
    if interpret:
        for column, number in enumerate(computed):
            results[program, column] = number[0]
        done[program] = jnp.int32(0)
    else:
        own = _program_address(results)
        done[program] = _store(own, ((4 * column, number) for column, number in enumerate(computed)))


def _kernel(inputs: Any, results: Any, done: Any, *, compute: Compute, constants: Hashable, interpret: bool) -> None:
    program = pl.program_id(0)
    own = pl.ds(program * WARP_SIZE, WARP_SIZE)
    rows = [inputs[row, own] for row in range(inputs.shape[0])] if interpret else load_rows(inputs)
    computed = jax.jit(compute, static_argnums=0)(constants, rows)
    numbers = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), (WARP_SIZE,)) for number in computed]
    if interpret:
        for row, number in enumerate(numbers):
            results[row, own] = number
    else:
        done[program] = store_rows(results, numbers)


@functools.cache
def _address_primitive() -> Any:
    """Return a primitive that maps a kernel's array to its address, repeated for all threads: [32] int64.

    It uses private modules of JAX, imported here so that a JAX without them loses the kernels and nothing else.
    """
    from jax._src import core
    from jax._src.lib import triton
    from jax._src.pallas.triton import lowering

    primitive = core.Primitive("address")
    primitive.def_abstract_eval(lambda ref: core.ShapedArray((WARP_SIZE,), jnp.dtype("int64")))

    @lowering.register_lowering(primitive)
    def _(context: Any, pointer: Any) -> Any:
        dialect: Any = triton.dialect  # pyright: ignore[reportPrivateImportUsage]
        address = dialect.ptr_to_int(mlir.ir.IntegerType.get_signless(64), pointer)
        return dialect.splat(mlir.aval_to_ir_type(context.context.mlir_ctx, context.avals_out[0]), address)

    return primitive


def _assemble(lines: str, dtype: Any, *arguments: jax.Array) -> jax.Array:
    """Run PTX instructions in each thread, with arguments $1, $2, ...; return the result $0."""
    letters = {"int64": "l", "int32": "r", "float32": "f"}
    constraints = ",".join(["=" + letters[dtype], *(letters[str(argument.dtype)] for argument in arguments)])
    shape = jax.ShapeDtypeStruct((WARP_SIZE,), dtype)
    (result,) = plgpu.elementwise_inline_asm(
        lines, args=arguments, constraints=constraints, pack=1, result_shape_dtypes=[shape]
    )
    return result


def _own_address(ref: Any) -> jax.Array:
    """Return each thread's address of its own element in the first row of an array [rows, threads] float32."""
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


def _program_address(ref: Any) -> jax.Array:
    """Return the address of a program's own row of an array [programs, columns] float32, in each thread."""
    lines = f"{{ .reg .u32 program; mov.u32 program, %ctaid.x; mad.wide.u32 $0, program, {4 * ref.shape[1]}, $1; }}"
    return _assemble(lines, "int64", _address_primitive().bind(ref))


def _lane_address(ref: Any) -> jax.Array:
    """Return each thread's address of its own element in the first row of an array [rows, 32] float32."""
    lines = "{ .reg .u32 lane; mov.u32 lane, %tid.x; mad.wide.u32 $0, lane, 4, $1; }"
    return _assemble(lines, "int64", _address_primitive().bind(ref))


def load_rows(ref: Any) -> list[jax.Array]:
    """Load each thread's column of an array [rows, 32 * programs]: [32] float32 per row."""
    rows, threads = ref.shape
    address = _own_address(ref)
    return [_load(address, 4 * threads * row) for row in range(rows)]


def store_rows(ref: Any, values: Iterable[jax.Array]) -> jax.Array:
    """Store one value, [32] float32, per row into each thread's column of an array [rows, 32 * programs].

    Returns:
        [] int32, always 0; the compiler cannot know that, and keeps the stores if it is used.
    """
    threads = ref.shape[1]
    return _store(_own_address(ref), ((4 * threads * row, value) for row, value in enumerate(values)))


def _load(address: jax.Array, offset: int) -> jax.Array:
    """Load float32 [32] from each thread's ``address`` plus ``offset`` bytes, of an array that the kernel does not change."""
    return _assemble(f"ld.global.nc.f32 $0, [$1+{offset}];", "float32", address)


def _store(address: jax.Array, values: Iterable[tuple[int, jax.Array]]) -> jax.Array:
    """Store values, [32] float32, at each thread's ``address`` plus their offsets in bytes; return 0 as `store_rows` does."""
    done = jnp.zeros(WARP_SIZE, jnp.int32)
    for offset, value in values:
        done = _assemble(f"st.global.f32 [$1+{offset}], $2; mov.u32 $0, $3;", "int32", address, value, done)
    return jnp.sum(done)
