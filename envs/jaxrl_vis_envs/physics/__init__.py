"""Physics in MJX: models, kinematics, constraint solvers and inverse kinematics.

mjx_model           loading a model, and stepping it: `step`, `take_steps`, `simulate`
constraints         motion under constraints; `solver_of` names the solver of a model
descent             the same for small models, number by number (`algebra`, `cones`, `line_search`); newton_kernel makes it a
                    GPU kernel
newton              the same for models of few joints in matrices, for CPUs; what neither takes is left to MJX
steps               physics steps number by number, by folding, quaternions, links, dynamics, places, capsules, welds, reference
                    and mechanism; steps_kernel makes all steps of a control step one GPU kernel
kinematics          poses of all bodies at once
inverse_kinematics  joint angles that bring the last link of a chain to a pose
"""

from jaxrl_vis_envs.compiling import mjx_imports

mjx_imports.install()
