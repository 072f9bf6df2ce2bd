"""Settings of this process under which JAX traces, lowers and keeps small programs faster; an import applies them.

For conftest.py and for scripts that tests start. No result depends on them.
"""

import functools
import gc
import threading
import zlib
from types import SimpleNamespace
from typing import Any

import jax
import jax._src.compilation_cache
import jax._src.interpreters.mlir

# Tracing makes millions of small objects, few of them garbage: looked for as often as by default, it costs a tenth of it all.
gc.set_threshold(100_000, 20, 20)

# What JAX keeps of a program is read once or twice: to compress it well takes longer than that.
jax._src.compilation_cache.zlib = SimpleNamespace(
    compress=functools.partial(zlib.compress, level=1), decompress=zlib.decompress
)

# JAX 0.10 makes a new MLIR context for each program that it lowers, which takes as long as compiling a single operation. JAX
# 0.11 uses each one several times, too; not for longer, as a context keeps the constants of its programs.
_PROGRAMS_PER_CONTEXT = 10
_contexts = threading.local()  # programs are also lowered in threads
_make_context = jax._src.interpreters.mlir.make_ir_context


def _shared_context() -> Any:
    if getattr(_contexts, "uses", _PROGRAMS_PER_CONTEXT) == _PROGRAMS_PER_CONTEXT:
        _contexts.shared, _contexts.uses = _make_context(), 0
    _contexts.uses += 1
    return _contexts.shared


if jax.__version__.startswith("0.10."):
    jax._src.interpreters.mlir.make_ir_context = _shared_context
