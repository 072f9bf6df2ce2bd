"""Reads and writes of one number a thread, for Pallas kernels (Triton) that are programs of thousands of operations.

Before Triton decides how the threads of a block share a read or a write, it searches the whole program for others like it, once
for each of them: a kernel that reads 500 numbers takes minutes to compile. Here each thread reads and writes its own numbers
by an instruction of its own (PTX), of which Triton knows nothing. One primitive is missing from Pallas for that, the address of
an array, and is added here.
"""

import functools
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.pallas import triton as plgpu
from jax.interpreters import mlir

LANES = 32
"""Threads of a program: those of a warp."""


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
