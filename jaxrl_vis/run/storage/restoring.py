"""Restoring of one checkpoint: its manifest, structure and checksums are checked before anything of it is used.

Functions take ``read``, which maps orbax's arguments of items by name to the restored items, and raises `Unusable` if orbax
cannot read them.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.storage import sums
from jaxrl_vis.run.storage.arrays import check_structure, host_specs, is_intact, rebuild, restore_target, to_host
from jaxrl_vis.run.storage.manifest import SCHEMA, is_manifest
from jaxrl_vis.run.storage.recent import Unusable
from jaxrl_vis.types import LoopState, TrainState

Read = Callable[[dict[str, Any]], Any]


@dataclasses.dataclass(frozen=True)
class Restored:
    """Contents of a checkpoint.

    Attributes:
        tier: `LIGHT`, `FULL`, `RECENT` or `BEST`.
        iteration: Iterations completed.
        train: The learner, [S, ...].
        loop: The complete state; None if only the learner was restored, as from the light tier.
        progress: Progress that was saved with it.
    """

    tier: str
    iteration: int
    train: TrainState
    loop: LoopState | None
    progress: dict[str, Any]


def state_without_learner(loop: LoopState) -> dict[str, Any]:
    """Return the part of a loop state that full checkpoints have in addition to the learner."""
    return {"replay": loop.replay, "key": loop.key, "iteration": loop.iteration}


@contextlib.contextmanager
def _damage_first(where: Path) -> Iterator[None]:
    """Raise Unusable instead of a RequestError if files of the checkpoint have changed: damage is not another version."""
    try:
        yield
    except RequestError:
        changes = None
        with contextlib.suppress(OSError):
            changes = sums.compare_sums(where)
        if changes:
            raise Unusable(changes[0]) from None
        raise


def read_manifest(read: Read, where: Path) -> dict[str, Any]:
    """Read the manifest of the checkpoint at ``where``.

    Raises:
        Unusable: It is damaged.
        RequestError: It is of another schema.
    """
    import orbax.checkpoint as ocp

    manifest = read({"manifest": ocp.args.JsonRestore()})["manifest"]
    if not is_manifest(manifest):
        raise Unusable("its manifest is incomplete")
    with _damage_first(where):
        if manifest["schema"] != SCHEMA:
            raise RequestError(f"{where} is of schema {manifest['schema']}, not {SCHEMA}: use the version that wrote it")
    return manifest


def restore_items(
    read: Read, where: Path, manifest: dict[str, Any], template: LoopState, with_replay: bool
) -> tuple[TrainState, LoopState | None]:
    """Restore the checkpoint at ``where``; return the learner, and the complete state or None.

    Args:
        read: See the module.
        where: Folder of the checkpoint.
        manifest: Its manifest.
        template: Shapes and dtypes of the loop state.
        with_replay: Whether to restore the replay, keys and iteration, too; otherwise the second result is None.

    Raises:
        Unusable: It is damaged.
        RequestError: It has another structure.
    """
    import orbax.checkpoint as ocp

    templates = {"train": template.train} | ({"rest": state_without_learner(template)} if with_replay else {})
    specs = {name: host_specs(tree) for name, tree in templates.items()}
    for name, spec in specs.items():
        with _damage_first(where):
            check_structure(where, manifest["items"].get(name, {}), spec)
        specs[name] = {leaf: restore_target(manifest["items"][name][leaf][0], expected) for leaf, expected in spec.items()}
    items = read({name: ocp.args.StandardRestore(spec) for name, spec in specs.items()})
    trees = {}
    for name, tree in templates.items():
        for leaf_name, array in to_host(items[name], copy=False).items():
            if not is_intact(array, manifest["items"][name][leaf_name]):
                raise Unusable(f"wrong checksum of {leaf_name}")
        trees[name] = rebuild(tree, items[name])
    return trees["train"], LoopState(train=trees["train"], **trees["rest"]) if with_replay else None
