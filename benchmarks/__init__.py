"""Scripts around the package that run from a checkout and are not part of the wheel.

    peers/        other renderers, physics and learners, compared with ours
    ledger/       stored records: tables of README and docs (`make tables`), records older than their code (`make stale`)
    claims/       tables of the learning studies and claims of the thesis; check_claims.py also checks sentences
    parity.py     tasks against recordings of the originals, made by record_originals.py
    rendering/    the renderer against MuJoCo's own, with render_parity.py
    pixels/       image observations for environments of MuJoCo Playground: parity, speed and training
    tasks/        solvability, difficulty, goal images and physics of the tasks
    profiling/    kernels, rollouts and the cost of weighting; startup_time.py
    stalks/       phenotyping and grasping: speed and accuracy
    soak/         random faults injected into real runs
    results/      records

`ship.py` adds a trained policy to the package, `exported.py` evaluates those that ship, `same_numbers.py` compares two
revisions bit for bit, and `install_smoke_test.py` runs the commands of a new user.
"""
