"""Options of an environment that a configuration passes on by name."""

import pytest

from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.environment import make_env


def test_options_reach_the_environment_with_their_types():
    options = ("goal_at=link", "cross_hair=true", "depth_encoding=zbuffer", "clip_range=0.02,140", "solver_iterations=3")
    config = make_env(preset("debug", env_options=options)).config
    assert (config.goal_at, config.cross_hair, config.depth_encoding) == ("link", True, "zbuffer")
    assert config.clip_range == (0.02, 140.0) and config.solver_iterations == 3 and config.image_size == 16


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("goal_at", "written name=value"),
        ("goal_atz=link", "did you mean goal_at"),
        ("goal_at=nose", "goal_at cannot be 'nose'"),
        ("cross_hair=maybe", "cross_hair must be true or false"),
        ("image_size=32", "--image-size"),
        ("threshold=-1", "threshold"),
    ],
)
def test_bad_options_raise_one_line(option, complaint):
    with pytest.raises(RequestError, match=complaint) as refused:
        make_env(preset("debug", env_options=(option,)))
    assert "\n" not in str(refused.value)
