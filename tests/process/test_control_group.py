"""The memory that control groups leave to a process, read from trees of files as Linux writes them."""

from pathlib import Path

import pytest

from gsbench.process import memory

V2 = "30 20 0:26 {root} /sys/fs/cgroup rw,nosuid shared:9 - cgroup2 cgroup2 rw\n"
V1 = (
    "41 30 0:36 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n"
    "40 30 0:35 {root} /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n"
)


def tree(root: Path, groups: str, mounts: str, **files: str) -> Path:
    """Write a tree with proc/self and the files of control groups; a name's `__` is a `/`, its `_of_` a `.`."""
    written = {"proc/self/cgroup": groups, "proc/self/mountinfo": mounts}
    written |= {f"sys/fs/cgroup/{name.replace('__', '/')}": text for name, text in files.items()}
    for name, text in written.items():
        path = root / name.replace("_of_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_a_nested_group_of_version_2_limits(tmp_path: Path) -> None:
    """Catches a batch job whose own limit is not read, as that of the root is not set."""
    root = tree(
        tmp_path, "0::/slurm/job 7\n", V2.format(root="/"),
        slurm__memory_of_max="max\n", slurm__memory_of_current="9\n",
        **{"slurm__job 7__memory_of_max": "1000\n", "slurm__job 7__memory_of_current": "600\n",
           "slurm__job 7__memory_of_stat": "anon 500\ninactive_file 50\n"},
    )  # fmt: skip
    assert memory.left_by_control_groups(root) == 450


def test_a_group_above_that_leaves_less_decides(tmp_path: Path) -> None:
    """Catches a limit of a container that the group of a process in it does not repeat."""
    root = tree(
        tmp_path, "0::/a/b\n", V2.format(root="/"),
        a__memory_of_max="1000", a__memory_of_current="1200", a__memory_of_stat="inactive_file 50\n",
        a__b__memory_of_max="5000", a__b__memory_of_current="20", a__b__memory_of_stat="",
    )  # fmt: skip
    assert memory.left_by_control_groups(root) == 0


@pytest.mark.parametrize("path", ["/docker/abc/job", "/docker/abc/../../job", "/elsewhere"])
def test_a_mount_of_a_part_of_the_groups(path: str, tmp_path: Path) -> None:
    """Catches a container that has its own group at the top of its mount, under the path of the host."""
    files = {"memory_of_max": "100", "memory_of_current": "40", "memory_of_stat": ""}
    root = tree(tmp_path, f"0::{path}\n", V2.format(root="/docker/abc"), **files)
    assert memory.left_by_control_groups(root) == 60


def test_version_1(tmp_path: Path) -> None:
    """Catches a system of version 1, where the files have other names and each controller has its own mount."""
    root = tree(
        tmp_path, "5:cpu:/jobs\n4:hugetlb,memory:/jobs/3\n0::/\n", V2.format(root="/") + V1.format(root="/"),
        memory__memory_of_limit_in_bytes="9223372036854771712", memory__memory_of_usage_in_bytes="10",
        memory__memory_of_stat="inactive_file 5\ntotal_inactive_file 9\n",
        memory__jobs__3__memory_of_limit_in_bytes="2000", memory__jobs__3__memory_of_usage_in_bytes="500",
        memory__jobs__3__memory_of_stat="inactive_file 5\ntotal_inactive_file 100\n",
    )  # fmt: skip
    assert memory.left_by_control_groups(root) == 1600


@pytest.mark.parametrize("text", ["", "\n", "0", "0::", ":::::\n", "x\0y", "4:memory\n", "9" * 5000, "- - - - - -\n",
                                  "1 2 3 - cgroup2\n", "a - cgroup\n", " - \n"])  # fmt: skip
def test_files_that_are_something_else_limit_nothing(text: str, tmp_path: Path) -> None:
    """Catches a run that ends because a system writes these files in another way."""
    assert memory.left_by_control_groups(tree(tmp_path, text, V2.format(root="/") + V1.format(root="/"))) is None
    files = {"memory_of_max": text, "memory_of_current": text, "memory_of_stat": text}
    assert memory.left_by_control_groups(tree(tmp_path, "0::/\n", V2.format(root="/"), **files)) is None
    limited = {"memory_of_max": "100", "memory_of_current": "40", "memory_of_stat": ""}
    for mounts in (text, text + V2.format(root="/")):
        tree(tmp_path, "0::/\n4:memory:/\n", mounts, **limited)
        memory.left_by_control_groups(tmp_path)
    (tmp_path / "proc/self/mountinfo").write_bytes(b"\xff\xfe")
    assert memory.left_by_control_groups(tmp_path) is None
    assert memory.left_by_control_groups(tmp_path / "nothing") is None


def test_the_group_counts_in_what_is_available(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a limit that is read and not used."""
    monkeypatch.setattr(memory, "left_by_control_groups", lambda: 12345)
    assert memory.available() == 12345
