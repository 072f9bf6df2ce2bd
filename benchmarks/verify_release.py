"""Verification of a release: two builds must be equal byte for byte, and pass a smoke test in an empty environment.

    python -m benchmarks.verify_release [--out dist] [--python python3.12] [--skip-install]

1. Export the last commit twice, into folders of different names, and build wheel and sdist of each. All times in them are that
   of the commit (SOURCE_DATE_EPOCH), so that every build of the commit gives the same bytes.
2. Compare both; differences are reported file by file.
3. Install the wheel into an empty environment, with packages from the registry that pip is configured for, and run the commands
   of a new user. Write the bill of materials (CycloneDX, JSON) of that environment: `sbom.cdx.json`.
4. Leave wheel, sdist, bill and SHA256SUMS in the folder ``--out``.

Exits with 1 on any failure. Takes about four minutes on two idle cores.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.install_smoke_test import CHECKOUT, Shell, new_shell

BILL, SUMS = "sbom.cdx.json", "SHA256SUMS"
_OURS = "jaxrl-vis"
SMOKE = (
    ("jaxrl-vis doctor", "all is well"),
    ("jaxrl-vis train VisualReacher --preset debug --env-steps 400 --run-dir runs/smoke", "success at the end"),
    ("jaxrl-vis dataset runs/smoke --format npz --out episodes.npz --episodes 2", "2 episodes of 50 steps"),
    ("jaxrl-vis push runs/smoke --to policy", "policy"),
    ("python -c \"import jaxrl_vis; print(jaxrl_vis.load_policy('policy').env_name)\"", "VisualReacher"),
    ("jaxrl-vis play fetch --episodes 1", "fetch/play.gif"),
    ("python ten_lines.py", "['depth', 'edges'] True"),
)
"""Commands of the smoke test, and the text that the output of each must contain; ten_lines.py is the first example of
docs/weighting.md."""


def commit_time(checkout: Path) -> int:
    """Return the time of the last commit, s since 1970."""
    command = ["git", "-C", str(checkout), "log", "-1", "--format=%ct"]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def export(checkout: Path, folder: Path) -> None:
    """Write the files of the last commit into a new folder, so that a release has committed files only.

    Raises:
        FileExistsError: The folder exists.
        subprocess.CalledProcessError: git failed.
    """
    folder.mkdir(parents=True)
    archive = folder.with_suffix(".tar")
    subprocess.run(["git", "-C", str(checkout), "archive", "--output", str(archive), "HEAD"], check=True)
    with tarfile.open(archive) as files:
        files.extractall(folder, filter="data")
    archive.unlink()


def build(source: Path, out: Path, seconds: int) -> list[Path]:
    """Build wheel and sdist of a folder of sources; return the files, sorted by name.

    Args:
        source: The sources.
        out: Folder of the files.
        seconds: Modification time of all their members, s since 1970.

    Raises:
        RuntimeError: The build failed; the message contains its output.
    """
    command = [sys.executable, "-m", "build", "--wheel", "--sdist", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, env=os.environ | {"SOURCE_DATE_EPOCH": str(seconds)}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the build failed:\n{done.stdout}{done.stderr}")
    return sorted(path for path in out.iterdir() if path.suffix in (".whl", ".gz"))


def members(archive: Path) -> dict[str, tuple[Any, ...]]:
    """Return size (bytes), modification time, mode and SHA-256 digest of each file in a wheel or an sdist, by name."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as files:
            return {
                item.filename: (item.file_size, item.date_time, item.external_attr, _digest(files.read(item)))
                for item in files.infolist()
            }
    with tarfile.open(archive) as files:
        contents = {}
        for item in files.getmembers():
            reader = files.extractfile(item)
            contents[item.name] = (item.size, item.mtime, item.mode, _digest(reader.read() if reader else b""))
        return contents


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def differences(first: Path, second: Path) -> Iterator[str]:
    """Yield a line for each difference of two archives; none if they are equal byte for byte."""
    if first.read_bytes() == second.read_bytes():
        return
    one, other = members(first), members(second)
    changed = [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]
    for name in changed:
        yield f"{first.name}: {name} is {one.get(name, 'missing')} and {other.get(name, 'missing')}"
    if not changed:
        yield f"{first.name}: the same files, packed otherwise"


def bill_of_materials(python: Path, checkout: Path, path: Path) -> None:
    """Write the bill of materials (CycloneDX, JSON) of an environment, without local paths, pip, setuptools and this package.

    Args:
        python: The environment's interpreter.
        checkout: Checkout with pyproject.toml, which describes the root component.
        path: The file.

    Raises:
        subprocess.CalledProcessError: ``cyclonedx_py`` failed or is not installed.
    """
    command = [sys.executable, "-m", "cyclonedx_py", "environment", str(python)]
    command += ["--pyproject", str(checkout / "pyproject.toml"), "--output-reproducible"]
    command += ["--output-format", "JSON", "--output-file", str(path)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    bill = json.loads(path.read_text())
    # Omit pip, which comes with the environment, and the released package, which is the root component.
    root, left_out = bill["metadata"]["component"], {"pip", "setuptools", _OURS}
    refs = {part["bom-ref"]: part["name"] for part in bill["components"]}
    bill["components"] = [part for part in bill["components"] if part["name"] not in left_out]
    bill["dependencies"] = [part for part in bill["dependencies"] if refs.get(part["ref"]) not in left_out]
    for component in [root, *bill["components"]]:
        links = [link for link in component.get("externalReferences", []) if not link["url"].startswith("file:")]
        component["externalReferences"] = links
    path.write_text(json.dumps(bill, indent=1) + "\n")


def first_example(page: Path) -> str:
    """Return the first Python block of a Markdown page, without its fences; "" if it has none."""
    return page.read_text().partition("```python\n")[2].partition("```")[0]


def smoke_test(shell: Shell, wheel: Path) -> None:
    """Install a wheel into a new environment, and run the commands of `SMOKE`; failures are added to ``shell.failures``."""
    (shell.folder / "ten_lines.py").write_text(first_example(CHECKOUT / "docs" / "weighting.md"))
    shell.run("python3 -m venv venv")
    shell.activate(shell.folder / "venv")
    shell.run(f"pip install --quiet {wheel}")
    for words, shows in SMOKE:
        shell.run(words, shows=shows)


def main() -> int:
    """Build, compare and test a release; return 1 if anything differs or fails, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=CHECKOUT / "dist", help="folder of the release")
    parser.add_argument("--python", default=sys.executable, help="interpreter of the empty environment")
    parser.add_argument("--skip-install", action="store_true", help="compare the builds alone: no network is needed")
    options = parser.parse_args()
    python = shutil.which(options.python)
    if python is None:
        parser.error(f"there is no {options.python}")
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder, seconds, builds = Path(temporary), commit_time(CHECKOUT), []
        for name in ("one", "another"):
            export(CHECKOUT, folder / name)
            builds.append(build(folder / name, folder / f"{name}-dist", seconds))
        for first, second in zip(*builds, strict=True):
            differing = list(differences(first, second))
            failures += differing
            print(
                "\n".join(differing) if differing else f"equal byte for byte: {first.name} {_digest(first.read_bytes())}",
                flush=True,
            )
        options.out.mkdir(parents=True, exist_ok=True)
        released = [Path(shutil.copy(path, options.out)) for path in builds[0]]
        if not options.skip_install:
            wheel = next(path for path in released if path.suffix == ".whl")
            shell = new_shell(folder / "newcomer", Path(python))
            smoke_test(shell, wheel.resolve())
            failures += shell.failures
            bill_of_materials(shell.folder / "venv" / "bin" / "python", folder / "one", options.out / BILL)
            released.append(options.out / BILL)
            print(f"{BILL}: {len(json.loads((options.out / BILL).read_text())['components'])} packages")
    lines = [f"{_digest(path.read_bytes())}  {path.name}\n" for path in sorted(released)]
    (options.out / SUMS).write_text("".join(lines))
    print(f"{'FAILED: ' + '; '.join(failures) if failures else 'verified'}: {options.out}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
