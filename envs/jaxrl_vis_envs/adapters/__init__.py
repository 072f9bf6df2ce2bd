"""Adapters of the environments to other libraries' interfaces: `adapters.brax` and `adapters.gymnasium`.

Each needs the library it is named after and raises an ImportError with instructions if it is missing. brax is installed with
jaxrl-vis; Gymnasium is an extra: ``pip install 'jaxrl-vis[gymnasium]'``, or in a clone ``pip install '.[gymnasium]'``. Nothing
else in this package imports them.
"""

from jaxrl_vis_envs import physics as physics  # before brax, which imports MJX
