"""Add trained weights to the package, quantised to 10 bits: `python benchmarks/ship_weights.py FILE`.

FILE holds the networks written by `jaxrl-vis phenotype train` or `jaxrl-vis grasp train`. With 16 bits the wheel would become
too large.
"""

import sys
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.grasping.masks import painter
from jaxrl_vis.stalks.phenotyping.detector import weights


def main(trained: Path) -> None:
    """Replace the packaged weights of the networks in the file ``trained``; exit with an error line if it contains none."""
    for room in (weights, painter):
        try:
            params, settings, origin = room.read_weights(trained)
        except RequestError:
            continue
        room.write_weights(room.SHIPPED, params, settings, origin, bits=10)
        print(f"{room.SHIPPED}: {file_digest(room.SHIPPED)}, {room.SHIPPED.stat().st_size / 1e6:.1f} MB")
        return
    sys.exit(f"{trained} holds no weights of stalks")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
