"""The environments behind other libraries' interfaces: `adapters.brax` and `adapters.gymnasium`.

Each needs the library it is named after, and says so where that is missing. brax comes with jaxrl-vis; Gymnasium is an extra:
``pip install 'jaxrl-vis[gymnasium]'``, or in a clone ``pip install '.[gymnasium]'``. Nothing else in this package imports them.
"""

from jaxrl_vis_envs import physics as physics  # before brax, which imports MJX
