"""The memory that control groups leave to a process, read from trees of files as Linux writes them."""

from pathlib import Path

import pytest

from gsbench.process import memory


def tree(root: Path, groups: str, files: dict[str, str]) -> Path:
    """Write a tree with proc/self and the files of control groups: `max`, `current` and `stat` are memory.max .."""
    texts = {"proc/self/cgroup": groups}
    for name, text in files.items():
        folder, _, last = name.rpartition("/")
        texts[f"sys/fs/cgroup/{folder}/memory.{last}"] = text
    for name, text in texts.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def limited(limit: int, current: int, stat: str = "", folder: str = "") -> dict[str, str]:
    """The files of a group of version 2."""
    return {f"{folder}/max": f"{limit}\n", f"{folder}/current": f"{current}\n", f"{folder}/stat": stat}


@pytest.mark.parametrize(
    ("groups", "files", "left"),
    [
        # A batch job, whose limit is not read where that of the root is not set.
        (
            "0::/slurm/job 7\n",
            {"slurm/max": "max\n", "slurm/current": "9\n"}
            | limited(1000, 600, "anon 500\ninactive_file 50\n", "slurm/job 7"),
            450,
        ),
        # A group above leaves less than the group of the process.
        ("0::/a/b\n", limited(1000, 1200, "inactive_file 50\n", "a") | limited(5000, 20, "", "a/b"), 0),
        # A container has its group at the top, under the path of the host.
        ("0::/docker/abc\n", limited(100, 40), 60),
        # Version 1 has other names of files, and each controller has a folder.
        (
            "5:cpu:/jobs\n4:hugetlb,memory:/jobs/3\n0::/\n",
            {
                "memory/limit_in_bytes": "9223372036854771712",
                "memory/usage_in_bytes": "10",
                "memory/stat": "inactive_file 5\ntotal_inactive_file 9\n",
                "memory/jobs/3/limit_in_bytes": "2000",
                "memory/jobs/3/usage_in_bytes": "500",
                "memory/jobs/3/stat": "inactive_file 5\ntotal_inactive_file 100\n",
            },
            1600,
        ),
    ],
    ids=["nested", "above", "container", "version 1"],
)
def test_the_group_that_leaves_least_decides(groups, files, left, tmp_path):
    """Catches a limit of a batch job or a container that is not read, and memory of files counted as used."""
    assert memory.left_by_control_groups(tree(tmp_path, groups, files)) == left


@pytest.mark.parametrize("text", ["", "\n", "0", "0::", ":::::\n", "x\0y", "4:memory\n", "9" * 5000])
def test_files_that_are_something_else_limit_nothing(text, tmp_path):
    """Catches a run that ends because a system writes these files in another way."""
    assert memory.left_by_control_groups(tree(tmp_path, text, {})) is None
    files = dict.fromkeys(("/max", "/current", "/stat"), text)
    assert memory.left_by_control_groups(tree(tmp_path, "0::/\n", files)) is None
    (tmp_path / "proc/self/cgroup").write_bytes(b"\xff\xfe")
    assert memory.left_by_control_groups(tmp_path) is None
    assert memory.left_by_control_groups(tmp_path / "nothing") is None


def test_the_group_counts_in_what_is_available(monkeypatch):
    """Catches a limit that is read and not used."""
    monkeypatch.setattr(memory, "left_by_control_groups", lambda: 12345)
    assert memory.available() == 12345


def test_the_address_space_counts_whole(monkeypatch):
    """Catches a limit of the address space from which only the resident memory is taken."""
    monkeypatch.setattr(memory, "_address_space_limit", lambda: 1 << 50)
    status = Path("/proc/self/status").read_text().splitlines()
    used = next(1024 * int(line.split()[1]) for line in status if line.startswith("VmSize:"))
    assert (1 << 50) - memory._address_space() == pytest.approx(used, rel=0.1)


def test_what_cannot_be_read_is_no_limit(monkeypatch):
    """Catches a system without /proc whose memory counts as used up."""
    monkeypatch.setattr(memory, "_address_space_limit", lambda: 1 << 30)
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: (_ for _ in ()).throw(FileNotFoundError()))
    assert memory.available() is None
    memory.require(1 << 50, "frames", "lower --width")
