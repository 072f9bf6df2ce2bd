"""Operations of a control step that a GPU would launch one after the other, counted without a GPU.

    python -m benchmarks.profiling.launches [TASK ...] [--environments 64]

A control step is compiled for a CPU with the MJX engine, one physics step after the other, and its operations are counted after
fusion, those of a loop once per iteration. A GPU fuses some differently, but each of the rest is a launch, however little it
computes. Where the scalar engine has a kernel for the task (`physics.scalar`), all physics steps become one launch, and only
the operations outside of the loop over them remain.
"""

import argparse
import collections
import re
import sys
from typing import Any

import jax

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.physics import scalar

_NO_LAUNCH = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "partition-id"}
_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.-]+) .*\{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?[\w.-]+ = (?:\([^=]*?\)|\S+) ([\w-]+)\(")
_CALLED = re.compile(r"(?:body|to_apply)=%?([\w.-]+)")
_TRIP_COUNT = re.compile(r'"known_trip_count":\{"n":"(\d+)"')

Counts = collections.Counter[str]


def count_launches(program: str) -> tuple[Counts, Counts, int]:
    """Count the operations of an optimized HLO program by opcode.

    Returns:
        Operations outside the loop with the most operations, operations of one iteration of that loop, and its number of
        iterations. Operations in other loops are multiplied by their trip counts; each iteration also counts as one "loop
        iteration". A loop whose trip count depends on data counts as one iteration, called "open loop".
    """
    computations: dict[str, list[str]] = {}
    entry = name = ""
    for line in re.sub(r"/\*.*?\*/", "", program).splitlines():
        if found := _COMPUTATION.match(line):
            name = found[2]
            computations[name] = []
            entry = name if found[1] else entry
        elif name and _INSTRUCTION.match(line):
            computations[name].append(line)
    longest: tuple[Counts, int] = collections.Counter(), 1

    def count(name: str, is_entry: bool = False) -> Counts:
        nonlocal longest
        total: Counts = collections.Counter()
        for line in computations[name]:
            (kind,) = _INSTRUCTION.match(line).groups()  # type: ignore[union-attr] - matched above
            called = _CALLED.search(line)
            if kind == "while" and called:
                trip_count = _TRIP_COUNT.search(line)
                inside, times = count(called[1]), int(trip_count[1]) if trip_count else 1
                if is_entry and inside.total() * times > longest[0].total() * longest[1]:
                    for part, number in longest[0].items():
                        total[part] += number * longest[1]
                    longest = inside, times
                else:
                    for part, number in inside.items():
                        total[part] += number * times
                total["open loop" if trip_count is None else "loop iteration"] += times
            elif kind == "call" and called:
                total += count(called[1], is_entry)
            elif kind not in _NO_LAUNCH:
                total[kind] += 1
        return total

    outside = count(entry, is_entry=True)
    return outside, *longest


def control_step(name: str, episodes: int) -> str:
    """Return the optimized HLO text of a control step of ``episodes`` parallel environments of a task with the MJX engine."""
    env: Any = environments.make(name)
    keys = jax.random.split(jax.random.key(0), episodes)
    state, action = jax.eval_shape(lambda: (jax.vmap(env.reset)(keys), jax.numpy.zeros((episodes, env.action_size))))
    program = jax.jit(jax.vmap(env.step), compiler_options=compiler_options("cpu")).lower(state, action).compile()
    return program.as_text()


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=["FetchPush"])
    parser.add_argument("--environments", type=int, default=64, help="side by side")
    options = parser.parse_args()
    if jax.default_backend() != "cpu":
        print("this counts a program for a CPU: set JAX_PLATFORMS=cpu", file=sys.stderr)
        return 2
    for name in options.tasks:
        outside, inside, iterations = count_launches(control_step(name, options.environments))
        has_kernel = scalar.supports(jaxrl_vis_envs.make(name)._model)
        print(f"{name}: {outside.total() + iterations * inside.total():,} operations a control step, one by one")
        print(f"  {iterations} iterations of {inside.total():,}: {dict(inside.most_common())}")
        print(f"  {outside.total():,} others: {dict(outside.most_common())}")
        print(f"  with all physics steps in one kernel: {outside.total() + 1:,}" if has_kernel else "  no kernel", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
