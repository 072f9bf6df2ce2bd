"""Files that are written atomically, and JSON that other programs have written."""

import json
import os
import stat
import threading

import pytest

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import files
from jaxrl_vis.host.files import check_path, is_temporary, read_json, read_private, replacing, write_atomically

DEEP = 10**5


@pytest.mark.parametrize(
    ("contents", "part"),
    [
        (b"{", "is not JSON"),
        (b'{"a": "\xff"}', "is not UTF-8 text"),
        (b"[" * DEEP, "levels deep"),
        (b'{"a":' * 500 + b"1" + b"}" * 500, "levels deep"),
        (b'{"a": ' + b"9" * 5000 + b"}", "is not JSON"),
        (b"[]", "must hold a table, not list"),
    ],
)
def test_json_that_cannot_be_used_is_one_line(tmp_path, contents, part):
    path = tmp_path / "config.json"
    path.write_bytes(contents)
    with pytest.raises(RequestError, match=part) as refused:
        read_json(path, hint="put it back")
    assert str(path) in str(refused.value) and str(refused.value).endswith(": put it back")
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 400


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "missing"])
def test_names_that_no_system_knows_are_one_line(tmp_path, name):
    with pytest.raises(RequestError, match="cannot"):
        read_json(tmp_path / name)
    if name != "missing":
        with pytest.raises(RequestError, match="cannot be used") as refused:
            check_path(tmp_path / name)
        assert len(str(refused.value)) < 250 and "\0" not in str(refused.value)


def test_writers_side_by_side_do_not_disturb_each_other(tmp_path):
    """Each writer has a temporary file of its own: in a shared one, they would overwrite each other's contents."""
    path = tmp_path / "file.json"
    with replacing(path) as first:
        first.write(b'{"by": "first"}')
        write_atomically(path, '{"by": "second"}')
    assert json.loads(path.read_text()) == {"by": "first"}
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.json"]
    texts = [json.dumps([number] * 1000) for number in range(8)]
    threads = [threading.Thread(target=write_atomically, args=(path, text)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_text() in texts and len(list(tmp_path.iterdir())) == 1


def test_what_fails_leaves_the_old_contents_and_nothing_else(tmp_path):
    path = tmp_path / "file"
    write_atomically(path, "old")
    with pytest.raises(OSError, match="full"), replacing(path) as file:
        file.write(b"new")
        assert [is_temporary(entry.name) for entry in tmp_path.iterdir() if entry != path] == [True]
        raise OSError("full")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_contents_and_name_reach_the_disk(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync

    def remember(descriptor):
        synced.append(stat.S_ISDIR(os.fstat(descriptor).st_mode))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", remember)
    write_atomically(tmp_path / "file", "text")
    assert synced == [False, True]


def test_what_a_link_points_to_is_replaced(tmp_path):
    (tmp_path / "scratch").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "scratch" / "file")
    write_atomically(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "scratch" / "file").read_text() == "text"


@pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX")
def test_only_files_of_the_user_are_private(tmp_path, monkeypatch):
    path = tmp_path / "file"
    with replacing(path, mode=0o600) as file:
        file.write(b"mine")
    assert read_private(path) == b"mine" and stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o622)
    assert read_private(path) is None
    path.chmod(0o600)
    (tmp_path / "link").symlink_to(path)
    assert read_private(tmp_path / "link") is None and read_private(tmp_path / "missing") is None
    owner = path.stat().st_uid
    monkeypatch.setattr(files.os, "geteuid", lambda: owner + 4000)
    assert (read_private(path) is None) == (owner != 0)  # root's are believed
