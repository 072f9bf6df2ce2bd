"""Import layers of the renderer: each module imports only from earlier ones."""

from test_packaging import imports_within

# A room imports from earlier rows only; rooms of one row do not import each other.
ROOMS = (
    ("mounts",),
    ("model", "outputs", "viewpoint"),
    ("scene", "cords"),
    ("camera",),
    ("pixel",),
    ("cpu", "gpu"),
    ("images",),
)
RENDER = "jaxrl_vis_envs.render."


def test_renderer_imports_have_no_cycles() -> None:
    depth_of = {name: depth for depth, names in enumerate(ROOMS) for name in names}
    graph = imports_within("jaxrl_vis_envs", when_running=False)
    inside = {name.removeprefix(RENDER): targets for name, targets in graph.items() if name.startswith(RENDER)}
    assert {name.split(".")[0] for name in inside} == set(depth_of)
    for name, targets in inside.items():
        room = name.split(".")[0]
        for target in targets:
            other = target.removeprefix(RENDER).split(".")[0]
            if target.startswith(RENDER):
                assert other == room or depth_of[other] < depth_of[room], f"{name} must not import {target}"
