"""Download data sets and LPIPS weights (`python -m gsbench.fetch dnerf|pbr|lpips-alex|lpips-vgg|--list`)."""

import argparse
import sys
from pathlib import Path

from gsbench.errors import InputError, did_you_mean, one_line, printable
from gsbench.fetch.sources import Source, sources
from gsbench.process.ending import end_with
from gsbench.reading import as_json


def main(arguments: list[str] | None = None) -> int:
    """Download the named data sets or weights one after the other.

    Return the exit code: 0, or 2 if a download failed. Each failure is printed as one line on stderr.
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.fetch", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="dnerf, pbr, lpips-alex or lpips-vgg")
    parser.add_argument("--list", action="store_true", help="print what can be fetched, and what is there")
    parser.add_argument("--json", action="store_true", help="print --list as JSON")
    parser.add_argument("--dry-run", action="store_true", help="print what would be fetched, from where and to where")
    parser.add_argument("--to", type=Path, default=Path("data"), metavar="FOLDER", help="of data sets (data)")
    options = parser.parse_args(arguments)
    if bool(options.names) == options.list or (options.list and options.dry_run):
        parser.error("expected a NAME, or --list, without NAME and --dry-run beside it")
    if options.json and not options.list:
        parser.error("--json: expected --list beside it")
    try:
        known = sources(folder_of(options.to))
    except InputError as error:
        print(f"gsbench.fetch: {one_line(error)}", file=sys.stderr)
        return 2
    if options.json:
        listed = [
            {"name": source.name, "what": source.what, "target": source.target, "there": source.target.exists()}
            for source in known.values()
        ]
        print(as_json(listed))
        return 0
    if options.list:
        for source in known.values():
            where = "is in" if source.target.exists() else "goes to"
            print(printable(f"{source.name:<11} {source.what}; {where} {source.target}"))
        return 0
    status = 0
    for name in options.names:
        try:
            if name not in known:
                raise InputError(f"'{name}' is not known. {did_you_mean(name, known)}")
            print(printable(plan_of(known[name]) if options.dry_run else fetch(known[name])))
        except (InputError, OSError) as error:
            print(f"gsbench.fetch: {one_line(error)}", file=sys.stderr)
            status = 2
    return status


def folder_of(path: Path) -> Path:
    """Return the folder that the user named, with `~` expanded.

    Raises:
        InputError: the text is not a valid folder name.
    """
    try:
        if "\0" not in str(path) and not path.expanduser().is_file():
            return path.expanduser()
    except RuntimeError:  # `~` of an unknown user
        pass
    raise InputError(f"--to: expected a folder, got {str(path)!a:.200}")


def plan_of(source: Source) -> str:
    """Return what `--dry-run` prints for one download: the URL, the folder and the expected SHA-256."""
    if source.target.exists():
        return f"{source.name}: {source.target} is there: nothing would be fetched"
    checked = f"its SHA-256 must begin with {source.sha256}" if source.sha256 else "no SHA-256 of it is published"
    return f"{source.name}: {source.address()} -> {source.target}; {checked}"


def fetch(source: Source) -> str:
    """Download one data set or weight file, and return a line that says where it is.

    Raises:
        InputError: the download fails, or the file does not have the expected SHA-256.
    """
    from gsbench.fetch.download import download, sha256_of
    from gsbench.fetch.unpack import scenes_in, unpack

    there = source.target.exists()
    if not source.is_archive:
        path = download(source, source.folder)
        return f"{source.name}: {path} {'is there: nothing fetched' if there else 'fetched'}"
    if there and any(source.target.iterdir()):
        present = scenes_in(source.target)
        if not present:
            raise InputError(f"{source.name}: {source.target} is there, but {scenes({})}: remove it and fetch again")
        return f"{source.name}: {source.target} is there: nothing fetched; {scenes(present)}"
    archive = download(source, source.folder.parent)
    digest = sha256_of(archive)
    try:
        unpack(archive, source.folder)
    finally:
        archive.unlink()  # a damaged archive would block the next attempt
    return (
        f"{source.name}: unpacked into {source.folder}; SHA-256 of the archive, to compare with others: {digest}; "
        f"{scenes(scenes_in(source.folder))}"
    )


def scenes(folders: dict[Path, list[str]]) -> str:
    """Return a text that lists the folders of downloaded scenes, as values of `data.root`, with their scene names."""
    if not folders:
        return "no scene with a transforms_train.json is in it"
    return printable("; ".join(f"data.root={root} has {', '.join(names)}" for root, names in folders.items()))


if __name__ == "__main__":
    end_with("gsbench.fetch", main)
