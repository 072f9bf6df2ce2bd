"""The farm: sorghum stalks counted, measured and grasped from stereo images (chapters 3 and 4 of the thesis).

    phenotyping    counts and widths of the stalks in a plot        grasping    stalks found, reached and held
    cli            the commands ``phenotype`` and ``grasp``

A product of its own, with the extras ``phenotyping`` and ``grasping``. It builds on the rest of `jaxrl_vis`, which reaches it
through `cli.COMMANDS` alone.
"""
