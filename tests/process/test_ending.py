"""How a command ends whose output cannot be written: one line and an exit status, no stack trace."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_run import ROOT

from gsbench.process.ending import end_with

FULL = Path("/dev/full")
PRINTS = "from gsbench.process.ending import end_with; end_with('gsbench.x', lambda: print('text') or {status})"


def ended(code: list[str], **options: object) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process of its own, as it ends; its output is buffered, whatever the shell says."""
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.run([sys.executable, *code], stderr=subprocess.PIPE, text=True, cwd=ROOT, env=plain, **options)  # type: ignore[call-overload,no-any-return]


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("unbuffered", [[], ["-u"]])
def test_a_full_disk_that_takes_no_output_is_told_in_one_line(unbuffered):
    """Catches a stack trace, or Python's own status 120 after two lines, where stdout goes to a full disk."""
    with FULL.open("w") as full:
        done = ended([*unbuffered, "-c", PRINTS.format(status=0)], stdout=full)
    assert done.stderr == "gsbench.x: standard output: No space left on device\n"
    assert done.returncode == 2


def test_a_reader_that_has_gone_is_not_told():
    """Catches a stack trace of `python -m gsbench.report ... | head`."""
    code = [sys.executable, "-c", f"input(); {PRINTS.format(status=0)}"]
    with subprocess.Popen(
        code, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT
    ) as child:
        assert child.stdin
        assert child.stdout
        assert child.stderr
        child.stdout.close()
        child.stdin.write(b"\n")
        child.stdin.flush()
        assert child.stderr.read() == b""
    assert child.returncode == 0


def test_the_status_is_that_of_the_command():
    """Catches a failed command that ends as a success."""
    assert ended(["-c", PRINTS.format(status=3)], stdout=subprocess.DEVNULL).returncode == 3
    assert ended(["-c", PRINTS.format(status="exit(1)")], stdout=subprocess.DEVNULL).returncode == 1
    other = "raise FileNotFoundError(2, 'gone', 'x')"
    done = ended(["-c", f"from gsbench.process.ending import end_with\ndef main():\n    {other}\nend_with('x', main)"])
    assert "FileNotFoundError" in done.stderr


def test_all_commands_end_so():
    """Catches a new command that ends in a stack trace, or under another's name, if its output cannot be written."""
    begin = 'if __name__ == "__main__":\n'
    texts = {path.relative_to(ROOT): path.read_text() for path in (ROOT / "gsbench").rglob("*.py")}
    ends = {path: text.partition(begin)[2] for path, text in texts.items()}
    assert {path for path in ends if path.name == "__main__.py"} <= {path for path, end in ends.items() if end}
    assert len([end for end in ends.values() if end]) >= 9
    for path, end in ends.items():
        command = ".".join(path.with_suffix("").parts).removesuffix(".__main__")
        assert not end or f'end_with("{command}", ' in end or path == Path("gsbench/__main__.py"), path


def test_an_output_that_was_closed_before_is_no_error(monkeypatch):
    """Catches a stack trace of `python -m gsbench.report ... >&-`, where Python has no sys.stdout."""
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(SystemExit) as end:
        end_with("gsbench.x", lambda: 3)
    assert end.value.code == 3
