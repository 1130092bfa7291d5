"""Fetching from a server on this machine: what arrives is whole and as it should be, or nothing is left."""

import hashlib
import io
import json
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote

import pooch
import pytest

from gsbench.errors import InputError
from gsbench.fetch.__main__ import fetch, main
from gsbench.fetch.download import download
from gsbench.fetch.sources import Source

PAYLOAD = bytes(range(256)) * 4000  # a megabyte, many chunks


def zipped(files: dict[str, bytes], mode: int = 0o100644, method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of files, whose names are written as they are."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in files.items():
            member = zipfile.ZipInfo("x")
            member.filename, member.external_attr, member.compress_type = name, mode << 16, method
            archive.writestr(member, content)
    return buffer.getvalue()


SCENES = {"data/trex/transforms_train.json": b"{}", "data/lego/transforms_train.json": b"{}", "data/a.txt": b"a"}
GOOD = zipped(SCENES)


class Handler(BaseHTTPRequestHandler):
    """Serves files, and every fault by its address."""

    files: dict[str, bytes]
    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        _, fault, rest = (*self.path.split("/", 2), "")[:3]
        if fault == "raw":  # as a server that is none would
            self.wfile.write(unquote(rest).encode())
            return
        if fault == "moved":
            self.send_response(302)
            self.send_header("Location", unquote(rest))
            self.end_headers()
            return
        name = self.path.rpartition("/")[2]
        if name not in self.files:
            self.send_error(404)
            return
        content = self.files[name]
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) // 2] if "/cut/" in self.path else content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[ThreadingHTTPServer]:
    Handler.files, Handler.asked = {"file.bin": PAYLOAD, "dnerf.zip": GOOD}, []
    serving = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=serving.serve_forever, args=(0.02,))
    thread.start()
    yield serving
    serving.shutdown()
    thread.join()
    serving.server_close()


@pytest.fixture
def address(server: ThreadingHTTPServer) -> str:
    return f"http://127.0.0.1:{server.server_address[1]}"


def source(url: str, folder: Path, sha256: str | None = None) -> Source:
    return Source("file", "a file", "file.bin", folder, url, sha256)


def moved(to: str) -> str:
    return f"/moved/{quote(to, safe='')}"


def raw(answer: str) -> str:
    return f"/raw/{quote(answer, safe='')}"


@pytest.mark.parametrize("path", ["/file.bin", moved("/file.bin")])
def test_a_file_arrives_whole_and_once(path, address, tmp_path, monkeypatch):
    """Catches a redirect taken for the file, a file fetched twice, another file taken for it, and messages of pooch."""
    log = io.StringIO()
    monkeypatch.setattr(pooch.get_logger().handlers[0], "stream", log)
    weights = source(address + path, tmp_path, hashlib.sha256(PAYLOAD).hexdigest()[:8])
    assert fetch(weights) == f"file: {tmp_path}/file.bin fetched"
    assert fetch(weights) == f"file: {tmp_path}/file.bin is there: nothing fetched"
    assert Handler.asked.count(path) == 1
    assert log.getvalue() == ""
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [PAYLOAD]
    (tmp_path / "file.bin").write_bytes(b"another")
    with pytest.raises(InputError, match="remove it and fetch again"):
        fetch(weights)


NO_FILE: list[tuple[str, str | None, str]] = [  # an address, the SHA-256 that is expected, words of the error
    ("/cut/file.bin", None, "broke off"),
    ("/file.bin", "00000000", "expected file.bin with SHA-256 00000000"),
    ("/nothing.bin", None, "404"),
    (moved("/nothing.bin"), None, "404"),
    (raw("HTTP/1.1 200 x\r\nContent-Length: abc\r\n\r\nabc"), None, "is no answer"),
    (raw(f"HTTP/1.1 200 x\r\nContent-Length: {'9' * 5000}\r\n\r\nabc"), None, "is no answer"),
    (raw("HTTP/1.1 404 \x1b[31mx\r\n\r\n"), None, "404"),
    *((moved(to), None, "is no answer") for to in ("http://[::1", f"http://{'a' * 300}", "file:")),
]


@pytest.mark.parametrize(("path", "sha256", "message"), NO_FILE)
def test_what_is_not_the_file_is_not_kept(path, sha256, message, address, tmp_path):
    """Catches half a file, another file or a page of words in the place of weights."""
    with pytest.raises(InputError, match=message) as caught:
        download(source(address + path, tmp_path, sha256), tmp_path)
    assert str(caught.value).isprintable()
    assert [*tmp_path.iterdir()] == []


def test_a_proxy_of_the_environment_is_asked(address, tmp_path, monkeypatch):
    """Catches the stack trace of four libraries offline, and a download past the only way out of a cluster."""
    with pytest.raises(InputError, match=r"is this machine online.*by hand"):
        download(source("http://127.0.0.1:9/file.bin", tmp_path), tmp_path)
    monkeypatch.setenv("http_proxy", address)
    monkeypatch.setenv("no_proxy", "")
    assert download(source("http://nowhere.invalid/file.bin", tmp_path), tmp_path).read_bytes() == PAYLOAD
    assert Handler.asked == ["http://nowhere.invalid/file.bin"]


def fetched(address: str, to: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setenv("GSBENCH_MIRROR", address)
    monkeypatch.setenv("TORCH_HOME", str(to / "torch"))
    return main([*words, "--to", str(to / "data")])


@pytest.mark.parametrize("mode", [0o100644, 0])
def test_an_archive_is_unpacked_and_its_scenes_named(mode, address, tmp_path, monkeypatch, capsys):
    """Catches data that lie where nobody is told, an archive that stays, and data that are fetched again. Also files
    without a kind, as Windows zips them, that count as devices, and data that are there and are missed."""
    Handler.files["dnerf.zip"] = zipped(SCENES, mode)
    for message, bar in (("unpacked into", "100%"), ("nothing fetched", "")):
        assert fetched(address, tmp_path, monkeypatch, "dnerf") == 0
        out, err = capsys.readouterr()
        assert message in out
        assert f"data.root={tmp_path}/data/dnerf/data has lego, trex" in out
        assert bar in err
    place = f"{tmp_path}/data/dnerf"
    assert fetched(address, tmp_path, monkeypatch, "dnerf", "--dry-run") == 0
    assert capsys.readouterr().out == f"dnerf: {place} is there: nothing would be fetched\n"
    assert fetched(address, tmp_path, monkeypatch, "--list") == 0
    assert capsys.readouterr().out.startswith(f"dnerf       D-NeRF, eight moving scenes; is in {place}\npbr ")
    assert (tmp_path / "data/dnerf/data/a.txt").read_bytes() == b"a"
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["dnerf"]
    assert Handler.asked == ["/dnerf.zip"]


@pytest.mark.parametrize(
    ("archive", "message"),
    [
        (zipped({"a/../../evil": b""}), "outside"),
        (zipped({"/tmp/evil": b""}), "outside"),
        (zipped({"a\\..\\..\\evil": b""}), "outside"),
        (zipped({"C:evil": b""}), "outside"),
        (zipped({"good": b"", "link": b"/etc/passwd"}, mode=0o120777), "link"),
        (b"<!DOCTYPE html>", "expected a zip"),
        (GOOD[:-30], "expected a zip"),
        (GOOD.replace(b"{}", b"[]", 1), "expected a zip"),  # its CRC is another one
        (zipped({"": b""}), "no name"),
        (zipped({"good": b"", ".": b""}), "no name"),
        (zipped({"\x1b[31m": b""}), r"\x1b[31m"),
        (zipped({"é": b""}).replace("é".encode(), b"\xff\xfe"), "expected a zip"),
        (zipped({"a/" * 20_000 + "b": b""}), "expected a zip"),
        (zipped({"a": bytes(100)}, method=zipfile.ZIP_LZMA).replace(b"\5\0]", b"\5\0\xff"), "expected a zip"),
    ],
)
def test_a_hostile_or_damaged_archive_is_refused(archive, message, address, tmp_path, monkeypatch, capsys):
    """Catches a file that is written beside the folder, and half a data set in it."""
    Handler.files["dnerf.zip"] = archive
    assert fetched(address, tmp_path, monkeypatch, "dnerf") == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench.fetch:")]
    assert message in line
    assert line.isprintable()
    assert [*(tmp_path / "data").iterdir()] == []
    assert not (tmp_path / "evil").exists()


def test_an_archive_without_scenes_says_so(address, tmp_path, monkeypatch, capsys):
    """Catches a line that ends in the middle where an archive has other files than it should, an empty folder that is
    taken for the data, and success without data."""
    Handler.files["dnerf.zip"] = zipped({"a.txt": b"a"})
    (tmp_path / "data/dnerf").mkdir(parents=True)  # as of a user who made the folder first
    assert fetched(address, tmp_path, monkeypatch, "dnerf") == 0
    assert capsys.readouterr().out.endswith("; no scene with a transforms_train.json is in it\n")
    assert fetched(address, tmp_path, monkeypatch, "dnerf") == 2
    error = f"dnerf: {tmp_path}/data/dnerf is there, but no scene with a transforms_train.json is in it: remove it"
    assert error in capsys.readouterr().err


def test_weights_go_where_they_are_looked_for(address, tmp_path, monkeypatch, capsys):
    """Catches other weights under the right name, and a place that gsbench.measure does not read."""
    from gsbench.measure import perceptual

    Handler.files["alexnet-owt-7be5be79.pth"] = PAYLOAD
    assert fetched(address, tmp_path, monkeypatch, "lpips-alex") == 2
    assert "SHA-256 7be5be79" in capsys.readouterr().err
    place = tmp_path / "torch/hub/checkpoints/alexnet-owt-7be5be79.pth"
    assert not place.exists()
    place.write_bytes(PAYLOAD)
    with pytest.raises(InputError, match="expected SHA-256"):  # so it is this file that is read
        perceptual.load.__wrapped__("alex")


def test_a_dry_run_fetches_nothing(address, tmp_path, monkeypatch, capsys):
    """Catches a dry run that is none, and a plan that does not say from where, to where and what is checked."""
    assert fetched(f"{address}/", tmp_path, monkeypatch, "dnerf", "lpips-vgg", "--dry-run") == 0
    plans = capsys.readouterr().out.splitlines()
    assert plans[0] == f"dnerf: {address}/dnerf.zip -> {tmp_path}/data/dnerf; no SHA-256 of it is published"
    assert plans[1].endswith("must begin with 397923af")
    assert Handler.asked == []
    assert [*tmp_path.iterdir()] == []
    assert fetched(address, tmp_path, monkeypatch, "--list") == 0
    assert len(capsys.readouterr().out.splitlines()) == 4
    assert fetched(address, tmp_path, monkeypatch, "--list", "--json") == 0
    listed = {row["name"]: (row["target"], row["there"]) for row in json.loads(capsys.readouterr().out)}
    assert len(listed) == 4
    assert listed["dnerf"] == (f"{tmp_path}/data/dnerf", False)


def test_what_a_mirror_lacks_is_fetched_by_hand(address, tmp_path, monkeypatch, capsys):
    """Catches advice that names no place where the file can be found, with an address that a program follows or not."""
    Handler.files = {}
    assert fetched(address, tmp_path, monkeypatch, "dnerf", "pbr") == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench.fetch")]
    assert errors == [
        f"gsbench.fetch: {name}: 404 Client Error: Not Found for url: {address}/{name}.zip: take it from {place} by "
        f"hand to {tmp_path}/data/{name}.zip and repeat this"
        for name, place in (
            ("dnerf", "https://www.dropbox.com/s/0bf6fl0ye2vz3vr/data.zip?dl=1"),
            ("pbr", "the Data link of gaozhongpai.github.io/7dgs"),
        )
    ]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        *(
            (words, "expected a NAME, or --list, without NAME and --dry-run beside it")
            for words in ([], ["--list", "dnerf"], ["--list", "--dry-run"])
        ),
        (["dnerf", "--json"], "--json: expected --list beside it"),
    ],
)
def test_a_command_without_sense_is_refused(words, error, capsys):
    """Catches a command that does nothing and ends as a success, and a usage that names no module."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    err = capsys.readouterr().err
    assert err.endswith(f"python -m gsbench.fetch: error: {error}\n")
    assert "[NAME ...]" in err


def test_what_cannot_be_fetched_is_told(tmp_path, monkeypatch, capsys):
    """Catches a name, a mirror or a folder that is typed wrong, and a folder of Google Drive taken for a file."""
    assert fetched("", tmp_path, monkeypatch, "pbr", "dnrf") == 2
    err = capsys.readouterr().err.splitlines()
    by_hand = f"download it in a browser (the Data link of gaozhongpai.github.io/7dgs) and unpack it into {tmp_path}"
    assert f"{by_hand}/data/pbr" in err[0]
    assert "server that has pbr.zip" in err[0]
    assert "Did you mean 'dnerf'" in err[1]
    for mirror in (
        "ftp://x",
        "http://[::1",
        f"http://{'a' * 300}",
        "http://a..b",
        "http://x:port",
        "http://",
        "\x1b[31m",
    ):
        for words in (["dnerf"], ["dnerf", "--dry-run"]):
            assert fetched(mirror, tmp_path, monkeypatch, *words) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert "GSBENCH_MIRROR" in line
            assert line.isprintable()
    (tmp_path / "file").touch()
    for to in ("a\0b", "~nobody.of.that.name/x", str(tmp_path / "file")):
        for words in (["dnerf"], ["--list"]):
            assert main([*words, "--to", to]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert "--to" in line
    monkeypatch.delenv("GSBENCH_MIRROR")
    assert main(["dnerf", "--dry-run", "--to", "a\nb"]) == 0
    assert "a\\nb/dnerf" in capsys.readouterr().out
