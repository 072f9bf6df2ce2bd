"""Counting, measuring and grasping of sorghum stalks from stereo images (chapters 3 and 4 of the thesis).

    phenotyping    counts and widths of the stalks in a plot        grasping    detecting, reaching and grasping stalks
    cli            the commands ``phenotype`` and ``grasp``

A separate application, with the extras ``phenotyping`` and ``grasping``. It builds on the rest of `jaxrl_vis`, which accesses
it only through `cli.COMMANDS`.
"""
