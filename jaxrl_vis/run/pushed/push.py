"""`push`: publication of a trained policy as a loadable folder, local or on a hub.

    README.md  see `card`        config.json, metrics.jsonl  of the run        policy.safetensors  see `policy_file`
    curve.png  video.gif         if the run has them

The folder is assembled completely before it is moved into place or uploaded.
"""

import json
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run.pushed.card import card, score
from jaxrl_vis.run.storage.folder import RunFolder, read_record
from jaxrl_vis.run.trained import policy_file
from jaxrl_vis.run.trained.policy import Policy, load_policy

HUB = "hub:"
_REPOSITORY = re.compile(r"[\w.-]{1,96}/[\w.-]{1,96}")


def check_target(to: str) -> None:
    """Check the target of a push before the work begins.

    Args:
        to: A folder that does not exist or is empty, or ``hub:user/name``.

    Raises:
        RequestError: The folder is not empty or cannot be written, the repository name is invalid, or huggingface_hub is
            missing.
    """
    if to.startswith(HUB):
        if not _REPOSITORY.fullmatch(to.removeprefix(HUB)):
            raise RequestError(f"--to {to}: a repository of the hub is named hub:user/name")
        try:
            import huggingface_hub  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise RequestError(f"--to {to} needs huggingface_hub: {install_command('hub')}, or name a folder") from error
        return
    folder = Path(to)
    check_writable(folder, "--to", folder=True)
    if folder.is_dir() and any(folder.iterdir()):
        raise RequestError(f"--to {to} is not empty: name a new folder")


def push(run_dir: Path | str, to: str, seed: int | None = None, trust: bool = False) -> str:
    """Push the policy of a run's newest valid checkpoint; return its folder or address.

    Args:
        run_dir: The run folder.
        to: See `check_target`.
        seed: Seed, for a run with several; None for the first.
        trust: As in `load_policy`.

    Raises:
        RequestError: There is no run, no usable checkpoint, or no such target; or the hub refuses.
        StorageError: The folder cannot be written.
    """
    check_target(to)
    policy = load_policy(run_dir, seed=seed, trust=trust)
    parent = None if to.startswith(HUB) else Path(to).absolute().parent
    try:
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".push-", dir=parent) as temporary:
            folder = Path(temporary) / "policy"
            folder.mkdir()
            assemble(Path(run_dir), policy, folder)
            if to.startswith(HUB):
                return _upload(folder, to.removeprefix(HUB))
            if Path(to).exists():
                Path(to).rmdir()
            shutil.move(folder, to)
    except OSError as error:
        raise StorageError(f"cannot write to {to} ({error.strerror or error}): nothing is left of it there") from error
    return to


def assemble(run_dir: Path, policy: Policy, folder: Path) -> None:
    """Write all files of a policy into an empty folder.

    Args:
        run_dir: The run that trained it.
        policy: The policy.
        folder: The folder.

    Raises:
        OSError: A file cannot be written.
    """
    run, config = RunFolder(run_dir), policy.config
    policy_file.write(folder, policy.parameters, policy_file.Source(policy.seed, policy.iteration))
    record = public_record(run_dir)
    write_atomically(folder / run.config.name, json.dumps(record, indent=2) + "\n")
    for file in (run.metrics, run.curve, run.video):
        if file.is_file():
            shutil.copyfile(file, folder / file.name)
    rows = {
        row["seed"]: row for row in run.rows() if row["iteration"] == policy.iteration and row.get("eval/success") is not None
    }
    scores = {seed: score(row, config.run.eval_episodes) for seed, row in rows.items()}
    captions = {
        "success and distance against environment steps": run.curve.name,
        "episodes, beside their goals": run.video.name,
    }
    pictures = {caption: name for caption, name in captions.items() if (folder / name).exists()}
    text = card(config, record, policy.seed, scores, policy.env.distance_unit, pictures)
    write_atomically(folder / "README.md", text)


def public_record(run_dir: Path) -> dict[str, Any]:
    """Return the contents of a run's config.json for publication, without the local folder of a custom task."""
    record = read_record(run_dir)
    environment = {**record["config"].get("environment", {}), "env_folder": None}
    return {**record, "config": {**record["config"], "environment": environment}}


def _upload(folder: Path, repository: str) -> str:
    """Upload a folder to the hub as a model, and return its address, ``hub:user/name``.

    Raises:
        RequestError: The hub refuses, or cannot be reached.
    """
    from huggingface_hub import HfApi  # pyright: ignore[reportMissingImports]

    try:
        api = HfApi()
        api.create_repo(repository, repo_type="model", exist_ok=True)
        api.upload_folder(repo_id=repository, repo_type="model", folder_path=str(folder), commit_message="Push a policy")
    except Exception as error:  # errors of the client, of requests, or of the network
        cause = " ".join(str(error).split())[:300]
        raise RequestError(
            f"the hub has not taken {repository} ({type(error).__name__}: {cause}): `hf auth login` once, or push to a folder"
        ) from error
    return f"{HUB}{repository}"
