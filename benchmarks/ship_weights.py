"""Puts trained weights into the package, with 10 bits a number: `python benchmarks/ship_weights.py FILE`.

FILE is what `jaxrl-vis phenotype train` or `jaxrl-vis grasp train` wrote, a segmentation. The wheel has no room for 16 bits.
"""

import sys
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.grasping.masks import painter
from jaxrl_vis.stalks.phenotyping.detector import weights


def main(trained: Path) -> None:
    """Write trained weights into the package, in the room of the network that they fit; exit with a line if they fit none."""
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
