"""Physics of the tasks: two engines for MuJoCo models, and kinematics.

    mjx_model           the MJX engine: loading a model and stepping it; `take_steps` and `simulate` choose between the engines
    constraints         accelerations under constraints for the MJX engine: by `newton`, or by MJX's own solver
    newton              a constraint solver for small trees in matrices, the fastest on CPUs
    box_contacts        contacts between boxes
    kinematics          forward kinematics, all bodies at once
    rotations           quaternions and frames, from a private module of MJX
    inverse_kinematics  joint angles that bring the last link of a chain to a pose
    scalar/             the scalar engine: a subset of MuJoCo in scalars, one GPU thread or warp per episode

MJX runs every model on every platform and is the reference. The scalar engine computes the same steps for the models that it
supports (`scalar.supports`), as long as nothing disturbs them (`mjx_model.take_steps`), where it is faster:

    engine    NVIDIA GPUs                                  CPUs
    scalar    all tasks, in one kernel                     FingerTurn (up to three joints, if `newton` does not support them)
    MJX       models that `scalar` does not support,       FetchPush, FetchReach, Reacher, SawyerReach and StalkReach with
              randomized dynamics                          `newton`, HandReach with MJX's own solver

Other accelerators run MJX. Importing this package makes MJX import faster and without its notice about Warp (`mjx_imports`).
"""

from jaxrl_vis_envs.compiling import mjx_imports

mjx_imports.install()
