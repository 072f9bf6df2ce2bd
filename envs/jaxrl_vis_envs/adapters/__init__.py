"""The environments behind other libraries' interfaces: `adapters.brax` and `adapters.gymnasium`.

Each needs the library it is named after (``pip install 'jaxrl-vis[brax]'``, ``pip install 'jaxrl-vis[gymnasium]'``), and says
so where that is missing. Nothing else in this package imports them.
"""
