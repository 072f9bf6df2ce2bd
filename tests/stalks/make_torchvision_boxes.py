"""Record results of torchvision.ops for random boxes in data/torchvision_boxes.npz.

    python tests/stalks/make_torchvision_boxes.py

torchvision is not a dependency: install it separately (2.15 and 0.29 were used), and run this once.
"""

from pathlib import Path

import numpy as np


def main() -> None:
    """Write the file."""
    import torch  # pyright: ignore[reportMissingImports]
    from torchvision import ops  # pyright: ignore[reportMissingImports]

    rng = np.random.default_rng(0)
    # Tall boxes side by side in crowds, and boxes of any shape.
    crowd = np.concatenate([rng.uniform(0, 300, (80, 1)), rng.uniform(0, 20, (80, 1))], axis=1)
    tall = np.concatenate([crowd, crowd + np.stack([rng.uniform(8, 40, 80), rng.uniform(120, 150, 80)], axis=1)], axis=1)
    corner = rng.uniform(0, 200, (40, 2))
    boxes = np.concatenate([tall, np.concatenate([corner, corner + rng.uniform(5, 120, (40, 2))], axis=1)]).astype(np.float32)
    scores = rng.permutation(len(boxes)).astype(np.float32) / len(boxes)
    kept = {f"kept_{each}": np.zeros(len(boxes), bool) for each in (0.3, 0.5, 0.7)}
    for name, mask in kept.items():
        mask[ops.nms(torch.tensor(boxes), torch.tensor(scores), float(name[5:])).numpy()] = True

    features = rng.normal(size=(24, 40, 3)).astype(np.float32)
    corner = rng.uniform(-12, 280, (20, 2))
    regions = np.concatenate([corner, corner + rng.uniform(0.5, 160, (20, 2))], axis=1).astype(np.float32)
    planes = torch.tensor(features).permute(2, 0, 1)[None]
    rows = torch.cat([torch.zeros(20, 1), torch.tensor(regions)], dim=1)
    pooled = {
        f"pooled_{int(aligned)}": ops.roi_align(planes, rows, (5, 4), 1 / 8, 2, aligned).permute(0, 2, 3, 1).numpy()
        for aligned in (False, True)
    }
    path = Path(__file__).parent / "data" / "torchvision_boxes.npz"
    np.savez_compressed(path, boxes=boxes, scores=scores, features=features, regions=regions, **kept, **pooled)


if __name__ == "__main__":
    main()
