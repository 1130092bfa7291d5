"""Download a file with pooch and check its SHA-256; a failed download leaves no file."""

import hashlib
import logging
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pooch
import requests

from gsbench.errors import InputError, one_line
from gsbench.fetch.sources import Source

TIMEOUT = 30  # seconds without a byte


def download(source: Source, folder: Path) -> Path:
    """Download the file of a source into `folder` and return its path; an existing file is only checked.

    Proxies are those of the environment (HTTPS_PROXY, NO_PROXY). An interrupted download leaves no file and starts from
    the beginning next time.

    Raises:
        InputError: the server cannot be reached, does not have the file, closes the connection, or sends other bytes
            than expected.
    """
    url, path = source.address(), folder / source.file
    if path.is_file():
        check(path, source, "remove it and fetch again")
        return path
    pooch.get_logger().setLevel(logging.ERROR)

    def get(url: str, file: Any, caller: Any) -> None:
        pooch.HTTPDownloader(progressbar=True, timeout=TIMEOUT)(url, file, caller)
        check(Path(file), source, f"is {url} the right address?")

    try:
        pooch.retrieve(url, known_hash=None, fname=source.file, path=folder, downloader=get)
    except requests.exceptions.HTTPError as error:
        raise InputError(f"{source.name}: {one_line(error)}: {by_hand(source, path)}") from None
    except (requests.exceptions.ConnectTimeout, requests.exceptions.ConnectionError) as error:
        broken = "broke off" if "Read" in repr(error) else "cannot be reached (is this machine online?)"
        raise InputError(
            f"{source.name}: {urlsplit(url).netloc} {broken}; behind a proxy set HTTPS_PROXY; or "
            f"{by_hand(source, path)}",
            docs="data.md#fetching",
        ) from None
    except InputError:
        raise
    # ValueError: an invalid length or URL, perhaps of a redirection, which requests does not always wrap
    except (requests.exceptions.RequestException, ValueError) as error:
        raise InputError(
            f"{source.name}: {url} broke off or is no answer ({type(error).__name__}): try again, or "
            f"{by_hand(source, path)}"
        ) from None
    return path


def by_hand(source: Source, path: Path) -> str:
    """Return a text that says how to download the file by hand."""
    return f"take it from {source.url or source.published} by hand to {path} and repeat this"


def check(path: Path, source: Source, advice: str) -> None:
    """Raise InputError if the SHA-256 of a file does not begin with the expected digits."""
    digest = sha256_of(path)
    if source.sha256 and not digest.startswith(source.sha256):
        raise InputError(
            f"{source.name}: expected {source.file} with SHA-256 {source.sha256}.., got {digest[:8]}..: {advice}",
            docs="data.md#fetching",
        )


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
