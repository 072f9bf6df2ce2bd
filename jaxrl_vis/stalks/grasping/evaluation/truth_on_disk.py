"""True masks from the ground truth that `grasp synth` writes beside its images, instead of a network's."""

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.grasping.masks.examples import true_mask
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image
from jaxrl_vis_envs.documents import read_json


def find_truth(image: np.ndarray | None, plot: PlotFolder, pair: PairFiles) -> np.ndarray:
    """Return the true mask [H, W] bool of the left image of a pair of a synthetic run; ``image`` is ignored.

    Raises:
        RequestError: The run is not synthetic, or holds no masks of this image.
    """
    try:
        count = int(read_json(plot.folder / "plot.json")["count"])
        truth = plot.folder / "truth" / f"instance_{pair.name}.png"
        if pair.left is None or image_size(truth) != image_size(pair.left):
            raise ValueError("masks of another image")
        instance = read_image(truth).astype(int) - 1
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise RequestError(
            f"{plot.folder} holds no true masks: write it with `jaxrl-vis grasp synth`, or use --masks segmentation"
        ) from error
    return true_mask(instance, count)
