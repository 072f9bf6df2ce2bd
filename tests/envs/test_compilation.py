"""Choice of the implementation in a program, by its platform and the user's request; no GPU is needed."""

import gc
import importlib
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.pallas import triton as plgpu
from nvidia import lowered_for_nvidia
from small_scene import small_scene

from jaxrl_vis.config import preset
from jaxrl_vis.learner.networks.kernels import passes as encoder_kernel_passes
from jaxrl_vis.learner.parallel.sharding import ONE_DEVICE
from jaxrl_vis.run.compiled.programs import Programs, rarely_collecting_garbage
from jaxrl_vis_envs.compiling import compilation, gpu_kernels
from jaxrl_vis_envs.compiling.compilation import (
    dispatch_by_platform,
    kernels,
    targets_cpu,
    tracing_for,
    tracing_for_default_device,
    use_gpu_kernels,
)
from jaxrl_vis_envs.physics.scalar import steps_kernel
from jaxrl_vis_envs.render import render_planes
from jaxrl_vis_envs.render.gpu import kernel

KERNEL_CALL = "__gpu$xla.gpu.triton"


@pytest.fixture
def gpu(monkeypatch):
    """Function that adds an NVIDIA GPU of a given compute capability to the devices that the process sees."""

    def add(capability: str = "9.0") -> None:
        card = SimpleNamespace(compute_capability=capability, device_kind="NVIDIA Test")
        devices = {"cuda": [card], None: jax.devices()}
        monkeypatch.setattr(compilation, "accelerator", lambda: "cuda")
        monkeypatch.setattr(jax, "devices", lambda platform=None: devices[platform])
        monkeypatch.setattr(jax, "default_device", lambda device: tracing_for("cuda"))

    return add


def lowered(function, platform: str, *arguments) -> str:
    if platform == "cuda":
        return lowered_for_nvidia(lambda: jax.jit(function).trace(*arguments))
    return jax.jit(function).trace(*arguments).lower(lowering_platforms=(platform,)).as_text()


def test_a_process_without_an_accelerator_traces_for_the_cpu_alone():
    assert compilation.accelerator() is None
    traced = []
    dispatch_by_platform(lambda x: traced.append(compilation.target_platform()) or x, jnp.ones(()))
    assert traced == ["cpu"]


@pytest.mark.parametrize(
    ("platform", "capability", "expected"),
    [("cpu", "9.0", False), ("cuda", "9.0", True), ("cuda", "8.0", True), ("cuda", "7.5", False), ("rocm", "9.0", False)],
)
def test_kernels_are_left_to_gpus_that_run_them(platform, capability, expected, gpu):
    gpu(capability)
    with tracing_for(platform):
        assert use_gpu_kernels() is expected


@pytest.mark.parametrize(
    ("variable", "inside", "expected"),
    [("auto", None, True), ("0", None, False), ("0", True, True), ("1", False, False), ("auto", False, False)],
)
def test_kernels_can_be_switched_off_and_on(variable, inside, expected, gpu, monkeypatch):
    gpu()
    monkeypatch.setenv("JAXRL_VIS_KERNELS", variable)
    with tracing_for("cuda"), kernels(inside):
        assert use_gpu_kernels() is expected
    with kernels(True), tracing_for("cpu"):
        assert not use_gpu_kernels()


def test_a_wrong_value_of_the_variable_is_refused(monkeypatch):
    monkeypatch.setenv("JAXRL_VIS_KERNELS", "yes")
    with pytest.raises(ValueError, match="JAXRL_VIS_KERNELS is 'yes'.*0 .*1 .*auto"):
        use_gpu_kernels()


def small_program() -> jax.stages.Traced:
    """Return a traced program that compiles anywhere."""
    return jax.jit(jnp.negative).trace(jnp.float32(0))


def test_a_kernel_that_does_not_compile_is_left_out_and_named_once(gpu, monkeypatch, capsys):
    gpu()
    calls = []

    def breaks() -> jax.stages.Traced:
        calls.append(compilation.target_platform())
        raise RuntimeError("ptxas: no\nsecond line")

    def works() -> jax.stages.Traced:
        calls.append("works")
        return small_program()

    @jax.jit
    def traced(x):
        with tracing_for("cuda"):
            return x + use_gpu_kernels(breaks) + 2 * use_gpu_kernels(works) + 4 * use_gpu_kernels(breaks)

    assert traced(jnp.float32(0)) == 2
    assert calls == ["cuda", "works"]
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "NVIDIA Test" in said[0] and "ptxas: no" in said[0] and "JAXRL_VIS_KERNELS=0" in said[0]
    monkeypatch.setenv("JAXRL_VIS_KERNELS", "1")  # asks for the error itself
    with tracing_for("cuda"):
        assert use_gpu_kernels(breaks)


def run_of(function) -> Programs:
    """Return the programs of a run that has nothing but ``init``, a function of keys."""
    programs = Programs(
        preset("debug"), SimpleNamespace(env=None, layout=ONE_DEVICE, part_size=1, plays_parts=False, init=jax.jit(function))
    )
    programs.shapes = SimpleNamespace(train=None)  # type: ignore[assignment]
    return programs


def test_a_run_trusts_kernels_and_asks_where_its_programs_do_not_compile(gpu, monkeypatch, capsys):
    gpu()
    monkeypatch.setattr(compilation, "_assumed", set())
    probed = []

    def breaks() -> jax.stages.Traced:
        probed.append("breaks")
        raise RuntimeError("ptxas: no")

    def works() -> jax.stages.Traced:
        probed.append("works")
        return small_program()

    def function(keys):
        with tracing_for("cuda"):
            assert use_gpu_kernels(works)
            if use_gpu_kernels(breaks):
                raise RuntimeError("as compilers fail")
            return jnp.ones(3)

    programs = run_of(function)
    assert programs.compiled("init")(programs.run_keys).sum() == 3
    assert sorted(probed) == ["breaks", "works"]
    assert "ptxas: no" in capsys.readouterr().err

    def mistaken(keys):
        with tracing_for("cuda"):
            assert use_gpu_kernels(works)
        raise ZeroDivisionError

    monkeypatch.setattr(compilation, "_assumed", set())
    with pytest.raises(ZeroDivisionError):
        run_of(mistaken).compiled("init")
    assert not capsys.readouterr().err


def test_a_run_whose_programs_compile_asks_nothing(gpu):
    gpu()
    probed = []

    def probe() -> jax.stages.Traced:
        probed.append(True)
        return small_program()

    def function(keys):
        with tracing_for("cuda"):
            return jnp.ones(3) * use_gpu_kernels(probe)

    programs = run_of(function)
    assert programs.compiled("init")(programs.run_keys).sum() == 3
    assert not probed


@pytest.mark.parametrize("module", [kernel, encoder_kernel_passes, steps_kernel])
def test_the_kernels_themselves_are_probed_in_the_midst_of_a_trace(module, gpu):
    """Without a GPU, the kernels are compiled down to Triton's code only."""
    gpu()

    def probe() -> jax.stages.Traced:
        lowered_for_nvidia(module.probe)
        return small_program()

    @jax.jit
    def traced(x):
        with tracing_for("cuda"):
            return x + use_gpu_kernels(probe)

    assert traced(jnp.float32(0)) == 1


@pytest.mark.skipif(jax.__version_info__ < (0, 11), reason="JAX 0.10 does not ask what a GPU is called")
@pytest.mark.parametrize(("capability", "name"), [("8.6", "NVIDIA A10"), ("8.7", "NVIDIA A10"), ("7.5", None)])
def test_a_card_that_jax_does_not_know_is_called_by_the_name_of_one_like_it(gpu, monkeypatch, capability, name):
    monkeypatch.setattr(gpu_kernels, "_substitutes", {})
    gpu(capability)
    assert gpu_kernels._substitute_name() == name

    def double(source, target):
        target[...] = 2.0 * source[...]

    row = jax.ShapeDtypeStruct((32,), jnp.float32)
    call = gpu_kernels.kernel_call(double, out_shape=row, compiler_params=plgpu.CompilerParams(num_warps=1), name="double")
    program = jax.jit(call).trace(row)
    if name is None:
        with pytest.raises(RuntimeError, match="AbstractDevice"):
            program.lower(lowering_platforms=("cuda",))
    else:
        assert KERNEL_CALL in program.lower(lowering_platforms=("cuda",)).as_text()


def test_a_program_holds_the_branch_of_its_own_platform(gpu):
    gpu()

    def function(x):
        return jnp.sin(x) if targets_cpu() else jnp.sin(x) + 0.0 * jnp.exp(x)

    def slope(x):
        return jax.vmap(jax.grad(lambda x: dispatch_by_platform(function, x)))(x)

    x = jnp.arange(3.0)
    assert "exponential" in lowered(slope, "cuda", x) and "exponential" not in lowered(slope, "cpu", x)
    np.testing.assert_allclose(jax.jit(slope)(x), jnp.cos(x), rtol=1e-6)


def test_mlir_finds_the_dialect_of_triton(monkeypatch):
    """MLIR looks for the dialect under a name that jaxlib lacks; once jaxlib has it, the alias tested here can be removed."""
    name = "jaxlib.mlir.dialects.tt"
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ImportError):
        importlib.import_module(name)
    compilation._register_triton_dialect.cache_clear()
    with tracing_for("cuda"), kernels(True):
        assert use_gpu_kernels()
    assert importlib.import_module(name) is importlib.import_module("jaxlib.triton.dialect")


def test_a_function_is_traced_for_each_platform_and_choice(gpu):
    """An inner function that was jitted and traced for one of them must not be taken for another."""
    gpu()
    traced = []

    @jax.jit
    def inner(x):
        traced.append((compilation.target_platform(), use_gpu_kernels()))
        return x + 1.0

    def outer(x):
        return dispatch_by_platform(inner, x)

    lowered(lambda x: outer(x), "cpu", jnp.ones(()))
    with kernels(False):
        lowered(lambda x: outer(x), "cuda", jnp.ones(()))
    assert set(traced) == {("cpu", False), ("cuda", False), ("cuda", True)}


def test_programs_of_the_default_device_are_traced_once(gpu, monkeypatch):
    gpu()
    traced = []

    def function(x):
        traced.append(compilation.target_platform())
        return x

    with tracing_for_default_device():  # a CPU
        dispatch_by_platform(function, jnp.ones(()))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with tracing_for_default_device():
        dispatch_by_platform(function, jnp.ones(()))
    monkeypatch.setattr(jax, "config", SimpleNamespace(jax_default_device=SimpleNamespace(platform="cpu")))
    with tracing_for_default_device():
        dispatch_by_platform(function, jnp.ones(()))
    assert traced == ["cpu", "cuda", "cpu"]


def test_an_image_is_drawn_by_the_kernel_of_its_own_platform(gpu, monkeypatch):
    scene, poses = small_scene(height=12, width=12, few=True)

    def draw(places, rgb=True):
        def one(place):
            moved = SimpleNamespace(**{**vars(poses), "geom_xpos": place})
            return render_planes(scene, moved, rgb=rgb, depth=not rgb, quantized=True)

        return jax.vmap(one)(places)

    def slope(places):
        return jax.grad(lambda places: jnp.sum(jnp.sin(draw(places, rgb=False).depth)))(places)

    places = jnp.stack([poses.geom_xpos, poses.geom_xpos + 0.01])
    expected, expected_slope = jax.jit(draw)(places), jax.jit(slope)(places)
    gpu()
    monkeypatch.setenv("JAXRL_VIS_KERNELS", "1")
    # Other functions, because JAX would not trace the same ones again.
    assert KERNEL_CALL in lowered(lambda x: draw(x), "cuda", places)
    assert KERNEL_CALL not in lowered(lambda x: draw(x), "cpu", places)
    with kernels(False):
        assert KERNEL_CALL not in lowered(lambda x: draw(x), "cuda", places)
    np.testing.assert_array_equal(jax.jit(lambda x: draw(x))(places).rgb, expected.rgb)
    np.testing.assert_allclose(jax.jit(lambda x: slope(x))(places), expected_slope, rtol=1e-5, atol=1e-6)


def test_the_probe_of_the_kernel_is_an_instance_of_it(monkeypatch):
    """The probe can be lowered without a GPU; compiling it would need one."""
    from jaxrl_vis_envs.render.gpu import kernel

    assert KERNEL_CALL in lowered_for_nvidia(kernel.probe)


@pytest.mark.parametrize("chosen", [(700, 10, 10), (0, 10, 10), (500_000, 5, 5)])
def test_garbage_is_looked_for_as_before_once_programs_are_traced(chosen):
    """The threshold chosen by the process, 0 included, is restored; during tracing, collections are never more frequent."""
    before = gc.get_threshold()
    try:
        gc.set_threshold(*chosen)
        with pytest.raises(ZeroDivisionError), rarely_collecting_garbage():
            assert gc.get_threshold()[0] == (max(chosen[0], 100_000) if chosen[0] else 0)
            raise ZeroDivisionError
        assert gc.get_threshold() == chosen
    finally:
        gc.set_threshold(*before)
