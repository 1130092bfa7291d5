"""List the data sets and weights that can be downloaded, with URL, SHA-256 and folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from omegaconf import OmegaConf

from gsbench.config import CONF
from gsbench.errors import InputError

MIRROR = "GSBENCH_MIRROR"  # an address; every file is then fetched from it, by the name in `Source.file`


@dataclass(frozen=True)
class Source:
    """A published data set or weight file: its URL, its SHA-256 and the folder into which it is downloaded."""

    name: str
    what: str
    file: str  # the file name on a mirror, and on this machine during the download
    folder: Path  # the folder of the file; an archive is unpacked into it
    url: str | None  # None: only a browser can download it
    sha256: str | None = None  # its first digits; None if the authors publish none
    published: str = ""  # where, in words

    @property
    def is_archive(self) -> bool:
        """Return whether the file is a zip archive, which is unpacked after the download."""
        return self.file.endswith(".zip")

    @property
    def target(self) -> Path:
        """Return the path that exists after the download: the file, or the folder of an unpacked archive."""
        return self.folder if self.is_archive else self.folder / self.file

    def address(self) -> str:
        """Return the URL of the download; it is on a mirror if an environment variable names one.

        Raises:
            InputError: only a browser can download the file, or the mirror's URL is invalid.
        """
        mirror = os.environ.get(MIRROR)
        if mirror:
            if not _is_address(mirror):
                raise InputError(f"{MIRROR}: expected an address such as https://host/folder, got {mirror!a:.200}")
            return f"{mirror.rstrip('/')}/{self.file}"
        if self.url is None:
            raise InputError(
                f"{self.name}: {self.what} has no address that a program can follow: download it in a "
                f"browser ({self.published}) and unpack it into {self.folder}, or set {MIRROR} to a "
                f"server that has {self.file}",
                docs="data.md#fetching",
            )
        return self.url


def sources(data: Path) -> dict[str, Source]:
    """Return all data sets and weights that can be downloaded, by name; data sets go to subfolders of `data`."""
    known = [
        Source(
            name="dnerf",
            what="D-NeRF, eight moving scenes",
            file="dnerf.zip",
            folder=data / "dnerf",
            url="https://www.dropbox.com/s/0bf6fl0ye2vz3vr/data.zip?dl=1",
            published=_published("dnerf"),
        ),
        Source(
            name="pbr",
            what="7DGS-PBR, six physically based scenes",
            file="pbr.zip",
            folder=data / "pbr",
            url=None,  # a folder of Google Drive
            published=_published("pbr"),
        ),
        _trunk("alex"),
        _trunk("vgg"),
    ]
    return {source.name: source for source in known}


def _is_address(text: str) -> bool:
    """Return whether a text is a valid http or https URL."""
    try:
        parts = urlsplit(text)
        (parts.hostname or "").encode("idna")  # raises ValueError, as `port` does
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0 and text.isprintable()
    except ValueError:
        return False


def _published(experiment: str) -> str:
    """Return the text in an experiment's config that says where its data are published."""
    return str(OmegaConf.load(CONF / "exp" / f"{experiment}.yaml").data.published)


def _trunk(backbone: str) -> Source:
    """Return the source of the AlexNet or VGG16 weights for LPIPS; their folder is torch's download folder."""
    import torch  # it takes two seconds to load

    from gsbench.measure.perceptual import BACKBONES

    chosen = BACKBONES[backbone]
    return Source(
        name=f"lpips-{backbone}",
        what=f"the trunk of LPIPS' {backbone} column, torchvision's ImageNet weights",
        file=chosen.file,
        folder=Path(torch.hub.get_dir()) / "checkpoints",
        url=f"https://download.pytorch.org/models/{chosen.file}",
        sha256=chosen.trunk_sha256[0],
    )
