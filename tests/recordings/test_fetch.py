"""Files come from the nearest place that has them, and never unchecked."""

import gzip
import hashlib
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from torchrl_athletic.recordings import FetchError, fetch
from torchrl_athletic.recordings.fetch import SOURCES, RemoteFile, Source

COMMIT = "0123456789" * 4
CONTENT = {"data/a.csv": b"time,position\n0,1\n", "data/b.csv": b"time\n1\n", "c.bin": bytes(range(256))}
NAMES = {"data/a.csv": "day/a.csv.gz", "data/b.csv": "b.csv", "c.bin": "c.bin"}


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """A data set of three files in a repository on this machine; yields (base URL, requested paths)."""
    files = tuple(
        RemoteFile(NAMES[path], path, COMMIT, hashlib.sha256(content).hexdigest()) for path, content in CONTENT.items()
    )
    module = sys.modules["torchrl_athletic.recordings.fetch"]
    monkeypatch.setattr(module, "SOURCES", {"bench": Source("somebody/bench", "MIT", files)})
    monkeypatch.delenv("ATHLETIC_DATA", raising=False)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    root = tmp_path / "served"
    for path, content in CONTENT.items():
        served = root / "somebody/bench" / COMMIT / path
        served.parent.mkdir(parents=True, exist_ok=True)
        served.write_bytes(content)
    asked = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *arguments):
            asked.append(self.path)

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=root))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", asked, root / "somebody/bench" / COMMIT
    server.shutdown()
    server.server_close()


def test_downloads_once_checks_and_compresses(bench, tmp_path):
    url, asked, _ = bench
    folder = fetch("bench", cache=tmp_path / "cache", base_url=url)
    assert folder == tmp_path / "cache" / "bench"
    assert gzip.decompress((folder / "day/a.csv.gz").read_bytes()) == CONTENT["data/a.csv"]
    assert (folder / "b.csv").read_bytes() == CONTENT["data/b.csv"]
    assert (folder / "c.bin").read_bytes() == CONTENT["c.bin"]
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == ["a.csv.gz", "b.csv", "c.bin"]
    assert len(asked) == 3
    fetch("bench", cache=tmp_path / "cache", base_url=url)
    assert len(asked) == 3


def test_only_the_missing_file_is_downloaded(bench, tmp_path):
    url, asked, _ = bench
    folder = fetch("bench", cache=tmp_path, base_url=url)
    (folder / "b.csv").unlink()
    fetch("bench", cache=tmp_path, base_url=url)
    assert asked[3:] == [f"/somebody/bench/{COMMIT}/data/b.csv"]
    assert (folder / "b.csv").read_bytes() == CONTENT["data/b.csv"]


def test_a_local_folder_comes_first_if_it_is_complete(bench, tmp_path, monkeypatch):
    url, asked, _ = bench
    local = tmp_path / "mine" / "bench"
    monkeypatch.setenv("ATHLETIC_DATA", str(local.parent))
    for name in NAMES.values():
        (local / name).parent.mkdir(parents=True, exist_ok=True)
        (local / name).write_bytes(b"mine")
    assert fetch("bench", cache=tmp_path, base_url=url) == local
    assert asked == []
    (local / "b.csv").unlink()
    assert fetch("bench", cache=tmp_path, base_url=url) == tmp_path / "bench"


def test_the_cache_is_the_users(bench, tmp_path, monkeypatch):
    url, _, _ = bench
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert fetch("bench", base_url=url) == tmp_path / "xdg" / "torchrl_athletic" / "bench"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert fetch("bench", base_url=url) == tmp_path / "home" / ".cache" / "torchrl_athletic" / "bench"


def test_a_changed_file_is_not_stored_and_the_message_says_where_to_put_the_right_one(bench, tmp_path):
    url, _, served = bench
    (served / "data/b.csv").write_bytes(b"time\n2\n")
    with pytest.raises(FetchError, match="pinned is") as refused:
        fetch("bench", cache=tmp_path / "cache", base_url=url)
    assert hashlib.sha256(b"time\n2\n").hexdigest() in str(refused.value)
    assert str(tmp_path / "cache" / "bench" / "b.csv") in str(refused.value)
    assert not (tmp_path / "cache" / "bench" / "b.csv").exists()
    assert not list((tmp_path / "cache").rglob("*.part"))


def test_a_missing_file_and_a_missing_network_say_what_to_do(bench, tmp_path):
    url, _, served = bench
    (served / "data/a.csv").unlink()
    with pytest.raises(FetchError, match=r"404.*day/a\.csv\.gz by hand \(compressed with gzip\), or set ATHLETIC_DATA"):
        fetch("bench", cache=tmp_path, base_url=url)
    with pytest.raises(FetchError, match="Is there a network"):
        fetch("bench", cache=tmp_path, base_url="http://127.0.0.1:9")  # nothing listens on 'discard'


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="Known are emps, two_link_arm, pendulum, xl330_bench, unbalanced_disk"):
        fetch("imaginary")


def test_every_file_is_pinned_and_stays_in_its_folder():
    for source in SOURCES.values():
        assert len({file.name for file in source.files}) == len(source.files)
        for file in source.files:
            assert len(bytes.fromhex(file.commit)) == 20
            assert len(bytes.fromhex(file.sha256)) == 32
            assert not Path(file.name).is_absolute()
            assert ".." not in Path(file.name).parts


@pytest.mark.parametrize("name", list(SOURCES))
def test_the_pinned_hashes_are_those_of_the_real_files(name, real_recordings):
    for file in SOURCES[name].files:
        content = (real_recordings / name / file.name).read_bytes()
        if file.name.endswith(".gz") and not file.path.endswith(".gz"):
            content = gzip.decompress(content)
        assert hashlib.sha256(content).hexdigest() == file.sha256, file.name
    assert fetch(name) == real_recordings / name
