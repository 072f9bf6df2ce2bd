"""Nearly full and frozen disks: small file systems, which only root can mount."""

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path


def _run(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True).returncode == 0
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def _run_folder_on_disk(folder: Path, disk: Path, mounted: bool) -> Iterator[Path]:
    """Copy the run folder to another disk, then back, and unmount; yield ``folder`` itself if nothing is mounted."""
    there = disk / "run"
    try:
        if not mounted:
            yield folder
            return
        if folder.exists():
            shutil.copytree(folder, there)
        yield there
        if folder.exists():
            shutil.rmtree(folder)
        if there.exists():
            shutil.copytree(there, folder)
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        disk.rmdir()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[tuple[Path, Callable[[], bool]]]:
    """Mount a small disk.

    Yields:
        The run folder on it, and a function that fills the remaining space; it returns False if no disk could be mounted.
    """
    used = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    disk = folder.with_name(f"{folder.name}-disk")
    disk.mkdir()
    mounted = _run("mount", "-t", "tmpfs", "-o", f"size={used // 1024 + 16_000}k", "tmpfs", str(disk))

    def fill() -> bool:
        if not mounted:
            return False
        with contextlib.suppress(OSError), (disk / "other").open("ab", buffering=0) as file:
            for size in (2**20, 2**12, 1):
                with contextlib.suppress(OSError):
                    while file.write(bytes(size)) == size:
                        pass
        return True

    with _run_folder_on_disk(folder, disk, mounted) as there:
        yield there, fill


@contextlib.contextmanager
def freezing_disk(folder: Path) -> Iterator[tuple[Path, Callable[[bool], bool]]]:
    """Mount a file system that can be frozen.

    Yields:
        The run folder on it, and a function that freezes (True) or thaws (False) it; it returns False if that is impossible.
    """
    disk, image = folder.with_name(f"{folder.name}-ice"), folder.with_name(f"{folder.name}-ice.img")
    disk.mkdir()
    with image.open("wb") as file:
        file.truncate(128 * 2**20)
    mounted = _run("mkfs.ext4", "-q", str(image)) and _run("mount", "-o", "loop", str(image), str(disk))
    is_frozen = False

    def freeze(frozen: bool) -> bool:
        nonlocal is_frozen
        if not mounted or not _run("fsfreeze", "-f" if frozen else "-u", str(disk)):
            return False
        is_frozen = frozen
        return True

    with _run_folder_on_disk(folder, disk, mounted) as there:
        try:
            yield there, freeze
        finally:
            if is_frozen:
                freeze(False)
    image.unlink()
