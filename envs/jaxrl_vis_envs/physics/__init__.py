"""Physics in MJX: models, kinematics, constraint solvers and inverse kinematics.

mjx_model           loading a model, and stepping it: `step`, `take_steps`, `simulate`; `solver_of` names the solver of a model
newton              the constraint solver for models of few joints; all others are left to MJX
kinematics          poses of all bodies at once
inverse_kinematics  joint angles that bring the last link of a chain to a pose
"""
