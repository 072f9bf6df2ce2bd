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
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings


def main(trained: Path) -> None:
    """Replace the packaged weights of the networks in the file ``trained``; exit with an error line if it contains none."""
    for room in (weights, painter):
        try:
            params, settings, origin = room.read_weights(trained)
        except RequestError:
            continue
        is_for_photographs = isinstance(settings, Settings) and settings.section
        target = weights.PHOTOGRAPHS if is_for_photographs else room.SHIPPED
        room.write_weights(target, params, settings, origin, bits=10)
        print(f"{target}: {file_digest(target)}, {target.stat().st_size / 1e6:.1f} MB")
        return
    sys.exit(f"{trained} holds no weights of stalks")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
