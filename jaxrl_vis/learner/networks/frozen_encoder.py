"""Files of frozen image encoders: parameters of `modules.Encoder`, and the normalisation of the images.

shape     [3] int64: C, H, W of the images
mean      [C, H, W] float32
scale     [C, H, W] float32, 1 / standard deviation
kernel_0, bias_0, ..., latent/kernel, latent/bias     float32
"""

import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks.blocks import to_blocks
from jaxrl_vis.learner.networks.modules import Encoder
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.types import Params

_LIMIT = 5.0  # clipping bound of normalised values, the default of ``normalizer_clip``


def save(path: Path | str, encoder: Params, scaling: Scaling) -> None:
    """Write an encoder to a file: parameters of `modules.Encoder`, and the scaling of its images [C, H, W].

    ``.npz`` is appended to the name unless it ends in it (`numpy.savez`).
    """
    arrays = {name: leaf for name, leaf in encoder.items() if name != "latent"}
    arrays |= {f"latent/{name}": leaf for name, leaf in encoder["latent"].items()}
    np.savez(path, shape=np.array(scaling.mean.shape), mean=scaling.mean, scale=scaling.scale, **jax.device_get(arrays))


def load(path: Path | str) -> Callable[[jax.Array], jax.Array]:
    """Read an encoder from a file; return the function images [B, C, H, W] uint8 -> vectors [B, L] float32.

    Raises:
        RequestError: The file is missing or not an encoder; or, when the encoder is called, images have another shape.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name], np.float32) for name in file.files}
        shape = tuple(int(size) for size in arrays.pop("shape"))
        mean, scale = arrays.pop("mean"), arrays.pop("scale")
        latent = {name: arrays.pop(f"latent/{name}") for name in ("kernel", "bias")}
        filters = [arrays[f"bias_{level}"].shape[0] for level in range(len(arrays) // 2)]
        encoder = Encoder(filters, latent["bias"].shape[0], jnp.float32)
        params = {"params": {**arrays, "latent": latent}}
        blocks = jax.ShapeDtypeStruct((1, *shape), jnp.float32)
        jax.eval_shape(lambda images: encoder.apply(params, to_blocks(images, len(filters))), blocks)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise RequestError(
            f"{path} is not an encoder that jaxrl-vis encoder wrote: {' '.join(str(error).split())[:120]}"
        ) from error
    except Exception as error:  # flax raises its own exceptions for parameters of the wrong shape
        raise RequestError(f"{path} is not an encoder: its arrays do not fit together") from error

    def encode(images: jax.Array) -> jax.Array:
        if images.shape[1:] != shape:
            raise RequestError(f"{path} encodes images of {shape}, and these are of {images.shape[1:]}: train one for them")
        normalized = jnp.clip((images.astype(jnp.float32) - mean) * scale, -_LIMIT, _LIMIT)
        return jnp.asarray(encoder.apply(params, to_blocks(normalized, len(filters))))

    return encode
